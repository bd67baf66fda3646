"""Maximum likelihood of a particle's pixels: Fisher scoring in place, defocus, light and its own aberrations.

The image is a few principal components B_k whose amplitudes are curves of defocus, so that no Fourier
transform is needed here:

    mu = light sum_k [a_k(u) + sum_m n_m d_mk(u)] B_k(x - x0 - s_x u, y - y0 - s_y u) + background

with the chief-ray slope s and the particle's own departures n, unit normal by construction: they are what
the calibration saw particles differ in. Sub-pixel shifts use Lagrange interpolation of degree 5, ample
for images band-limited to less than half of the sampling. Read noise counts as a Poisson number of
its variance (Huang et al., Nat. Methods 10, 653, 2013). Covariance is the inverse Fisher information F^-1,
and where the model is wrong by the fraction e of the signal mu_s, in every pixel by itself,
F^-1 + F^-1 M F^-1 with M = sum e^2 mu_s^2 / mu^2 (d mu)(d mu)'.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Pixels by which the components are larger than the window, on each side.
MARGIN = 4
TAPS = 6
_ITERATIONS = 15
_TOLERANCE = 0.01  # of the deviance: a tenth of a standard deviation
_LEAST_MEAN = 0.1  # electrons
_LONGEST_U = 0.4e-6
_LONGEST_X = 0.7
_FARTHEST = 2.0  # px from the starting place

_OPTIONS: dict[str, Any] = {
    "cache": True,
    "nogil": True,
    "error_model": "numpy",
    "fastmath": {"reassoc", "contract", "nsz", "arcp"},
}


@njit(forceinline=True, **_OPTIONS)
def _taps(shift: float, value: Array, slope: Array) -> int:
    """Weights of the pixels ``first .. first + 5`` about a pixel for the value of an image moved by ``shift``
    px there, and for its derivative by the shift; returns ``first``."""
    whole = math.floor(-shift)
    t = -shift - whole
    for i in range(TAPS):
        numerator, derivative, denominator = 1.0, 0.0, 1.0
        for j in range(TAPS):
            if j != i:
                derivative = derivative * (t - (j - 2)) + numerator
                numerator *= t - (j - 2)
                denominator *= i - j
        value[i] = numerator / denominator
        slope[i] = -derivative / denominator
    return int(whole) - 2


@njit(forceinline=True, **_OPTIONS)
def _moved(source: Array, size: int, window: int, first: int, taps: Array, rows: Array, out: Array, at: int,
           taps_y: Array) -> None:  # fmt: skip
    """``out``: the window of ``source`` (size, size) filtered along x with ``taps``, along y with ``taps_y``;
    ``first`` and ``at``: first pixels of the taps along x and y."""
    origin = (size - window) // 2
    for r in range(size):
        line = rows[r]
        for c in range(window):
            total = 0.0
            for t in range(TAPS):
                total += taps[t] * source[r, c + origin + first + t]
            line[c] = total
    for r in range(window):
        line = out[r]
        line[:] = 0.0
        for t in range(TAPS):
            weight, source_row = taps_y[t], rows[r + origin + at + t]
            for c in range(window):
                line[c] += weight * source_row[c]


@njit(forceinline=True, **_OPTIONS)
def solve(matrix: Array, right: Array, solution: Array, inverse: Array) -> bool:
    """Solve by Cholesky with unit diagonal; also the inverse. False where singular."""
    n = len(right)
    scale = np.empty(n)
    factor = np.zeros((n, n))
    for i in range(n):
        if not matrix[i, i] > 0:
            return False
        scale[i] = 1 / math.sqrt(matrix[i, i])
    for i in range(n):
        for j in range(i + 1):
            s = matrix[i, j] * scale[i] * scale[j]
            for k in range(j):
                s -= factor[i, k] * factor[j, k]
            if i == j:
                if not s > 1e-12:
                    return False
                factor[i, i] = math.sqrt(s)
            else:
                factor[i, j] = s / factor[j, j]
    column = np.empty(n)
    for c in range(n):
        for i in range(n):
            s = 1.0 if i == c else 0.0
            for k in range(i):
                s -= factor[i, k] * column[k]
            column[i] = s / factor[i, i]
        for i in range(n - 1, -1, -1):
            s = column[i]
            for k in range(i + 1, n):
                s -= factor[k, i] * column[k]
            column[i] = s / factor[i, i]
        for i in range(n):
            inverse[i, c] = column[i] * scale[i] * scale[c]
    for i in range(n):
        s = 0.0
        for c in range(n):
            s += inverse[i, c] * right[c]
        solution[i] = s
    return True


@njit(forceinline=True, **_OPTIONS)
def render(
    x: float, y: float, u: float, own: Array, slope: Array, curves: Array, low: float, high: float,
    flat: Array, amplitude: Array, source: Array, rows: Array, tangent: Array,
) -> bool:  # fmt: skip
    """The image of unit light of a particle at ``x``, ``y`` px from the middle pixel and defocus ``u`` m,
    with departures ``own`` (m,), into ``tangent[3]``, its derivatives by x, y, u into ``tangent[:3]`` and by
    the modes into ``tangent[5:]``; ``curves`` (1 + m, k, d), ``flat`` (k, pixels of the components), the rest
    is scratch. False where it lies too far off."""
    groups, k_count, degree = curves.shape
    size, window = source.shape[1], tangent.shape[1]
    chebyshev, slope_chebyshev = np.empty(degree), np.empty(degree)
    tx, ty, sx, sy = np.empty(TAPS), np.empty(TAPS), np.empty(TAPS), np.empty(TAPS)
    shift_x = x + slope[0] * u
    shift_y = y + slope[1] * u
    if not (abs(shift_x) < _FARTHEST and abs(shift_y) < _FARTHEST):
        return False
    s = (2 * u - (low + high)) / (high - low)
    chebyshev[0], slope_chebyshev[0] = 1.0, 0.0
    chebyshev[1], slope_chebyshev[1] = s, 1.0
    for d in range(2, degree):
        chebyshev[d] = 2 * s * chebyshev[d - 1] - chebyshev[d - 2]
        slope_chebyshev[d] = 2 * chebyshev[d - 1] + 2 * s * slope_chebyshev[d - 1] - slope_chebyshev[d - 2]
    amplitude[:] = 0.0
    for k in range(k_count):
        for m in range(groups):
            a = 0.0
            b = 0.0
            for d in range(degree):
                a += curves[m, k, d] * chebyshev[d]
                b += curves[m, k, d] * slope_chebyshev[d]
            b *= 2 / (high - low)
            n_m = 1.0 if m == 0 else own[m - 1]
            amplitude[0, k] += n_m * a
            amplitude[1, k] += n_m * b
            if m > 0:
                amplitude[1 + m, k] = a
    for g in range(groups + 1):
        line = source[g].reshape(size * size)
        line[:] = 0.0
        for k in range(k_count):
            a = amplitude[g, k]
            component = flat[k]
            for p in range(size * size):
                line[p] += a * component[p]
    first, at = _taps(shift_x, tx, sx), _taps(shift_y, ty, sy)
    _moved(source[0], size, window, first, sx, rows, tangent[0], at, ty)
    _moved(source[0], size, window, first, tx, rows, tangent[1], at, sy)
    _moved(source[1], size, window, first, tx, rows, tangent[2], at, ty)
    _moved(source[0], size, window, first, tx, rows, tangent[3], at, ty)
    for m in range(1, groups):
        _moved(source[1 + m], size, window, first, tx, rows, tangent[4 + m], at, ty)
    return True


@njit(**_OPTIONS)
def maximise(
    image: NDArray[np.generic],
    offset: Array,
    gain: Array,
    read_variance: Array,
    window: int,
    starts: Array,
    slopes: Array,
    components: Array,
    curves: Array,
    interval: Array,
    misfit: float,
    parameters: Array,
    covariance: Array,
    quality: Array,
) -> None:
    """Fit n particles in ``image`` (h, w) ADU.

    ``starts`` (n, 3): column and row px, defocus m; ``slopes`` (n, 2) px/m; ``components`` (k, s, s) with
    s = window + 2 MARGIN; ``curves`` (n, 1 + m, k, d): Chebyshev coefficients of the amplitudes and of their
    changes by each of m modes, over ``interval`` (2,) m. ``misfit``: e, see above. ``offset``, ``gain``,
    ``read_variance``: maps or (1, 1).
    Out: ``parameters`` (n, 5 + m): column, row, defocus m, light electrons, background, modes; NaN where it
    fails; ``covariance`` (n, 3, 3) of the first three; ``quality`` (n, 4): deviance with the modes' prior,
    Pearson's chi-square, number of pixels, sum of mu_s^2 / mu.
    """
    count, groups, k_count, _ = curves.shape
    modes = groups - 1
    size = components.shape[1]
    n_par = 5 + modes
    height, width = image.shape
    half = window // 2
    low, high = interval[0], interval[1]
    data = np.empty((window, window))
    read = np.empty((window, window))
    valid = np.empty((window, window))
    amplitude = np.empty((groups + 1, k_count))
    source = np.empty((groups + 1, size, size))
    rows = np.empty((size, window))
    # Derivatives by column, row, defocus, light, background (one), modes.
    tangent = np.empty((n_par, window, window))
    normal, inverse = np.empty((n_par, n_par)), np.empty((n_par, n_par))
    gradient, step, theta, last = np.empty(n_par), np.empty(n_par), np.empty(n_par), np.empty(n_par)
    mean = np.empty((window, window))
    flat = components.reshape(k_count, size * size)
    for i in range(count):
        parameters[i] = np.nan
        covariance[i] = np.nan
        quality[i] = np.nan
        if math.isnan(starts[i, 0]) or math.isnan(starts[i, 1]) or math.isnan(starts[i, 2]):
            continue
        column, row = round(starts[i, 0]), round(starts[i, 1])
        pixels = 0.0
        for r in range(window):
            for c in range(window):
                y, x = row - half + r, column - half + c
                data[r, c] = valid[r, c] = 0.0
                read[r, c] = read_variance[0, 0]
                if 0 <= y < height and 0 <= x < width:
                    o = offset[y, x] if offset.size > 1 else offset[0, 0]
                    g = gain[y, x] if gain.size > 1 else gain[0, 0]
                    if read_variance.size > 1:
                        read[r, c] = read_variance[y, x]
                    data[r, c] = (np.int64(image[y, x]) - o) / g + read[r, c]
                    valid[r, c] = 1.0
                    pixels += 1.0
        if pixels < 0.5 * window * window:
            continue
        theta[:] = 0.0
        theta[2] = min(max(starts[i, 2], low), high)
        theta[0] = starts[i, 0] - column
        theta[1] = starts[i, 1] - row
        last[:] = theta
        step[:] = 0.0
        deviance = np.inf
        chi = 0.0
        done = False
        expected = 0.0
        for iteration in range(_ITERATIONS):
            if not render(
                theta[0], theta[1], theta[2], theta[5:], slopes[i], curves[i], low, high, flat, amplitude,
                source, rows, tangent,
            ):  # fmt: skip
                break
            unit = tangent[3]
            if iteration == 0:
                # First light and background by least squares.
                s1 = sm = smm = sd = smd = 0.0
                for r in range(window):
                    for c in range(window):
                        v = valid[r, c]
                        d0 = data[r, c] - read[r, c]
                        s1 += v
                        sm += v * unit[r, c]
                        smm += v * unit[r, c] * unit[r, c]
                        sd += v * d0
                        smd += v * d0 * unit[r, c]
                theta[3] = (s1 * smd - sm * sd) / (s1 * smm - sm * sm)
                theta[4] = (sd - theta[3] * sm) / s1
                last[3], last[4] = theta[3], theta[4]
                if not theta[3] > 0:
                    break
            light, background = theta[3], theta[4]
            found = 0.0
            chi = 0.0
            for m in range(modes):
                found += theta[5 + m] * theta[5 + m]
            for r in range(window):
                for c in range(window):
                    mu = max(light * unit[r, c] + background + read[r, c], _LEAST_MEAN)
                    mean[r, c] = mu
                    n_c = max(data[r, c], _LEAST_MEAN)
                    found += valid[r, c] * 2 * (mu - n_c + n_c * math.log(n_c / mu))
                    chi += valid[r, c] * (data[r, c] - mu) ** 2 / mu
            if found > deviance + _TOLERANCE:
                # Too far: half the way back.
                for p in range(n_par):
                    step[p] *= 0.5
                    theta[p] = last[p] + step[p]
                continue
            deviance = found
            for r in range(window):
                for c in range(window):
                    tangent[0, r, c] *= light
                    tangent[1, r, c] *= light
                    tangent[2, r, c] *= light
                    tangent[2, r, c] += slopes[i, 0] * tangent[0, r, c] + slopes[i, 1] * tangent[1, r, c]
                    for m in range(modes):
                        tangent[5 + m, r, c] *= light
                    tangent[4, r, c] = 1.0
            normal[:] = 0.0
            gradient[:] = 0.0
            for r in range(window):
                for c in range(window):
                    mean[r, c] = valid[r, c] / mean[r, c]
            for p in range(n_par):
                for r in range(window):
                    g_sum = 0.0
                    for c in range(window):
                        g_sum += mean[r, c] * tangent[p, r, c] * data[r, c] - valid[r, c] * tangent[p, r, c]
                    gradient[p] += g_sum
                for q in range(p + 1):
                    total = 0.0
                    for r in range(window):
                        for c in range(window):
                            total += mean[r, c] * tangent[p, r, c] * tangent[q, r, c]
                    normal[p, q] = total
                    normal[q, p] = total
            for m in range(modes):
                normal[5 + m, 5 + m] += 1.0
                gradient[5 + m] -= theta[5 + m]
            if not solve(normal, gradient, step, inverse):
                break
            expected = 0.0
            for p in range(n_par):
                expected += gradient[p] * step[p]
            longest = max(max(abs(step[0]), abs(step[1])) / _LONGEST_X, abs(step[2]) / _LONGEST_U)
            for p in range(n_par):
                last[p] = theta[p]
                if longest > 1:
                    step[p] /= longest
                theta[p] += step[p]
            theta[2] = min(max(theta[2], low), high)
            if longest <= 1 and expected < _TOLERANCE:
                done = True
                break
            if (theta[2] == low or theta[2] == high) and last[2] == theta[2]:
                done = True
                break
        if not done:
            continue
        parameters[i] = theta
        parameters[i, 0] += column
        parameters[i, 1] += row
        for p in range(3):
            for q in range(3):
                covariance[i, p, q] = inverse[p, q]
        # ``mean`` holds 1 / mu, ``tangent[3]`` the image of unit light.
        signal = 0.0
        for p in range(n_par):
            for q in range(p + 1):
                total = 0.0
                for r in range(window):
                    for c in range(window):
                        s = light * unit[r, c] * mean[r, c]
                        total += s * s * tangent[p, r, c] * tangent[q, r, c]
                normal[p, q] = misfit * misfit * total
                normal[q, p] = normal[p, q]
        for r in range(window):
            for c in range(window):
                signal += light * light * unit[r, c] * unit[r, c] * mean[r, c]
        for p in range(3):
            for q in range(3):
                for a in range(n_par):
                    for b in range(n_par):
                        covariance[i, p, q] += inverse[p, a] * normal[a, b] * inverse[b, q]
        quality[i, 3] = signal
        quality[i, 0] = deviance - expected
        quality[i, 1] = chi
        quality[i, 2] = pixels
