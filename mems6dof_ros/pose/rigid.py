"""Rigid-body algebra: rotations, poses, their covariances, and the weighted Kabsch solution.

A pose is ``q = R p + t``, body to microscope frame. Everywhere in this project a pose is disturbed as
``R -> Exp(w) R, t -> t + d`` with w about the *fixed* axes, and its 6 x 6 covariance is that of (d, w):
the convention of geometry_msgs/PoseWithCovariance (REP-103).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]


_ONE = np.eye(3)


class RigidPose(NamedTuple):
    """Body to microscope frame: ``rotation`` (3, 3), ``translation`` (3,) m."""

    rotation: Array
    translation: Array

    def apply(self, points: Array) -> Array:
        """``R p + t`` for ``points`` (..., 3) m."""
        return points @ self.rotation.T + self.translation

    def inverse(self) -> RigidPose:
        """The pose that undoes this one."""
        return RigidPose(self.rotation.T, -self.rotation.T @ self.translation)

    def then(self, other: RigidPose) -> RigidPose:
        """First this pose, then ``other``: ``other . self``."""
        return RigidPose(
            other.rotation @ self.rotation, other.rotation @ self.translation + other.translation
        )


IDENTITY = RigidPose(np.eye(3), np.zeros(3))


@njit(cache=True, nogil=True)
def hat(v: Array) -> Array:
    """Cross-product matrix (3, 3) of ``v`` (3,): ``hat(v) @ u = v x u``."""
    x, y, z = v[0], v[1], v[2]
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def rotation_z(angle: float) -> Array:
    """Rotation matrix (3, 3) about z by ``angle`` rad."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


@njit(cache=True, nogil=True)
def exp_so3(w: Array) -> Array:
    """Rotation matrix (3, 3) of the rotation vector ``w`` (3,) rad (Rodrigues)."""
    angle = math.sqrt(float(w @ w))
    k = hat(w)
    if angle < 1e-4:  # series: the closed form cancels
        return _ONE + (1 - angle**2 / 6) * k + (0.5 - angle**2 / 24) * (k @ k)
    return _ONE + math.sin(angle) / angle * k + (1 - math.cos(angle)) / angle**2 * (k @ k)


def log_so3(rotation: Array) -> Array:
    """Rotation vector (3,) rad of ``rotation``, of length at most pi; safe at 0 and at pi."""
    vee = 0.5 * np.array(
        [
            rotation[2, 1] - rotation[1, 2],
            rotation[0, 2] - rotation[2, 0],
            rotation[1, 0] - rotation[0, 1],
        ]
    )
    sine = math.sqrt(float(vee @ vee))
    cosine = 0.5 * (float(np.trace(rotation)) - 1)
    angle = math.atan2(sine, cosine)
    if sine > 1e-6:
        return vee * (angle / sine)
    if cosine > 0:
        return vee
    # Near pi the antisymmetric part vanishes; the axis is in the symmetric part.
    symmetric = 0.5 * (rotation + rotation.T) + np.eye(3)
    axis = symmetric[:, int(np.argmax(np.diag(symmetric)))]
    axis = axis / np.linalg.norm(axis)
    return axis * (angle if vee @ axis >= 0 else -angle)


@njit(cache=True, nogil=True)
def quaternion(rotation: Array) -> Array:
    """Unit quaternion x, y, z, w of ``rotation`` (3, 3), w not negative (Shepperd 1978: by its largest
    component, so that nothing cancels). NaN stays NaN."""
    trace = rotation[0, 0] + rotation[1, 1] + rotation[2, 2]
    squares = np.array([rotation[0, 0], rotation[1, 1], rotation[2, 2], trace])
    largest = int(np.argmax(squares))
    q = np.empty(4)
    if largest == 3:
        q[0] = rotation[2, 1] - rotation[1, 2]
        q[1] = rotation[0, 2] - rotation[2, 0]
        q[2] = rotation[1, 0] - rotation[0, 1]
        q[3] = 1 + trace
    else:
        i, j, k = largest, (largest + 1) % 3, (largest + 2) % 3
        q[i] = 1 + 2 * rotation[i, i] - trace
        q[j] = rotation[j, i] + rotation[i, j]
        q[k] = rotation[k, i] + rotation[i, k]
        q[3] = rotation[k, j] - rotation[j, k]
    q /= math.sqrt(float(q @ q))
    return -q if q[3] < 0 else q


@njit(cache=True, nogil=True)
def left_jacobian(w: Array) -> Array:
    """J (3, 3) of ``Exp(w + d) = Exp(J d) Exp(w)`` to first order (Sola et al. 2018, eq. 145)."""
    angle = math.sqrt(float(w @ w))
    k = hat(w)
    if angle < 1e-4:
        return _ONE + 0.5 * k + (k @ k) / 6
    return np.eye(3) + (1 - math.cos(angle)) / angle**2 * k + (angle - math.sin(angle)) / angle**3 * (k @ k)


def kabsch(body: Array, measured: Array, weights: Array | None = None) -> RigidPose:
    """Least-squares pose that takes ``body`` (n, 3) onto ``measured`` (n, 3) (Kabsch 1976), n >= 3,
    with scalar ``weights`` (n,); always a proper rotation."""
    w = np.full(len(body), 1 / len(body)) if weights is None else weights / weights.sum()
    body_mean, measured_mean = w @ body, w @ measured
    covariance = (w[:, None] * (body - body_mean)).T @ (measured - measured_mean)
    u, _, vt = np.linalg.svd(covariance)
    sign = math.copysign(1.0, float(np.linalg.det(u @ vt)))
    rotation = vt.T @ np.diag([1.0, 1.0, sign]) @ u.T
    return RigidPose(rotation, measured_mean - rotation @ body_mean)


def shift_origin(covariance: Array, lever: Array) -> Array:
    """Covariance (6, 6) of a pose whose origin moves by ``lever`` (3,) m, given in the microscope
    frame: ``t' = t + lever``, hence ``d' = d + w x lever``."""
    jacobian = lever_jacobian(lever)
    return jacobian @ covariance @ jacobian.T


@njit(cache=True, nogil=True)
def lever_jacobian(lever: Array) -> Array:
    """d(d', w) / d(d, w), (6, 6), of that change of origin."""
    jacobian = np.eye(6)
    jacobian[:3, 3:] = -hat(lever)
    return jacobian
