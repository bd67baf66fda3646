"""Angles of a pose: tilt and intrinsic rotation (swing and twist), and the paper's alpha, beta, gamma.

``R = Swing(tilt) Rz(psi)`` exactly, tilt = (tilt_x, tilt_y, 0) a rotation vector: unlike the z-y-z
angles it is regular at zero tilt. Then beta = |tilt|, alpha = azimuth of the body's z axis and
psi = alpha + gamma' (gamma' the third z-y-z angle). Definitions with a figure: docs/definitions.md.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mems6dof_ros.pose.cycle_pose import PaperAngles
from mems6dof_ros.pose.rigid import exp_so3, left_jacobian, rotation_z

Array = NDArray[np.float64]

#: 95 % quantile of the Rayleigh distribution, sd: below it a tilt is not told from noise.
BETA_DETECTION = math.sqrt(-2 * math.log(0.05))
#: alpha is undetermined below this many standard deviations of the tilt.
ALPHA_DETECTION = 3.0


@njit(cache=True, nogil=True)
def swing_twist(rotation: Array) -> tuple[float, float, float]:
    """(tilt_x, tilt_y, psi) rad of ``rotation`` (3, 3), psi in (-pi, pi]; undefined only for a body
    upside down."""
    nx, ny, nz = rotation[0, 2], rotation[1, 2], rotation[2, 2]
    sine = math.hypot(nx, ny)
    scale = math.atan2(sine, nz) / sine if sine > 1e-12 else 1.0
    # n = Exp(tilt) z = z + tilt x z + ..., hence tilt is along (-ny, nx).
    tilt_x, tilt_y = -ny * scale, nx * scale
    # The trace-like sums give the twist without undoing the swing (quaternion z over w).
    psi = math.atan2(rotation[1, 0] - rotation[0, 1], rotation[0, 0] + rotation[1, 1])
    return tilt_x, tilt_y, psi


def from_swing_twist(tilt_x: float, tilt_y: float, psi: float) -> Array:
    """``Swing(tilt) Rz(psi)`` (3, 3), the inverse of swing_twist."""
    return exp_so3(np.array([tilt_x, tilt_y, 0.0])) @ rotation_z(psi)


@njit(cache=True, nogil=True)
def swing_twist_jacobian(tilt_x: float, tilt_y: float) -> Array:
    """d(tilt_x, tilt_y, psi) / d(w), (3, 3), for a rotation disturbed as ``R -> Exp(w) R``."""
    tilt = np.array([tilt_x, tilt_y, 0.0])
    columns = left_jacobian(tilt)
    columns[:, 2] = exp_so3(tilt)[:, 2]  # the twist turns about the body's axis
    return np.linalg.inv(columns).astype(np.float64)


def unwrap_near(angle: float, near: float) -> float:
    """``angle`` plus the whole turns that bring it closest to ``near``, rad."""
    return angle + math.tau * round((near - angle) / math.tau)


def paper_angles(displacement: Array, covariance: Array) -> PaperAngles:
    """alpha, beta, gamma of a displacement (6,) with covariance (6, 6) (DEGREES_OF_FREEDOM).

    beta = |tilt| is Rician: noise across the tilt biases it by sd^2 / (2 beta); removed as
    ``sqrt(beta^2 - sd^2)`` (Gudbjartsson and Patz 1995), never below 0. gamma is psi, unwrapped.
    """
    tilt_x, tilt_y, gamma = displacement[3:].tolist()
    (xx, xy), (_, yy) = covariance[3:5, 3:5].tolist()
    raw = math.hypot(tilt_x, tilt_y)
    x, y = (tilt_x / raw, tilt_y / raw) if raw > 0 else (1.0, 0.0)
    sd_along = math.sqrt(x * x * xx + 2 * x * y * xy + y * y * yy)
    sd_across = math.sqrt(y * y * xx - 2 * x * y * xy + x * x * yy)
    # Distance from zero in standard deviations, in the metric of this covariance.
    square = tilt_x * tilt_x * yy - 2 * tilt_x * tilt_y * xy + tilt_y * tilt_y * xx
    detection = math.sqrt(max(0.0, square / (xx * yy - xy * xy)))
    beta = math.sqrt(max(0.0, raw**2 - sd_across**2))
    return PaperAngles(
        alpha=math.atan2(-tilt_x, tilt_y),
        beta=beta,
        gamma=gamma,
        sd_alpha=min(sd_across / raw, math.pi / math.sqrt(3)) if raw > 0 else math.pi / math.sqrt(3),
        sd_beta=sd_along,
        sd_gamma=math.sqrt(float(covariance[5, 5])),
        alpha_valid=detection >= ALPHA_DETECTION,
        beta_valid=detection >= BETA_DETECTION,
    )
