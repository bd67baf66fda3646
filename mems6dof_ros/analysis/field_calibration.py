"""Field self-calibration: recordings of turning bodies to the second layer of a calibration."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mems6dof_ros import __version__
from mems6dof_ros.calibration.file import Calibration
from mems6dof_ros.errors import InputError
from mems6dof_ros.localization.localizations import Localizations
from mems6dof_ros.pose.bodies import Bodies
from mems6dof_ros.pose.field import FieldError
from mems6dof_ros.pose.settings import PoseSettings
from mems6dof_ros.recording import messages
from mems6dof_ros.recording.bag import BagReader

_LOCALIZATIONS = "mems6dof_msgs/msg/Localizations"
_GRID = 21


@dataclass(frozen=True)
class FieldCalibration:
    """``calibration`` with the field error of one more recording corrected; ``cycles`` in it and, by body,
    those with a valid ``poses``; rms over the field, (3,) m in x, y and z: of the error ``measured``, and of
    the standard deviation ``before`` and ``after``."""

    calibration: Calibration
    cycles: int
    poses: dict[str, int]
    measured: NDArray[np.float64]
    before: NDArray[np.float64]
    after: NDArray[np.float64]


def calibrate_field(
    calibration: Calibration,
    cycles: Iterable[Localizations],
    make_bodies: Callable[[PoseSettings, FieldError], Bodies],
    name: str,
    sha256: str,
    settings: PoseSettings | None = None,
) -> FieldCalibration:
    """Measure what is left of the field error, from ``cycles`` located by ``calibration``.

    ``make_bodies(settings, field)`` gives their estimators; ``name`` and ``sha256`` of the recording go into
    the provenance. Raises InputError where no cycle has a valid pose, and where the calibration has learnt
    from that recording before.
    """
    settings = settings or PoseSettings()
    field = FieldError.remaining(calibration.correction, settings)
    if field is None:
        width, height = (size * calibration.pixel_size for size in calibration.image_size)
        field = FieldError.assumed(settings, np.array([width, height]) / 2)
    if len(field.modes) == 0:
        raise InputError("field calibration", "no field error in the settings", "a field_degree above 0")
    if any(other["sha256"] == sha256 for other in _recordings(calibration)):
        raise InputError("field calibration", f"{name} for the second time", "another recording")
    bodies = make_bodies(settings, field)
    count, poses = 0, {estimator.body: 0 for estimator in bodies.estimators}
    for found in cycles:
        count += 1
        for pose in bodies.update(found):
            poses[pose.body] += pose.valid
    if not any(poses.values()):
        raise InputError(
            f"field calibration: {name}", f"no valid pose in {count} cycles", "a body that turns"
        )
    field = bodies.measured_field()
    corrected = with_field_error(calibration, field, settings, name, poses, count, sha256)
    modes = _modes_over_field(field)
    return FieldCalibration(
        corrected,
        count,
        poses,
        np.sqrt(((modes @ field.mean) ** 2).mean(axis=0)),
        _rms(modes, field.prior),
        _rms(modes, field.covariance),
    )


def with_field_error(
    calibration: Calibration,
    field: FieldError,
    settings: PoseSettings,
    name: str,
    poses: Mapping[str, int],
    cycles: int,
    sha256: str = "",
) -> Calibration:
    """``calibration`` with the ``field`` error that was measured by it in ``cycles``, and where that is from:
    ``name`` of the recording and, of a file, its ``sha256``; ``poses``: valid ones by body."""
    learnt = {
        "recording": name,
        "sha256": sha256,
        "calibration_id": calibration.calibration_id,
        "cycles": cycles,
        "poses": dict(poses),
    }
    provenance = {
        "made_by": f"mems6dof {__version__}",
        "prior": {"field_sd_xy_m": settings.field_sd_xy, "field_sd_z_m": settings.field_sd_z},
        "recordings": [*_recordings(calibration), learnt],
    }
    return calibration.corrected(field.modes, field.mean, field.covariance, provenance)


def _recordings(calibration: Calibration) -> Sequence[Mapping[str, Any]]:
    """What the field correction of ``calibration`` was learnt from."""
    return calibration.correction.provenance["recordings"] if calibration.correction else ()


def localizations_of(path: Path, calibration: Calibration) -> Iterator[Localizations] | None:
    """The localizations that the bag at ``path`` holds by ``calibration``, or by it without its field
    correction, which they then get; None where it holds none. Raises InputError for another calibration."""
    with BagReader(path) as bag:
        topics = [topic for topic, kind in bag.topics.items() if kind == _LOCALIZATIONS and bag.counts[topic]]
    if not topics:
        return None
    if len(topics) > 1:
        raise InputError(str(path), f"localizations on {', '.join(topics)}", "on one topic")
    return _read(path, topics[0], calibration)


def _read(path: Path, topic: str, calibration: Calibration) -> Iterator[Localizations]:
    optics = calibration.with_correction(None).calibration_id
    with BagReader(path) as bag:
        for recorded in bag.messages([topic]):
            found = messages.to_localizations(recorded.message)
            if found.calibration_id == calibration.calibration_id:
                yield found
            elif found.calibration_id == optics and calibration.correction is not None:
                yield replace(found, position=calibration.correction.apply(found.position))
            else:
                by = f"localizations by calibration {found.calibration_id or 'none'}"
                raise InputError(f"{path}: {topic}", by, f"{calibration.calibration_id} or {optics}")


def _modes_over_field(field: FieldError) -> NDArray[np.float64]:
    """Modes (n, 3, k) on a grid over the field."""
    u = (np.arange(_GRID) + 0.5) / _GRID * 2 - 1
    x, y = np.meshgrid(u * field.modes.half_size[0], u * field.modes.half_size[1])
    return field.modes.evaluate(np.column_stack([x.ravel(), y.ravel()]))


def _rms(modes: NDArray[np.float64], covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.sqrt(np.einsum("nik,kl,nil->ni", modes, covariance, modes).mean(axis=0))
