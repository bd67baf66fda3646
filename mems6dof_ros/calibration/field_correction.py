"""Second layer of a calibration: the smooth field error that only a rotating rigid body shows.

A bead array has random places, so a static distortion of the field is part of what its fits take for the
places of its beads. A rigid body carries every particle through many places, and the pose estimator measures
the distortion with its constellation (pose/field.py). Here it becomes part of the calibration: positions are
corrected by it from the first frame of the next session, which starts from the covariance that remains.

What rotation cannot show stays as uncertain as was assumed: besides the modes that are left out
(field_modes.py) all that depends on the distance to the centre of rotation alone. Gears about another
centre tell it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mems6dof_ros.calibration.field_modes import FieldModes
from mems6dof_ros.errors import InputError

Array = NDArray[np.float64]


@dataclass(frozen=True)
class FieldCorrection:
    """Measured minus true position over the field: ``modes`` with coefficients ``mean`` (k,) m, known to
    ``covariance`` (k, k) m^2. ``method``: how z was read, since each method has errors of its own.
    ``provenance``: plain values for the file."""

    modes: FieldModes
    mean: Array
    covariance: Array
    method: str
    provenance: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        k = len(self.modes)
        if k == 0 or self.mean.shape != (k,) or self.covariance.shape != (k, k):
            found = f"{len(self.mean)} coefficients for {k} modes"
            raise InputError(
                "field correction", found, "one or more modes, a coefficient and variances for each"
            )
        if not np.allclose(self.covariance, self.covariance.T, rtol=1e-6, atol=0) or not (
            np.linalg.eigvalsh(self.covariance).min() > 0
        ):
            raise InputError("field correction: covariance", "another matrix", "a positive definite one")

    def apply(self, position: Array) -> Array:
        """``position`` (n, 3) m without the error."""
        return position - self.modes.evaluate(position) @ self.mean

    def remaining(self, position: Array) -> Array:
        """Covariance (n, 3, 3) m^2 of the error that remains at ``position`` (n, 3) m: common to neighbours
        and to frames, so it is no part of the covariance of single localizations."""
        modes = self.modes.evaluate(position)
        return modes @ self.covariance @ modes.transpose(0, 2, 1)

    def refined(self, mean: Array, covariance: Array, provenance: Mapping[str, Any]) -> FieldCorrection:
        """With what a later session measured about it: ``mean`` (k,) m is added, ``covariance`` replaces."""
        return replace(self, mean=self.mean + mean, covariance=covariance, provenance=provenance)
