"""A constellation kept for another session: what a body is recognised by."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mems6dof_ros import __version__
from mems6dof_ros.documents import read_document, write_whole
from mems6dof_ros.errors import InputError
from mems6dof_ros.pose.body_frame import BodyFrame

if TYPE_CHECKING:
    from mems6dof_ros.pose.constellation import Constellation

FORMAT, VERSION = "mems6dof constellation", 1


@dataclass(frozen=True)
class ReferenceConstellation:
    """Particles of ``body``: ``ids`` (n,), ``position`` (n, 3) m in the body frame, ``covariance``
    (n, 3, 3) m^2."""

    body: str
    ids: NDArray[np.int64]
    position: NDArray[np.float64]
    covariance: NDArray[np.float64]

    @classmethod
    def of(cls, body: str, constellation: Constellation, frame: BodyFrame) -> ReferenceConstellation:
        """The particles of ``constellation`` that were seen more than once, in the body frame."""
        keep = constellation.active & (constellation.sightings > 1)
        position = (constellation.position[keep] - frame.origin) @ frame.rotation.T
        covariance = frame.rotation @ constellation.covariance[keep] @ frame.rotation.T
        return cls(body, constellation.ids[keep].copy(), position, covariance)

    def save(self, path: Path) -> None:
        """Write as JSON, with units and the software's version, whole or not at all; InputError where
        ``path`` cannot be written."""
        content = {
            "format": FORMAT,
            "format_version": VERSION,
            "software": f"mems6dof {__version__}",
            "body": self.body,
            "units": {"position": "m, body frame, origin at the centre of rotation", "covariance": "m^2"},
            "ids": self.ids.tolist(),
            "position": self.position.tolist(),
            "covariance": self.covariance.tolist(),
        }
        write_whole(path, json.dumps(content))

    @classmethod
    def load(cls, path: Path) -> ReferenceConstellation:
        """Read what ``save`` wrote. Raises InputError for anything else."""
        content = read_document(path, "JSON", "a constellation file")
        if not isinstance(content, dict) or content.get("format") != FORMAT:
            raise InputError(str(path), "another kind of file", f"format {FORMAT!r}")
        if content.get("format_version") != VERSION:
            raise InputError(
                str(path), f"format version {content.get('format_version')}", f"version {VERSION}"
            )
        try:
            ids = np.array(content["ids"], np.int64)
            position = np.array(content["position"], float).reshape(len(ids), 3)
            covariance = np.array(content["covariance"], float).reshape(len(ids), 3, 3)
            body = str(content["body"])
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise InputError(
                str(path), f"incomplete content ({error})", "ids, position, covariance, body"
            ) from error
        if len(ids) < 3 or not (np.isfinite(position).all() and np.isfinite(covariance).all()):
            raise InputError(str(path), f"{len(ids)} particles, or numbers that are not finite", "3 or more")
        return cls(body, ids, position, covariance)
