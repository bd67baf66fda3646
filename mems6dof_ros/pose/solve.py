"""Pose from matched particles: robust start, Gauss-Newton on SE(3), covariance with field error.

Model: ``q_i = R (p_i + dp_i) + t + F_i c + n_i`` with n_i the localization's noise, dp_i the map's
uncertainty and c the coefficients of smooth field errors, all Gaussian with known covariance. c is common to
all particles: it is marginalised, not added to each particle's covariance.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mems6dof_ros.pose.rigid import RigidPose

Array = NDArray[np.float64]

#: What a particle contributes: nothing, x and y only, or all three coordinates.
UNUSED, LATERAL, FULL = 0, 1, 2


class Solution(NamedTuple):
    """``pose``; its ``covariance`` (6, 6) in (d, w), see rigid.py; ``noise`` (6, 6), the part of it that
    comes from this frame alone; ``use`` (n,) of UNUSED, LATERAL, FULL; ``residual`` (n, 3) m;
    ``tested_z`` (n,): where the body's own z is known well enough for the residual to tell something;
    ``squares`` (n, 2): squared normalised residuals in xy and z, and ``freedom`` (n, 2): their expectations
    where the covariances are true, the particle's own pull on the pose taken off; 0 where not used;
    ``chi_square`` and ``degrees_of_freedom`` of the whole; ``gain`` (6, 3 n): change of the pose with what is
    measured. ``ok`` is False where the particles do not fix a pose."""

    ok: bool
    pose: RigidPose
    covariance: Array
    noise: Array
    use: NDArray[np.int64]
    residual: Array
    tested_z: NDArray[np.bool_]
    squares: Array
    freedom: Array
    chi_square: float
    degrees_of_freedom: int
    gain: Array


def solve_pose(
    start: RigidPose,
    body: Array,
    body_covariance: Array,
    measured: Array,
    measured_covariance: Array,
    has_z: NDArray[np.bool_],
    field: Array,
    spread: Array,
    gate_xy: float,
    gate_z: float,
) -> Solution:
    """Pose that takes ``body`` (n, 3) onto ``measured`` (n, 3) m, covariances (n, 3, 3) m^2.

    ``start`` must be good to a micrometre in the plane; z and tilt are found robustly from there, up to
    a third of wrong z, all to one side. ``has_z`` (n,): z counts. ``field`` (n, 3, k) m: modes of the
    field error scaled to unit variance, k may be 0, and ``spread`` (n, 3, 3) m^2 their covariance at
    each place. Beyond ``gate_xy`` standard deviations a particle is left out, beyond ``gate_z`` only its z: a
    wrong axial branch does not cost a good x and y.
    """
    rotation, translation, use, residual, weight, squares, freedom, ok = _gauss_newton(
        start.rotation, start.translation, body, body_covariance, measured, measured_covariance,
        spread, has_z, gate_xy, gate_z,
    )  # fmt: skip
    pose = RigidPose(rotation, translation)
    tested_z = body_covariance[:, 2, 2] < 4 * measured_covariance[:, 2, 2]
    count_xy, count_z = int((use > UNUSED).sum()), int((use == FULL).sum())
    if not ok:
        nan = np.full((6, 6), np.nan)
        return Solution(
            False, pose, nan, nan, use, residual, tested_z, squares, freedom, math.nan, 0, np.empty((6, 0))
        )

    # The exact solution with the field error common to all: one linear step from a converged start.
    step, covariance, noise, chi_square, gain = _marginalise(
        body @ rotation.T, field, weight, residual, measured_covariance
    )
    residual[use == UNUSED] = np.nan
    pose = RigidPose(_exp(step[3:]) @ rotation, translation + step[:3])
    return Solution(
        bool(np.isfinite(covariance).all()), pose, covariance, noise, use, residual, tested_z,
        squares, freedom, chi_square, 2 * count_xy + count_z - 6, gain,
    )  # fmt: skip


def pose_jacobian(body: Array, rotation: Array) -> Array:
    """d(R p + t) / d(d, w), (n, 3, 6): the identity beside ``-hat(R p)``."""
    moved = body @ rotation.T
    jacobian = np.zeros((len(body), 3, 6))
    jacobian[:, 0, 0] = jacobian[:, 1, 1] = jacobian[:, 2, 2] = 1.0
    jacobian[:, 0, 4], jacobian[:, 0, 5] = moved[:, 2], -moved[:, 1]
    jacobian[:, 1, 3], jacobian[:, 1, 5] = -moved[:, 2], moved[:, 0]
    jacobian[:, 2, 3], jacobian[:, 2, 4] = moved[:, 1], -moved[:, 0]
    return jacobian


@njit(cache=True, nogil=True)
def weights(covariance, full):  # type: ignore[no-untyped-def]
    """Inverse covariances (n, 3, 3); where not ``full`` (n,), of x and y alone."""
    out = np.zeros_like(covariance)
    for i in range(len(covariance)):
        _invert(covariance[i], full[i], out[i])
    return out


@njit(cache=True, nogil=True)
def _exp(w):  # type: ignore[no-untyped-def]
    angle = math.sqrt(w[0] * w[0] + w[1] * w[1] + w[2] * w[2])
    k = np.array([[0.0, -w[2], w[1]], [w[2], 0.0, -w[0]], [-w[1], w[0], 0.0]])
    if angle < 1e-4:
        a, b = 1 - angle * angle / 6, 0.5 - angle * angle / 24
    else:
        a, b = math.sin(angle) / angle, (1 - math.cos(angle)) / (angle * angle)
    return np.eye(3) + a * k + b * (k @ k)


@njit(cache=True, nogil=True)
def _solve_spd(matrix, right):  # type: ignore[no-untyped-def]
    """Solution by Cholesky of a small system, scaled; second value False where it is singular."""
    n = len(right)
    scale = np.empty(n)
    for i in range(n):
        if not matrix[i, i] > 0:
            return right, False
        scale[i] = 1 / math.sqrt(matrix[i, i])
    lower = np.zeros((n, n))
    for i in range(n):
        for j in range(i + 1):
            total = matrix[i, j] * scale[i] * scale[j]
            for k in range(j):
                total -= lower[i, k] * lower[j, k]
            if i == j:
                if total < 1e-11:
                    return right, False
                lower[i, i] = math.sqrt(total)
            else:
                lower[i, j] = total / lower[j, j]
    x = np.empty(n)
    for i in range(n):
        total = right[i] * scale[i]
        for k in range(i):
            total -= lower[i, k] * x[k]
        x[i] = total / lower[i, i]
    for i in range(n - 1, -1, -1):
        total = x[i]
        for k in range(i + 1, n):
            total -= lower[k, i] * x[k]
        x[i] = total / lower[i, i]
    return x * scale, True


@njit(cache=True, nogil=True, forceinline=True, fastmath={"reassoc", "contract"})
def _marginalise(moved, field, weight, residual, measured_covariance):  # type: ignore[no-untyped-def]
    """One linear step in the field error's coefficients (k, unit prior) and the pose (6), in this order.

    Returns the step of the pose, its covariance, the part of it that the localizations' own noise makes
    (gain times their covariance), chi-square and the gain; ``residual`` is updated.
    """
    n, k = len(moved), field.shape[2]
    size = k + 6
    design, weighted = np.zeros((3 * n, size)), np.empty((3 * n, size))
    for i in range(n):
        v = moved[i]
        for a in range(3):
            row = design[3 * i + a]
            row[:k] = field[i, a]
            row[k + a] = 1.0
        design[3 * i, k + 4], design[3 * i, k + 5] = v[2], -v[1]
        design[3 * i + 1, k + 3], design[3 * i + 1, k + 5] = -v[2], v[0]
        design[3 * i + 2, k + 3], design[3 * i + 2, k + 4] = v[1], -v[0]
        for a in range(3):
            w0, w1, w2 = weight[i, a]
            for m in range(size):
                weighted[3 * i + a, m] = (
                    w0 * design[3 * i, m] + w1 * design[3 * i + 1, m] + w2 * design[3 * i + 2, m]
                )
    normal, right = np.dot(design.T, weighted), np.dot(residual.reshape(3 * n), weighted)
    for m in range(k):
        normal[m, m] += 1.0
    # Cholesky of the scaled matrix; the last six rows of its inverse are what the pose needs.
    scale = np.empty(size)
    for m in range(size):
        scale[m] = 1 / math.sqrt(normal[m, m])
    lower = np.zeros((size, size))
    for m in range(size):
        for b in range(m + 1):
            total = normal[m, b] * scale[m] * scale[b]
            for c in range(b):
                total -= lower[m, c] * lower[b, c]
            lower[m, b] = math.sqrt(total) if m == b else total / lower[b, b]
    rows = np.zeros((7, size))  # solutions for the six unit vectors of the pose, and for the right side
    for q in range(7):
        x = rows[q]
        if q < 6:
            x[k + q] = 1.0
        else:
            x[:] = right * scale
        for m in range(k if q < 6 else 0, size):
            total = x[m]
            for c in range(m):
                total -= lower[m, c] * x[c]
            x[m] = total / lower[m, m]
        for m in range(size - 1, -1, -1):
            x[m] /= lower[m, m]
            for c in range(m):
                x[c] -= lower[m, c] * x[m]
        for m in range(size):
            x[m] *= scale[m] * (scale[k + q] if q < 6 else 1.0)
    covariance = rows[:6, k:].copy()
    step = rows[6]
    gain = np.dot(rows[:6], weighted.T)
    spread = np.empty((6, 3 * n))
    for i in range(n):
        for q in range(6):
            for a in range(3):
                total = 0.0
                for b in range(3):
                    total += gain[q, 3 * i + b] * measured_covariance[i, b, a]
                spread[q, 3 * i + a] = total
    noise = np.dot(spread, gain.T)
    residual -= np.dot(design, step).reshape(n, 3)
    chi_square = 0.0
    for m in range(k):
        chi_square += step[m] * step[m]
    for i in range(n):
        for a in range(3):
            for b in range(3):
                chi_square += residual[i, a] * weight[i, a, b] * residual[i, b]
    return step[k:].copy(), covariance, noise, chi_square, gain


@njit(cache=True, nogil=True)
def _invert(s, full, out):  # type: ignore[no-untyped-def]
    """Inverse of a symmetric 3 x 3 matrix into ``out``, or of its x-y block with zeros in z."""
    if not full:
        determinant = s[0, 0] * s[1, 1] - s[0, 1] * s[0, 1]
        out[:] = 0.0
        out[0, 0], out[1, 1] = s[1, 1] / determinant, s[0, 0] / determinant
        out[0, 1] = out[1, 0] = -s[0, 1] / determinant
        return
    c00 = s[1, 1] * s[2, 2] - s[1, 2] * s[1, 2]
    c01 = s[0, 2] * s[1, 2] - s[0, 1] * s[2, 2]
    c02 = s[0, 1] * s[1, 2] - s[0, 2] * s[1, 1]
    determinant = s[0, 0] * c00 + s[0, 1] * c01 + s[0, 2] * c02
    out[0, 0], out[0, 1], out[0, 2] = c00, c01, c02
    out[1, 1] = s[0, 0] * s[2, 2] - s[0, 2] * s[0, 2]
    out[1, 2] = s[0, 1] * s[0, 2] - s[0, 0] * s[1, 2]
    out[2, 2] = s[0, 0] * s[1, 1] - s[0, 1] * s[0, 1]
    out[1, 0], out[2, 0], out[2, 1] = out[0, 1], out[0, 2], out[1, 2]
    for a in range(3):
        for b in range(3):
            out[a, b] /= determinant


@njit(cache=True, nogil=True)
def _turn(rotation, covariance, out):  # type: ignore[no-untyped-def]
    """``R P R^T`` into ``out``."""
    for a in range(3):
        r0, r1, r2 = rotation[a, 0], rotation[a, 1], rotation[a, 2]
        h0 = r0 * covariance[0, 0] + r1 * covariance[1, 0] + r2 * covariance[2, 0]
        h1 = r0 * covariance[0, 1] + r1 * covariance[1, 1] + r2 * covariance[2, 1]
        h2 = r0 * covariance[0, 2] + r1 * covariance[1, 2] + r2 * covariance[2, 2]
        for b in range(3):
            out[a, b] = h0 * rotation[b, 0] + h1 * rotation[b, 1] + h2 * rotation[b, 2]


@njit(cache=True, nogil=True)
def _gauss_newton(  # type: ignore[no-untyped-def]
    rotation, translation, body, body_covariance, measured, measured_covariance, spread, has_z,
    gate_xy, gate_z,
):  # fmt: skip
    n = len(body)
    rotation, translation = rotation.copy(), translation.copy()
    use = np.full(n, FULL, np.int64)
    residual, moved = np.empty((n, 3)), np.empty((n, 3))
    weight, variance, s = np.zeros((n, 3, 3)), np.empty((n, 3, 3)), np.empty((3, 3))
    distance_xy, distance_z = np.full(n, np.nan), np.full(n, np.nan)
    squares, freedom = np.zeros((n, 2)), np.zeros((n, 2))
    normal = np.zeros((6, 6))
    row, pull = np.empty(3), np.empty(3)

    # Start: z and the two tilts by least absolute deviations, x and y being matched already.
    for _ in range(20):
        normal3, right3 = np.zeros((3, 3)), np.zeros(3)
        for i in range(n):
            if not has_z[i]:
                continue
            for a in range(3):
                p = body[i]
                moved[i, a] = rotation[a, 0] * p[0] + rotation[a, 1] * p[1] + rotation[a, 2] * p[2]
            row[0], row[1], row[2] = 1.0, moved[i, 1], -moved[i, 0]
            difference = measured[i, 2] - moved[i, 2] - translation[2]
            sd = math.sqrt(measured_covariance[i, 2, 2] + body_covariance[i, 2, 2] + spread[i, 2, 2])
            w = 1 / (sd * max(sd, abs(difference)))
            for a in range(3):
                right3[a] += w * row[a] * difference
                for b in range(3):
                    normal3[a, b] += w * row[a] * row[b]
        step, ok = _solve_spd(normal3, right3)
        if not ok:
            return rotation, translation, use, residual, weight, squares, freedom, False
        translation[2] += step[0]
        rotation = _exp(np.array([step[1], step[2], 0.0])) @ rotation
        if abs(step[0]) < 1e-8 and abs(step[1]) + abs(step[2]) < 1e-4:
            break

    scale_xy = scale_z = math.inf
    ok = False
    for iteration in range(25):
        wide = max(1.0, 2.0 / 2.0**iteration)
        changed = False
        normal[:], right = 0.0, np.zeros(6)
        for i in range(n):
            p = body[i]
            for a in range(3):
                moved[i, a] = rotation[a, 0] * p[0] + rotation[a, 1] * p[1] + rotation[a, 2] * p[2]
                residual[i, a] = measured[i, a] - moved[i, a] - translation[a]
            _turn(rotation, body_covariance[i], s)
            for a in range(3):
                for b in range(3):
                    s[a, b] += measured_covariance[i, a, b] + spread[i, a, b]
            rx, ry, rz = residual[i]
            determinant = s[0, 0] * s[1, 1] - s[0, 1] * s[0, 1]
            distance_xy[i] = (s[1, 1] * rx * rx - 2 * s[0, 1] * rx * ry + s[0, 0] * ry * ry) / determinant
            distance_z[i] = rz * rz / s[2, 2] if has_z[i] else np.nan
            variance[i] = s
        # Covariances that claim too much must not throw away most particles: medians over all of them set
        # the scale, which may only shrink, so that outliers cannot talk their way in.
        scale_xy = min(scale_xy, math.sqrt(max(1.0, np.median(distance_xy) / 1.386)))
        scale_z = min(scale_z, math.sqrt(max(1.0, np.nanmedian(distance_z) / 0.455)))
        for i in range(n):
            rx, ry, rz = residual[i]
            state = FULL if has_z[i] else LATERAL
            if distance_xy[i] > (wide * gate_xy * scale_xy) ** 2:
                state = UNUSED
            elif state == FULL and distance_z[i] > (wide * gate_z * scale_z) ** 2:
                state = LATERAL
            changed = changed or state != use[i]
            use[i] = state
            if state == UNUSED:
                continue
            w = weight[i]
            _invert(variance[i], state == FULL, w)
            # J = [1, -hat(v)]: the blocks of J^T W J by cross products.
            v0, v1, v2 = moved[i]
            for a in range(3):
                w0, w1, w2 = w[a, 0], w[a, 1], w[a, 2]
                normal[a, 0] += w0
                normal[a, 1] += w1
                normal[a, 2] += w2
                h0, h1, h2 = w2 * v1 - w1 * v2, w0 * v2 - w2 * v0, w1 * v0 - w0 * v1  # -W hat(v), row a
                normal[a, 3] += h0
                normal[a, 4] += h1
                normal[a, 5] += h2
                force = w0 * rx + w1 * ry + w2 * rz
                right[a] += force
                # Row a of J^T W J below: hat(v) times the above.
                if a == 0:
                    for b, h in enumerate((h0, h1, h2)):
                        normal[4, 3 + b] += v2 * h
                        normal[5, 3 + b] -= v1 * h
                    right[4] += v2 * force
                    right[5] -= v1 * force
                elif a == 1:
                    for b, h in enumerate((h0, h1, h2)):
                        normal[3, 3 + b] -= v2 * h
                        normal[5, 3 + b] += v0 * h
                    right[3] -= v2 * force
                    right[5] += v0 * force
                else:
                    for b, h in enumerate((h0, h1, h2)):
                        normal[3, 3 + b] += v1 * h
                        normal[4, 3 + b] -= v0 * h
                    right[3] += v1 * force
                    right[4] -= v0 * force
        normal[3:, :3] = normal[:3, 3:].T
        step, ok = _solve_spd(normal, right)
        if not ok:
            break
        translation += step[:3]
        rotation = _exp(step[3:]) @ rotation
        small = np.abs(step[:3]).max() < 1e-11 and np.abs(step[3:]).max() < 1e-8
        if wide == 1.0 and small and not changed:
            break

    if not ok:
        return rotation, translation, use, residual, weight, squares, freedom, False
    covariance = np.linalg.inv(normal)
    count_z = 0
    for i in range(n):
        p = body[i]
        for a in range(3):
            moved[i, a] = rotation[a, 0] * p[0] + rotation[a, 1] * p[1] + rotation[a, 2] * p[2]
            residual[i, a] = measured[i, a] - moved[i, a] - translation[a]
        if use[i] == UNUSED:
            weight[i] = 0.0
            continue
        _pull(weight[i], moved[i], covariance, pull)
        squares[i, 0], freedom[i, 0] = distance_xy[i], max(2.0 - pull[0] - pull[1], 0.0)
        if use[i] == FULL:
            squares[i, 1], freedom[i, 1] = distance_z[i], max(1.0 - pull[2], 0.0)
            count_z += 1
        _turn(rotation, body_covariance[i], s)
        for a in range(3):
            for b in range(3):
                s[a, b] += measured_covariance[i, a, b]
        _invert(s, use[i] == FULL, weight[i])
    return rotation, translation, use, residual, weight, squares, freedom, count_z >= 3


@njit(cache=True, nogil=True)
def _pull(weight, v, covariance, out):  # type: ignore[no-untyped-def]
    """Diagonal of ``W J C J^T`` into ``out`` (3,): the leverage of one particle in x, y and z."""
    for a in range(3):
        w0, w1, w2 = weight[a, 0], weight[a, 1], weight[a, 2]
        row = (w0, w1, w2, w2 * v[1] - w1 * v[2], w0 * v[2] - w2 * v[0], w1 * v[0] - w0 * v[1])
        first, one, other = (0, 4, 5) if a == 0 else ((1, 3, 5) if a == 1 else (2, 3, 4))
        f_one = v[2] if a == 0 else (-v[2] if a == 1 else v[1])
        f_other = -v[1] if a == 0 else (v[0] if a == 1 else -v[0])
        total = 0.0
        for c in range(6):
            total += row[c] * (
                covariance[c, first] + f_one * covariance[c, one] + f_other * covariance[c, other]
            )
        out[a] = total
