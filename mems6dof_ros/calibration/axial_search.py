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

from mems6dof_ros.localization.vectors import LANES, load, log, splat, store, where_positive

Array = NDArray[np.float64]

_REFINEMENTS = 8
_SETTLED = 1e-4  # grid steps, about a hundredth of a nanometre
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
    scatter: Array,
) -> tuple[Array, Array, Array]:
    """Best and second-best defocus of n particles from k features.

    ``measured`` (n, k), ``noise`` (n, k, k); ``local`` (n, k, m): Chebyshev coefficients of each
    particle's curves over the whole ``grid`` (g,) m, equidistant, with ``basis`` (g, m), the polynomials
    there; ``inflation`` (n, k): of the standard deviations in ``scatter`` (g, k, k), which is interpolated
    linearly, for each particle; ``limits`` (n, 2): first and last grid point to consider.
    Returns defocus (n, 2) m, objective L (n, 2) and chi-square (n, 2); NaN where no second minimum is.
    """
    count, k = measured.shape
    points = len(grid)
    step = grid[1] - grid[0]
    defocus = np.full((count, 2), np.nan)
    objective = np.full((count, 2), np.nan)
    chi_square = np.full((count, 2), np.nan)
    # Grid points innermost: what is done alike for all of them runs in vectors.
    padded = (points + LANES - 1) // LANES * LANES
    basis_of, scatter_of = np.zeros((basis.shape[1], padded)), np.zeros((k * k, padded))
    basis_of[:, :points] = basis.T
    scatter_of[:, :points] = scatter.reshape(points, k * k).T
    level, spare = np.empty((1, padded)), np.empty((k * k + 3 * k, LANES))
    room, factor = np.empty((2, k)), np.empty((k, k))
    coefficients = np.empty((local.shape[2], k))
    for i in range(count):
        _levels(measured[i], noise[i], local[i], inflation[i], basis_of, scatter_of, spare, level)
        first, last = limits[i]
        coefficients[:] = local[i].T
        for slot, start in enumerate(_two_minima(level[0], first, last)):
            if start < 0:
                continue
            at, chi, level_here = _refine(
                start, first, last, measured[i], noise[i], coefficients, inflation[i], scatter, room, factor
            )
            if slot == 1 and level_here < objective[i, 0]:
                for found in (defocus, objective, chi_square):
                    found[i, 1] = found[i, 0]
                slot = 0
            defocus[i, slot] = grid[0] + at * step
            objective[i, slot] = level_here
            chi_square[i, slot] = chi
    return defocus, objective, chi_square


@njit(forceinline=True, **_OPTIONS)
def _two_minima(level: Array, first: int, last: int) -> tuple[float, float]:
    """Where ``level`` (g,) has its two lowest minima from ``first`` to ``last``, in grid steps, -1 for none:
    by the parabola through each and its neighbours."""
    lowest = second = -1.0
    least = runner_up = np.inf
    for g in range(first, last + 1):
        if (g > first and level[g] >= level[g - 1]) or (g < last and level[g] > level[g + 1]):
            continue
        at, bottom = float(g), level[g]
        if first < g < last:
            rise, bend = level[g + 1] - level[g - 1], level[g + 1] + level[g - 1] - 2 * level[g]
            at -= rise / (2 * bend)
            bottom -= rise * rise / (8 * bend)
        if bottom < least:
            second, runner_up = lowest, least
            lowest, least = at, bottom
        elif bottom < runner_up:
            second, runner_up = at, bottom
    return lowest, second


