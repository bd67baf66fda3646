"""The motion of one body relative to another, cycle by cycle."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mems6dof_ros.analysis.motion import memory_factor
from mems6dof_ros.analysis.recording import Recording
from mems6dof_ros.analysis.truth import compare
from mems6dof_ros.errors import InputError
from mems6dof_ros.pose.bodies import relative_pose
from mems6dof_ros.pose.cycle_pose import CyclePose
from mems6dof_ros.recording.tables import Table

Array = NDArray[np.float64]

#: Below this rotation (rad) of the body referred to, no ratio is given.
LEAST_ROTATION = 0.01

_POSE = ("x_m", "y_m", "z_m", *(f"r{row}{column}" for row in "123" for column in "123"))
_SD = ("sd_x_m", "sd_y_m", "sd_z_m", "sd_rotation_x_rad", "sd_rotation_y_rad", "sd_rotation_z_rad")
_DISPLACEMENT = ("dx_m", "dy_m", "dz_m", "tilt_x_rad", "tilt_y_rad", "transmission_rad")

#: One row per pair of bodies and motion cycle: the pose of one in the frame of the other with its standard
#: deviations; then the difference of displacements, in microscope axes, with theirs.
RELATIVE = Table(
    "relative",
    {"body": str, "to": str, "cycle": int, "stamp_ns": int}
    | dict.fromkeys((*_POSE, *_SD, *_DISPLACEMENT, *(f"sd_{name}" for name in _DISPLACEMENT)), float),
    lambda row: row,
)


@dataclass(frozen=True)
class RelativeMotion:
    """Body ``of`` relative to body ``to`` in the n cycles that have a valid pose of both.

    ``poses`` (n): of ``of`` in the body frame of ``to``, as CyclePose with that rotation, translation and
    covariance; the rest is that of the body ``of``. ``displacement`` (n, 6): that of ``of`` less that of
    ``to``, about the mean, in the microscope's axes, m and rad; of psi what departs from the constant
    ``ratio`` of rotations (transmission error). ``sd`` (n, 6). ``error`` (n, 6) of it, None without truth.
    ``ratio``: rotation of ``of`` to that of ``to``, NaN below LEAST_ROTATION; then psi is the difference.
    """

    of: str
    to: str
    poses: Sequence[CyclePose]
    displacement: Array
    sd: Array
    ratio: float
    sd_ratio: float
    error: Array | None

    def rows(self) -> list[list[Any]]:
        """Rows of RELATIVE."""
        return [
            [
                *(self.of, self.to, pose.cycle, pose.stamp_ns, *pose.translation, *pose.rotation.ravel()),
                *(*np.sqrt(np.diag(pose.covariance)), *displacement, *sd),
            ]
            for pose, displacement, sd in zip(self.poses, self.displacement, self.sd, strict=True)
        ]


def relative_motion(recording: Recording, of: str, to: str) -> RelativeMotion:
    """Motion of ``of`` relative to ``to``, each in its last reference.

    Raises InputError where fewer than 3 cycles have both.
    """
    others = {pose.stamp_ns: pose for pose in recording.in_last_reference(to) if pose.valid}
    pairs = [
        (pose, others[pose.stamp_ns])
        for pose in recording.in_last_reference(of)
        if pose.valid and pose.stamp_ns in others
    ]
    if len(pairs) < 3:
        raise InputError(f"{of} relative to {to}", f"{len(pairs)} cycles with both", "3 or more")
    a = np.array([pose.displacement for pose, _ in pairs])
    b = np.array([pose.displacement for _, pose in pairs])
    variance_a, variance_b = (
        np.array([np.diag(pair[k].displacement_covariance) for pair in pairs]) for k in (0, 1)
    )
    ratio, sd_ratio = _ratio(a[:, 5], b[:, 5])
    factor = 1.0 if math.isnan(ratio) else ratio
    weight = np.array([1.0, 1.0, 1.0, 1.0, 1.0, factor])
    displacement = a - b * weight
    poses = []
    for pose, other in pairs:
        relative, covariance = relative_pose(pose, other)
        poses.append(
            replace(pose, rotation=relative.rotation, translation=relative.translation, covariance=covariance)
        )
    return RelativeMotion(
        of,
        to,
        poses,
        displacement - displacement.mean(axis=0),
        np.sqrt(variance_a + variance_b * weight**2),
        ratio,
        sd_ratio,
        _errors(recording, pairs, weight),
    )


def _ratio(turned: Array, by: Array) -> tuple[float, float]:
    """Slope of one rotation against the other, and its standard deviation by the scatter about it."""
    if np.ptp(by) < LEAST_ROTATION:
        return math.nan, math.nan
    slope, offset = np.polyfit(by, turned, 1)
    left = turned - slope * by - offset
    variance = float(left @ left) / (len(left) - 2) * memory_factor(left[:, None])
    return float(slope), math.sqrt(variance / float(((by - by.mean()) ** 2).sum()))


def _errors(
    recording: Recording, pairs: Sequence[tuple[CyclePose, CyclePose]], weight: Array
) -> Array | None:
    """Difference of the errors (n, 6) of both bodies, None unless the truth of both is known throughout."""
    errors = []
    for poses in zip(*pairs, strict=True):
        truths = recording.truth_of(list(poses))
        if None in truths:
            return None
        errors.append(compare(poses, truths).error)
    return np.asarray(errors[0] - errors[1] * weight)
