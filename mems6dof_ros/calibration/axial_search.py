"""Maximum likelihood in defocus: where on its curve does a particle's shape lie?

    L(u) = r' C(u)^-1 r + ln det C(u),   r = q - q_model(u),   C = fit noise + scatter of the model

is examined over the whole calibrated range, because two defoci on either side of focus can explain one
shape. The two best minima are refined; their difference in L tells how ambiguous the particle is.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]

_REFINEMENTS = 8
_LEAST_VARIANCE = 1e-20

# Sums may be reordered (vectors); NaN keeps its meaning.
_FAST = {"reassoc", "contract", "nsz", "arcp"}
_OPTIONS: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy", "fastmath": _FAST}


@njit(**_OPTIONS)
def search_defocus(
    measured: Array,
    noise: Array,
    local: Array,
    inflation: Array,
    limits: NDArray[np.int64],
    grid: Array,
    basis: Array,
    slope_basis: Array,
    scatter: Array,
) -> tuple[Array, Array, Array]:
    """Best and second-best defocus of n particles from k features.

    ``measured`` (n, k), ``noise`` (n, k, k); ``local`` (n, k, m): coefficients of each particle's curves;
    ``inflation`` (n, k): of the standard deviations in ``scatter``, for each particle;
    ``limits`` (n, 2): first and last grid point to consider;
    ``grid`` (g,) m, equidistant, with ``basis`` and ``slope_basis`` (g, m): the polynomials there and
    their derivatives per grid step; ``scatter`` (g, k, k). Between grid points basis and scatter are
    interpolated (cubic Hermite, linear).
    Returns defocus (n, 2) m, objective L (n, 2) and chi-square (n, 2); NaN where no second minimum is.
    """
    count, k = measured.shape
    points = len(grid)
    step = grid[1] - grid[0]
    defocus = np.full((count, 2), np.nan)
    objective = np.full((count, 2), np.nan)
    chi_square = np.full((count, 2), np.nan)
    # Grid points innermost: what is done alike for all of them runs in vectors.
    scatter_of = np.ascontiguousarray(scatter.transpose(1, 2, 0))
    basis_of, slope_basis_of = np.ascontiguousarray(basis.T), np.ascontiguousarray(slope_basis.T)
    curve = np.empty((k, points))
    slope = np.empty((k, points))
    level = np.empty(points)
    residuals, factors = np.empty((k, points)), np.empty((k, k, points))
    residual = np.empty(k)
    tangent = np.empty(k)
    factor = np.empty((k, k))
    for i in range(count):
        first, last = limits[i]
        _combine(local[i], basis_of, curve)
        _combine(local[i], slope_basis_of, slope)
        for a in range(k):
            for g in range(points):
                residuals[a, g] = measured[i, a] - curve[a, g]
        _levels(noise[i], scatter_of, inflation[i], residuals, factors, level)
        for g in range(first, last + 1):
            if (g > first and level[g] >= level[g - 1]) or (g < last and level[g] > level[g + 1]):
                continue
            low, high = max(g - 1.0, float(first)), min(g + 1.0, float(last))
            at = float(g)
            chi = 0.0
            log_det = 0.0
            for iteration in range(_REFINEMENTS + 1):
                left = min(int(at), last - 1)
                t = at - left
                for a in range(k):
                    y0, y1, d0, d1 = curve[a, left], curve[a, left + 1], slope[a, left], slope[a, left + 1]
                    c2 = 3 * (y1 - y0) - 2 * d0 - d1
                    c3 = 2 * (y0 - y1) + d0 + d1
                    residual[a] = measured[i, a] - (y0 + t * (d0 + t * (c2 + t * c3)))
                    tangent[a] = d0 + t * (2 * c2 + 3 * t * c3)
                    for b in range(a + 1):
                        factor[a, b] = noise[i, a, b] + inflation[i, a] * inflation[i, b] * (
                            (1 - t) * scatter[left, a, b] + t * scatter[left + 1, a, b]
                        )
                log_det = _factorize(factor, k)
                chi, gain, information = _products(factor, residual, tangent, k)
                if iteration == _REFINEMENTS or information <= 0:
                    break
                moved = min(max(at + gain / information, low), high)
                if abs(moved - at) < 1e-6:
                    break
                at = moved
            level_here = chi + log_det
            slot = 2
            if not level_here >= objective[i, 0]:
                defocus[i, 1], objective[i, 1], chi_square[i, 1] = (
                    defocus[i, 0],
                    objective[i, 0],
                    chi_square[i, 0],
                )
                slot = 0
            elif not level_here >= objective[i, 1]:
                slot = 1
            if slot < 2:
                defocus[i, slot] = grid[0] + at * step
                objective[i, slot] = level_here
                chi_square[i, slot] = chi
    return defocus, objective, chi_square


@njit(**_OPTIONS)
def linearize(
    noise: Array,
    local: Array,
    inflation: Array,
    defocus: Array,
    interval: tuple[float, float],
    used: NDArray[np.int64],
    nodes: Array,
    scatter: Array,
) -> tuple[Array, Array]:
    """The apparent lateral motion (n, 2) of n particles at their ``defocus`` (n,) m, and the covariance
    (n, 3, 3) m^2 of their corrected positions, linearised there.

    ``noise`` (n, f, f) of all features, of which ``used`` (k,) have told the defocus and the first two are
    the lateral motion; ``local`` (n, f, m): Chebyshev coefficients of each particle's curves over
    ``interval``; ``nodes`` (g,) m, equidistant, with ``scatter`` (g, f, f), interpolated linearly, of which
    ``inflation`` (n, f) multiplies the standard deviations.
    """
    count, f, terms = local.shape
    k = len(used)
    motion = np.empty((count, 2))
    covariance = np.empty((count, 3, 3))
    slope, total = np.empty(f), np.empty((f, f))
    factor, weighted = np.empty((k, k)), np.empty(k)
    jacobian, product = np.empty((3, f)), np.empty(f)
    scale = 2 / (interval[1] - interval[0])
    for i in range(count):
        at = (2 * defocus[i] - (interval[0] + interval[1])) / (interval[1] - interval[0])
        values = np.zeros(2)
        slope[:] = 0.0
        before, here = 1.0, at  # T_0, T_1 and the derivatives
        slope_before, slope_here = 0.0, 1.0
        for m in range(terms):
            for a in range(f):
                slope[a] += scale * local[i, a, m] * slope_before
            for a in range(2):
                values[a] += local[i, a, m] * before
            before, here, slope_before, slope_here = (
                here,
                2 * at * here - before,
                slope_here,
                2 * here + 2 * at * slope_here - slope_before,
            )
        motion[i] = values
        place = min(max((defocus[i] - nodes[0]) / (nodes[1] - nodes[0]), 0.0), len(nodes) - 1.0)
        left = min(int(place), len(nodes) - 2)
        for a in range(f):
            for b in range(f):
                total[a, b] = noise[i, a, b] + inflation[i, a] * inflation[i, b] * (
                    (1 - (place - left)) * scatter[left, a, b] + (place - left) * scatter[left + 1, a, b]
                )
        for a in range(k):
            for b in range(a + 1):
                factor[a, b] = total[used[a], used[b]]
        _factorize(factor, k)
        information = 0.0
        for a in range(k):  # forward, and then back
            weighted[a] = slope[used[a]]
            for c in range(a):
                weighted[a] -= factor[a, c] * weighted[c]
            weighted[a] /= factor[a, a]
            information += weighted[a] * weighted[a]
        for a in range(k - 1, -1, -1):
            for c in range(a + 1, k):
                weighted[a] -= factor[c, a] * weighted[c]
            weighted[a] /= factor[a, a]
        jacobian[:] = 0.0
        for a in range(k):
            gain = weighted[a] / information
            jacobian[2, used[a]] = gain
            jacobian[0, used[a]] = -slope[0] * gain
            jacobian[1, used[a]] = -slope[1] * gain
        jacobian[0, 0] += 1.0
        jacobian[1, 1] += 1.0
        for r in range(3):
            for b in range(f):
                product[b] = 0.0
                for a in range(f):
                    product[b] += jacobian[r, a] * total[a, b]
            for c in range(3):
                entry = 0.0
                for b in range(f):
                    entry += product[b] * jacobian[c, b]
                covariance[i, r, c] = entry
    return motion, covariance


@njit(forceinline=True, **_OPTIONS)
def _combine(coefficients: Array, basis: Array, curves: Array) -> None:
    """``curves = coefficients @ basis``."""
    curves[:] = 0.0
    for a in range(len(curves)):
        for m in range(len(basis)):
            c = coefficients[a, m]
            for g in range(curves.shape[1]):
                curves[a, g] += c * basis[m, g]


@njit(forceinline=True, **_OPTIONS)
def _levels(
    noise: Array, scatter: Array, inflation: Array, residuals: Array, factors: Array, levels: Array
) -> None:
    """``levels = r' C^-1 r + ln det C`` for ``C = noise + inflated scatter`` at every grid point.

    ``residuals`` (k, g), overwritten; ``scatter``, ``factors`` (k, k, g): lower Cholesky factors with their
    diagonals inverted, since products are faster than divisions.
    """
    k, points = residuals.shape
    determinant = np.ones(points)
    levels[:] = 0.0
    for a in range(k):
        diagonal = factors[a, a]
        factor = inflation[a] * inflation[a]
        for g in range(points):
            diagonal[g] = noise[a, a] + factor * scatter[a, a, g]
        for b in range(a):
            entry = factors[a, b]
            factor = inflation[a] * inflation[b]
            for g in range(points):
                entry[g] = noise[a, b] + factor * scatter[a, b, g]
            for c in range(b):
                for g in range(points):
                    entry[g] -= factors[a, c, g] * factors[b, c, g]
            for g in range(points):
                entry[g] *= factors[b, b, g]
                diagonal[g] -= entry[g] * entry[g]
                residuals[a, g] -= entry[g] * residuals[b, g]
        for g in range(points):
            variance = max(diagonal[g], _LEAST_VARIANCE)
            determinant[g] *= variance
            diagonal[g] = 1 / np.sqrt(variance)
            residuals[a, g] *= diagonal[g]
            levels[g] += residuals[a, g] * residuals[a, g]
    for g in range(points):
        levels[g] += np.log(determinant[g])


@njit(forceinline=True, **_OPTIONS)
def _factorize(matrix: Array, k: int) -> float:
    """Cholesky factor in place (lower triangle); returns ln det."""
    log_det = 0.0
    for a in range(k):
        for b in range(a + 1):
            total = matrix[a, b]
            for c in range(b):
                total -= matrix[a, c] * matrix[b, c]
            if a == b:
                total = max(total, _LEAST_VARIANCE)
                log_det += np.log(total)
                matrix[a, a] = np.sqrt(total)
            else:
                matrix[a, b] = total / matrix[b, b]
    return log_det


@njit(forceinline=True, **_OPTIONS)
def _products(factor: Array, residual: Array, tangent: Array, k: int) -> tuple[float, float, float]:
    """r'C^-1 r, t'C^-1 r and t'C^-1 t from the Cholesky factor of C; overwrites r and t."""
    chi = 0.0
    gain = 0.0
    information = 0.0
    for a in range(k):
        r = residual[a]
        t = tangent[a]
        for c in range(a):
            r -= factor[a, c] * residual[c]
            t -= factor[a, c] * tangent[c]
        residual[a] = r / factor[a, a]
        tangent[a] = t / factor[a, a]
        chi += residual[a] * residual[a]
        gain += tangent[a] * residual[a]
        information += tangent[a] * tangent[a]
    return chi, gain, information
