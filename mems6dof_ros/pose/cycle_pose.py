"""The pose of one rigid body after one motion cycle: what the pose estimator hands on."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from mems6dof_ros.localization.localizations import Latency

#: Order of the six degrees of freedom in every displacement and its covariance.
DEGREES_OF_FREEDOM = ("dx", "dy", "dz", "tilt_x", "tilt_y", "psi")


class Status(IntEnum):
    """State of the estimate. Equal to the STATUS_ constants of the message."""

    INITIALIZING = 0
    TRACKING = 1
    DEGRADED = 2
    LOST = 3


@dataclass(frozen=True)
class PaperAngles:
    """Precession alpha, nutation beta, intrinsic rotation gamma (z-y-z), rad, with their
    standard deviations; ``valid`` flags say where noise leaves one undetermined."""

    alpha: float
    beta: float
    gamma: float
    sd_alpha: float
    sd_beta: float
    sd_gamma: float
    alpha_valid: bool
    beta_valid: bool


@dataclass(frozen=True)
class CyclePose:
    """Pose of one body, fields as in mems6dof_msgs/Pose6DOF.

    ``rotation`` (3, 3), ``translation`` (3,) m: body to microscope frame, with ``covariance``
    (6, 6) in (x, y, z, rotation about fixed x, y, z). ``displacement`` (6,) from the reference in
    the order of DEGREES_OF_FREEDOM, m and rad, psi unwrapped, with ``displacement_covariance``.
    ``increment`` (6,) since the previous valid pose, ``increment_cycles`` ago. ``particle_id`` (n,)
    and ``residual`` (n, 3) m are parallel to the localizations; -1 and NaN where not used. All
    numbers are NaN unless status is TRACKING or DEGRADED.
    """

    stamp_ns: int
    frame_id: str
    frame_counter: int
    cycle: int
    body: str
    status: Status
    reason: str
    reference_version: int
    rotation: NDArray[np.float64]
    translation: NDArray[np.float64]
    covariance: NDArray[np.float64]
    displacement: NDArray[np.float64]
    displacement_covariance: NDArray[np.float64]
    angles: PaperAngles
    increment: NDArray[np.float64]
    increment_covariance: NDArray[np.float64]
    increment_cycles: int
    residual_rms_xy: float
    residual_rms_z: float
    chi_square: float
    particles_used: int
    particles_seen: int
    particles_expected: int
    particle_id: NDArray[np.int32]
    residual: NDArray[np.float64]
    latency: Latency = field(default_factory=Latency)

    @property
    def valid(self) -> bool:
        """True when the numbers may be used."""
        return self.status in (Status.TRACKING, Status.DEGRADED)