@njit(forceinline=True, **_OPTIONS)
def _refine(
    start: float,
    first: int,
    last: int,
    measured: Array,
    noise: Array,
    coefficients: Array,
    inflation: Array,
    scatter: Array,
    room: Array,
    factor: Array,
) -> tuple[float, float, float]:
    """The minimum near ``start`` by Gauss-Newton: where, in grid steps like it, chi-square there and L.

    ``coefficients`` (m, k) of the curves; ``room`` (2, k) and ``factor`` (k, k) are scratch."""
    terms, k = coefficients.shape
    residual, tangent = room[0], room[1]
    low, high = max(start - 1.0, float(first)), min(start + 1.0, float(last))
    scale = 2.0 / (len(scatter) - 1)
    at = start
    iteration = 0
    while True:
        residual[:] = measured
        tangent[:] = 0.0
        place = at * scale - 1.0
        before, here = 1.0, place  # T_0, T_1 and the derivatives
        slope_before, slope_here = 0.0, scale
        for m in range(terms):
            for a in range(k):
                residual[a] -= coefficients[m, a] * before
                tangent[a] += coefficients[m, a] * slope_before
            before, here, slope_before, slope_here = (
                here,
                2 * place * here - before,
                slope_here,
                2 * (scale * here + place * slope_here) - slope_before,
            )
        left = min(int(at), last - 1)
        t = at - left
        for a in range(k):
            for b in range(a + 1):
                factor[a, b] = noise[a, b] + inflation[a] * inflation[b] * (
                    (1 - t) * scatter[left, a, b] + t * scatter[left + 1, a, b]
                )
        log_det = _factorize(factor, k)
        chi, gain, information = _products(factor, residual, tangent, k)
        if iteration == _REFINEMENTS or information <= 0:
            break
        moved = min(max(at + gain / information, low), high)
        if abs(moved - at) < _SETTLED:
            break
        at = moved
        iteration += 1
    return at, chi, chi + log_det


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
            weighted[a] *= factor[a, a]
            information += weighted[a] * weighted[a]
        for a in range(k - 1, -1, -1):
            for c in range(a + 1, k):
                weighted[a] -= factor[c, a] * weighted[c]
            weighted[a] *= factor[a, a]
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
def _levels(
    measured: Array,
    noise: Array,
    local: Array,
    inflation: Array,
    basis: Array,
    scatter: Array,
    spare: Array,
    level: Array,
) -> None:
    """``level = r' C^-1 r + ln det C`` for ``C = noise + inflated scatter`` at all grid points, (1, g).

    ``basis`` (m, g), ``scatter`` (k k, g): a column for each grid point, padded to whole vectors.
    C = L D L' by rows, without roots; ``spare`` (k k + 3 k, LANES): L, then L D of the row at hand, 1 / D and
    L^-1 r.
    """
    k, terms = local.shape
    product, inverse, whitened = k * k, k * k + k, k * k + 2 * k
    for j in range(0, level.shape[1], LANES):
        determinant, squares = splat(1.0), splat(0.0)
        for a in range(k):
            residual = splat(measured[a])
            for m in range(terms):
                residual -= load(basis, m, j) * local[a, m]
            variance = load(scatter, a * k + a, j) * (inflation[a] * inflation[a]) + noise[a, a]
            for b in range(a):
                entry = load(scatter, a * k + b, j) * (inflation[a] * inflation[b]) + noise[a, b]
                for c in range(b):
                    entry -= load(spare, product + c, 0) * load(spare, b * k + c, 0)
                lower = entry * load(spare, inverse + b, 0)
                store(spare, product + b, 0, entry)
                store(spare, a * k + b, 0, lower)
                variance -= entry * lower
                residual -= lower * load(spare, whitened + b, 0)
            variance = where_positive(variance - _LEAST_VARIANCE, variance, splat(_LEAST_VARIANCE))
            determinant *= variance
            inverted = 1.0 / variance
            store(spare, inverse + a, 0, inverted)
            store(spare, whitened + a, 0, residual)
            squares += residual * residual * inverted
        store(level, 0, j, squares + log(determinant))


@njit(forceinline=True, **_OPTIONS)
def _factorize(matrix: Array, k: int) -> float:
    """Cholesky factor in place (lower triangle), its diagonal inverted; returns ln det."""
    determinant = 1.0
    for a in range(k):
        for b in range(a):
            total = matrix[a, b]
            for c in range(b):
                total -= matrix[a, c] * matrix[b, c]
            matrix[a, b] = total * matrix[b, b]
        total = matrix[a, a]
        for c in range(a):
            total -= matrix[a, c] * matrix[a, c]
        total = max(total, _LEAST_VARIANCE)
        determinant *= total
        matrix[a, a] = 1 / np.sqrt(total)
    return float(np.log(determinant))


@njit(forceinline=True, **_OPTIONS)
def _products(factor: Array, residual: Array, tangent: Array, k: int) -> tuple[float, float, float]:
    """r'C^-1 r, t'C^-1 r and t'C^-1 t from ``factor`` of C as in ``_factorize``; overwrites r and t."""
    chi = 0.0
    gain = 0.0
    information = 0.0
    for a in range(k):
        r = residual[a]
        t = tangent[a]
        for c in range(a):
            r -= factor[a, c] * residual[c]
            t -= factor[a, c] * tangent[c]
        residual[a] = r * factor[a, a]
        tangent[a] = t * factor[a, a]
        chi += residual[a] * residual[a]
        gain += tangent[a] * residual[a]
        information += tangent[a] * tangent[a]
    return chi, gain, information
