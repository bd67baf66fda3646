"""Compiled kernels of the fit: numbers in, numbers out, nothing else of the project inside.

All kernels release the GIL (threads over frames) and are cached on disk. Arguments of ``fit_windows``:

=============  ==================  =====================================================================
name           shape, type         content
=============  ==================  =====================================================================
image          (h, w) u1 or u2     pixels, ADU
starts         (n, 2)              positions: column and row, px
offset         (h, w) or (1, 1)    ADU
gain           (h, w) or (1, 1)    ADU per electron
read_variance  (h, w) or (1, 1)    electrons^2
saturation     number              ADU
window         odd number          side of the window, px
weighting      number              UNIFORM, RELATIVE, LIGHT, POISSON
kappa          number              RELATIVE only: variance floor over amplitude
parameters     (n, 7)              out: x, y, A, sigma_x, sigma_y, rho, B of the image; px, electrons
covariance     (n, 7, 7)           out
quality        (n, 4)              out: reduced chi-square, iterations, lines cut off, 1 if saturated
=============  ==================  =====================================================================

Inside, a window is flat, each row padded to a multiple of LANES so that every loop runs in whole
vectors; padding has weight 0. The parameters are iterated as ``theta = (x, y, A, ln sigma_x,
ln sigma_y, atanh rho, B)`` relative to the window's central pixel, which keeps widths positive and
``|rho| < 1`` without constraints.

Where the speed comes from. The exponent is quadratic, so that E of the next row is E times a ratio
which itself changes by a constant factor: two products per pixel instead of an exponential. Every
derivative is E times a quadratic polynomial (or 1 for the background): J'WJ and J'Wr follow from 22 + 7
weighted moments and a 7 x 7 transformation per window.
"""

from __future__ import annotations

import math
from typing import Any, TypeAlias

import numpy as np
from numba import njit
from numpy.typing import NDArray

UNIFORM, RELATIVE, LIGHT, POISSON = 0, 1, 2, 3

LANES = 8
VARIANCE_FLOOR = 0.01  # electrons^2, as in gaussian.py
LEAST_SIGMA = 0.7  # px; with LARGEST_ATANH and windows to 65 px no exponential overflows
LARGEST_ATANH = 1.8  # rho = 0.947
MOST_ITERATIONS, ROUGH_ITERATIONS = 60, 10
# Expected decrease of chi-square at which to stop, in units of chi-square per pixel: the last step is
# then about sqrt(TOLERANCE) standard deviations, and it is still taken.
TOLERANCE, ROUGH = 1e-4, 1e-3
MOST_WINDOWS, MOST_OFF_CENTRE = 6, 1.0  # times a window is placed; px from particle to its middle

Array: TypeAlias = NDArray[np.float64]
Image: TypeAlias = NDArray[np.generic]

# Sums may be reordered (vectors); only where no NaN or infinity can come may the compiler exclude them.
_FAST = {"reassoc", "contract", "nsz", "arcp"}
_FAST_FINITE = _FAST | {"nnan"}
_OPTIONS: dict[str, Any] = {"nogil": True, "cache": True, "error_model": "numpy"}


def pixels(image: Image) -> Image:
    """``image`` as the kernels take it: contiguous and read-only, since that is part of their signature."""
    view = np.ascontiguousarray(image).view()
    view.flags.writeable = False
    return view


@njit(fastmath=_FAST, **_OPTIONS)
def _shape(theta: Array, window: int, stride: int, shape: Array) -> None:
    """Fill ``shape`` with E, the Gaussian of unit amplitude, outwards from the central pixel."""
    half = window // 2
    x, y = theta[0], theta[1]
    rho = math.tanh(theta[5])
    k = 1 / (1 - rho * rho)
    sx, sy = math.exp(theta[3]), math.exp(theta[4])
    a, b, c = k / (sx * sx), -k * rho / (sx * sy), k / (sy * sy)
    # Central row, both ways at once. E(u+1)/E(u) is a ratio that changes by exp(-a) per column;
    # exp(-b u) is what a row's ratio to the next one has of the column.
    curve, turn, back = math.exp(-a), math.exp(-b), math.exp(b)
    right_ratio, left_ratio = math.exp(a * x - 0.5 * a + b * y), math.exp(-a * x - 0.5 * a - b * y)
    right = left = math.exp(-0.5 * (a * x * x + 2 * b * x * y + c * y * y))
    right_turn = left_turn = math.exp(b * x)
    row = half * stride
    down, up = np.empty(stride), np.empty(stride)
    shape[row + half], down[half] = right, right_turn
    for j in range(1, stride - half):
        right *= right_ratio
        right_ratio *= curve
        right_turn *= turn
        shape[row + half + j], down[half + j] = right, right_turn
        if j <= half:
            left *= left_ratio
            left_ratio *= curve
            left_turn *= back
            shape[row + half - j], down[half - j] = left, left_turn
    # From row to row, likewise.
    curve = math.exp(-c)
    down_ratio, up_ratio = math.exp(c * y - 0.5 * c), math.exp(-c * y - 0.5 * c)
    for j in range(stride):
        up[j] = up_ratio / down[j]
        down[j] *= down_ratio
    for i in range(1, half + 1):
        # Slices: the compiler sees that what is written is not what is read, and uses vectors.
        below, above = row + i * stride, row - i * stride
        line, last = shape[below : below + stride], shape[below - stride : below]
        for j in range(stride):
            line[j] = last[j] * down[j]
            down[j] *= curve
        line, last = shape[above : above + stride], shape[above + stride : above + 2 * stride]
        for j in range(stride):
            line[j] = last[j] * up[j]
            up[j] *= curve


@njit(fastmath=_FAST, **_OPTIONS)
def _weigh(
    theta: Array,
    data: Array,
    noise: Array,
    valid: Array,
    shape: Array,
    weighting: int,
    weights: Array,
    pulls: Array,
) -> float:
    """Second and first derivatives of the objective's half by the model: ``weights``, ``pulls``.

    ``noise``: the weights themselves where they are fixed (UNIFORM, RELATIVE), else the variance of the
    read noise. Returns the objective. Light-weighting differentiates the variance too where the model is
    the greater: with it frozen, steps and acceptance test disagree and fits do not converge.
    """
    amplitude, background = theta[2], theta[6]
    total = 0.0
    if weighting in (UNIFORM, RELATIVE):
        for k in range(data.size):
            r = data[k] - (amplitude * shape[k] + background)
            weights[k] = noise[k]
            pulls[k] = noise[k] * r
            total += pulls[k] * r
    elif weighting == POISSON:
        for k in range(data.size):
            if valid[k] > 0:
                mean = max(amplitude * shape[k] + background + noise[k], VARIANCE_FLOOR)
                count = max(data[k] + noise[k], VARIANCE_FLOOR)
                weights[k] = valid[k] / mean
                pulls[k] = valid[k] * (count / mean - 1)
                total += 2 * valid[k] * (mean - count - count * math.log(mean / count))
            else:
                weights[k] = 0.0
                pulls[k] = 0.0
    else:
        for k in range(data.size):
            model = amplitude * shape[k] + background
            r = data[k] - model
            greater = data[k] if r > 0 else model
            variance = greater + noise[k]
            variance = variance if variance > VARIANCE_FLOOR else VARIANCE_FLOOR
            chi = r / variance
            renewed = 1.0 if r > 0 else 1 + 0.5 * chi
            weights[k] = valid[k] * renewed * renewed / variance
            pulls[k] = valid[k] * chi * renewed
            total += valid[k] * r * chi
    return total


@njit(fastmath=_FAST, **_OPTIONS)
def _moments(shape: Array, u: Array, v: Array, weights: Array, moments: Array) -> None:
    """The 7 x 7 weighted products of (E, E u, E v, E u^2, E u v, E v^2, 1) from their 22 moments."""
    s00 = s10 = s01 = s20 = s11 = s02 = s30 = s21 = s12 = s03 = 0.0
    s40 = s31 = s22 = s13 = s04 = 0.0
    for k in range(shape.size):
        f = weights[k] * shape[k] * shape[k]
        fu, fv = f * u[k], f * v[k]
        uu, uv, vv = u[k] * u[k], u[k] * v[k], v[k] * v[k]
        fuu, fuv, fvv = f * uu, f * uv, f * vv
        s00 += f
        s10 += fu
        s01 += fv
        s20 += fuu
        s11 += fuv
        s02 += fvv
        s30 += fu * uu
        s21 += fu * uv
        s12 += fv * uv
        s03 += fv * vv
        s40 += fuu * uu
        s31 += fuu * uv
        s22 += fuu * vv
        s13 += fuv * vv
        s04 += fvv * vv
    t00 = t10 = t01 = t20 = t11 = t02 = w = 0.0
    for k in range(shape.size):
        f = weights[k] * shape[k]
        fu, fv = f * u[k], f * v[k]
        t00 += f
        t10 += fu
        t01 += fv
        t20 += fu * u[k]
        t11 += fu * v[k]
        t02 += fv * v[k]
        w += weights[k]
    moments[0] = (s00, s10, s01, s20, s11, s02, t00)
    moments[1] = (s10, s20, s11, s30, s21, s12, t10)
    moments[2] = (s01, s11, s02, s21, s12, s03, t01)
    moments[3] = (s20, s30, s21, s40, s31, s22, t20)
    moments[4] = (s11, s21, s12, s31, s22, s13, t11)
    moments[5] = (s02, s12, s03, s22, s13, s04, t02)
    moments[6] = (t00, t10, t01, t20, t11, t02, w)


@njit(fastmath=_FAST, **_OPTIONS)
def _gradient(shape: Array, u: Array, v: Array, pulls: Array, gradient: Array) -> None:
    """The seven products of the same functions with ``pulls``."""
    t00 = t10 = t01 = t20 = t11 = t02 = w = 0.0
    for k in range(shape.size):
        f = pulls[k] * shape[k]
        fu, fv = f * u[k], f * v[k]
        t00 += f
        t10 += fu
        t01 += fv
        t20 += fu * u[k]
        t11 += fu * v[k]
        t02 += fv * v[k]
        w += pulls[k]
    gradient[0], gradient[1], gradient[2] = t00, t10, t01
    gradient[3], gradient[4], gradient[5], gradient[6] = t20, t11, t02, w


@njit(**_OPTIONS)
def _transformation(theta: Array, t: Array) -> None:
    """Columns of ``t`` (7, 7): the derivative by each theta in the functions of ``_moments``."""
    x, y, amplitude = theta[0], theta[1], theta[2]
    rho = math.tanh(theta[5])
    k = 1 / (1 - rho * rho)
    sx, sy = math.exp(theta[3]), math.exp(theta[4])
    a, b, c = k / (sx * sx), -k * rho / (sx * sy), k / (sy * sy)
    t[:] = 0.0
    t[0, 0], t[1, 0], t[2, 0] = -amplitude * (a * x + b * y), amplitude * a, amplitude * b
    t[0, 1], t[1, 1], t[2, 1] = -amplitude * (b * x + c * y), amplitude * b, amplitude * c
    t[0, 2] = 1.0
    for column, p, q, r in (
        (3, a, b, 0.0),
        (4, 0.0, b, c),
        (5, -rho * a, (1 + rho * rho) * k / (sx * sy), -rho * c),
    ):
        # p (u - x)^2 + q (u - x)(v - y) + r (v - y)^2
        t[0, column] = amplitude * (p * x * x + q * x * y + r * y * y)
        t[1, column] = -amplitude * (2 * p * x + q * y)
        t[2, column] = -amplitude * (2 * r * y + q * x)
        t[3, column], t[4, column], t[5, column] = amplitude * p, amplitude * q, amplitude * r
    t[6, 6] = 1.0


@njit(**_OPTIONS)
def _normal(t: Array, moments: Array, normal: Array) -> None:
    """``normal = t' moments t`` (7, 7)."""
    half = np.empty((7, 7))
    for i in range(7):
        for j in range(7):
            s = 0.0
            for m in range(7):
                s += moments[i, m] * t[m, j]
            half[i, j] = s
    for i in range(7):
        for j in range(i + 1):
            s = 0.0
            for m in range(7):
                s += t[m, i] * half[m, j]
            normal[i, j] = s
            normal[j, i] = s


@njit(**_OPTIONS)
def _factorise(matrix: Array, damping: float, factor: Array) -> bool:
    """Cholesky factor of the matrix with its diagonal raised by ``damping``; False where singular."""
    for i in range(7):
        for j in range(i + 1):
            s = matrix[i, j]
            if i == j:
                s *= 1 + damping
            for m in range(j):
                s -= factor[i, m] * factor[j, m]
            if i == j:
                if not s > 1e-13 * matrix[i, i]:
                    return False
                factor[i, i] = math.sqrt(s)
            else:
                factor[i, j] = s / factor[j, j]
    return True


@njit(**_OPTIONS)
def _solve(factor: Array, right: Array, solution: Array) -> None:
    for i in range(7):
        s = right[i]
        for m in range(i):
            s -= factor[i, m] * solution[m]
        solution[i] = s / factor[i, i]
    for i in range(6, -1, -1):
        s = solution[i]
        for m in range(i + 1, 7):
            s -= factor[m, i] * solution[m]
        solution[i] = s / factor[i, i]


@njit(fastmath=_FAST, **_OPTIONS)
def _read_window(
    image: Image,
    column: int,
    row: int,
    offset: Array,
    gain: Array,
    read_variance: Array,
    window: int,
    stride: int,
    data: Array,
    read: Array,
    valid: Array,
) -> tuple[int, int]:
    """Electrons of the window about a pixel; what lies outside the image is not valid.

    Returns the lines cut off at the worst edge and the largest pixel, ADU.
    """
    height, width = image.shape
    half = window // 2
    valid[:] = 0.0
    data[:] = 0.0
    read[:] = read_variance[0, 0]
    top, bottom = max(row - half, 0), min(row + half, height - 1)
    left, right = max(column - half, 0), min(column + half, width - 1)
    maps = offset.size > 1 or gain.size > 1 or read_variance.size > 1
    least, scale = offset[0, 0], 1 / gain[0, 0]
    largest: Any = 0
    for i in range(top, bottom + 1):
        k = (i - row + half) * stride - column + half
        for j in range(left, right + 1):
            adu: Any = np.int64(image[i, j])
            largest = adu if adu > largest else largest
            data[k + j] = (adu - least) * scale
            valid[k + j] = 1.0
        if maps:
            for j in range(left, right + 1):
                o = offset[i, j] if offset.size > 1 else least
                g = gain[i, j] if gain.size > 1 else gain[0, 0]
                data[k + j] = (image[i, j] - o) / g
                read[k + j] = read_variance[i, j] if read_variance.size > 1 else read_variance[0, 0]
    cut = max(max(half - column, half - row), max(column + half - width + 1, row + half - height + 1))
    return max(cut, 0), largest


@njit(fastmath=_FAST, **_OPTIONS)
def _soften(x: float, y: float, window: int, stride: int, valid: Array) -> None:
    """Cut ``valid`` to the square of side ``window - 1`` about (x, y), edge pixels by the part inside.

    A window of whole pixels jumps by one as a particle moves; what its edge cuts from the tails of a
    defocused image then shifts the fit by half a standard deviation and more.
    """
    half = window // 2
    inside = np.empty(stride)
    for j in range(stride):
        inside[j] = min(max(half + 0.5 - abs(j - half - x), 0.0), 1.0)
    for i in range(window):
        part = min(max(half + 0.5 - abs(i - half - y), 0.0), 1.0)
        for k in range(stride):
            valid[i * stride + k] *= part * inside[k]


@njit(fastmath=_FAST_FINITE, **_OPTIONS)
def _start(data: Array, valid: Array, u: Array, v: Array, window: int, stride: int, theta: Array) -> bool:
    """First parameters from the window alone: border, peak, and moments above 30 % of it.

    A Gaussian cut at the fraction f of its height and lowered by it has 0.358 of its variance
    (f = 0.3): [1 - f (1 + L) - f L^2 / 2] / [1 - f - f L], L = -ln f. False without contrast.
    """
    half = window // 2
    background, count = 0.0, 0.0
    last = (window - 1) * stride
    for j in range(window):
        for k in (j, last + j, j * stride, j * stride + window - 1):
            background += valid[k] * data[k]
            count += valid[k]
    if count == 0:
        return False
    background /= count
    # The peak lies in the inner half: a mean of three pixels, against noise.
    peak = background
    for i in range(half // 2, window - half // 2):
        for k in range(i * stride + half // 2, i * stride + window - half // 2):
            peak = max(peak, (data[k - 1] + data[k] + data[k + 1]) / 3)
    level = background + 0.3 * (peak - background)
    m = mx = my = mxx = mxy = myy = 0.0
    for k in range(data.size):
        f = valid[k] * max(data[k] - level, 0.0)
        fu, fv = f * u[k], f * v[k]
        m += f
        mx += fu
        my += fv
        mxx += fu * u[k]
        mxy += fu * v[k]
        myy += fv * v[k]
    if not (peak > background and m > 0):
        return False
    x, y = mx / m, my / m
    vx = max((mxx / m - x * x) / 0.358, 1.0)
    vy = max((myy / m - y * y) / 0.358, 1.0)
    rho = (mxy / m - x * y) / 0.358 / math.sqrt(vx * vy)
    theta[0], theta[1], theta[2] = x, y, peak - background
    theta[3], theta[4] = 0.5 * math.log(vx), 0.5 * math.log(vy)
    theta[5] = math.atanh(min(max(rho, -0.7), 0.7))
    theta[6] = background
    return True


@njit(**_OPTIONS)
def _bounded_step(theta: Array, step: Array, window: int, trial: Array) -> bool:
    """``trial = theta + step``, the step shortened where a width or a position would leap."""
    longest = max(
        max(abs(step[0]), abs(step[1])) / 3, max(max(abs(step[3]), abs(step[4])), abs(step[5])) / 0.5
    )
    scale = 1 / longest if longest > 1 else 1.0
    for i in range(7):
        trial[i] = theta[i] + scale * step[i]
    low, high = math.log(LEAST_SIGMA), math.log(2.0 * window)
    trial[3] = min(max(trial[3], low), high)
    trial[4] = min(max(trial[4], low), high)
    trial[5] = min(max(trial[5], -LARGEST_ATANH), LARGEST_ATANH)
    return scale == 1.0


@njit(**_OPTIONS)
def _inside(theta: Array, window: int) -> bool:
    """Whether the parameters describe a particle, and no bound has been hit."""
    low, high = math.log(LEAST_SIGMA), math.log(2.0 * window)
    return (
        theta[2] > 0
        and low < theta[3] < high
        and low < theta[4] < high
        and abs(theta[5]) < LARGEST_ATANH
        and max(abs(theta[0]), abs(theta[1])) < 2
        and abs(theta[6]) < np.inf
    )


@njit(**_OPTIONS)
def _minimise(
    theta: Array,
    data: Array,
    noise: Array,
    valid: Array,
    u: Array,
    v: Array,
    window: int,
    stride: int,
    weighting: int,
    most: int,
    tolerance: float,
    work: Array,
) -> int:
    """Levenberg-Marquardt from ``theta`` in place. Returns the iterations; negative: no convergence."""
    shape, weights, pulls = work[0], work[1], work[2]
    moments, t, normal, factor = np.empty((7, 7)), np.empty((7, 7)), np.empty((7, 7)), np.empty((7, 7))
    raw, gradient, step, trial = np.empty(7), np.empty(7), np.empty(7), np.empty(7)
    pixels = max(valid.sum(), 8.0)
    damping = 0.0
    _shape(theta, window, stride, shape)
    objective = _weigh(theta, data, noise, valid, shape, weighting, weights, pulls)
    renew = True
    for iteration in range(1, most + 1):
        if renew:
            _moments(shape, u, v, weights, moments)
            _gradient(shape, u, v, pulls, raw)
            _transformation(theta, t)
            _normal(t, moments, normal)
            for i in range(7):
                s = 0.0
                for m in range(7):
                    s += t[m, i] * raw[m]
                gradient[i] = s
        while not _factorise(normal, damping, factor):
            damping = max(10 * damping, 1e-3)
            if not damping < 1e9:
                return -iteration
        _solve(factor, gradient, step)
        expected = 0.0
        for i in range(7):
            expected += gradient[i] * step[i]
        whole = _bounded_step(theta, step, window, trial)
        if whole and damping < 1e-2 and expected <= tolerance * objective / pixels:
            theta[:] = trial
            return iteration
        _shape(trial, window, stride, shape)
        found = _weigh(trial, data, noise, valid, shape, weighting, weights, pulls)
        renew = found <= objective
        if renew:
            theta[:] = trial
            objective = found
            damping = 0.1 * damping if damping > 1e-6 else 0.0
        else:
            damping = max(10 * damping, 1e-3)
            if damping > 1e9:
                return -iteration
    return -most


@njit(**_OPTIONS)
def _curvature(
    theta: Array, shape: Array, u: Array, v: Array, pulls: Array, spare: Array, curvature: Array
) -> None:
    """``curvature[i, j] = sum pulls d2G/(dtheta_i dtheta_j)``: what residuals add to the normal matrix.

    G_i = E T_i.m with the polynomials m and the columns T_i of the transformation; hence, since
    dE/dtheta_j = E T_j.m / A where j is not A or B,  G_ij = E (dT_i/dtheta_j).m + E (T_i.m)(T_j.m) / A.
    """
    for k in range(shape.size):
        spare[k] = pulls[k] / max(shape[k], 1e-150)  # times E^2 in _moments
    moments, raw = np.empty((7, 7)), np.empty(7)
    _moments(shape, u, v, spare, moments)
    moments[6], moments[:, 6] = 0.0, 0.0
    _gradient(shape, u, v, pulls, raw)
    t, after, before, moved = np.empty((7, 7)), np.empty((7, 7)), np.empty((7, 7)), np.empty(7)
    _transformation(theta, t)
    _normal(t, moments, curvature)
    curvature /= theta[2]
    for j in range(6):
        step = 1e-4 * (theta[2] if j == 2 else 1.0)
        moved[:] = theta
        moved[j] = theta[j] + step
        _transformation(moved, after)
        moved[j] = theta[j] - step
        _transformation(moved, before)
        for i in range(6):
            s = 0.0
            for m in range(6):
                s += raw[m] * (after[m, i] - before[m, i])
            if j == 2:
                curvature[i, j] = 0.0  # E does not depend on A
            curvature[i, j] += s / (2 * step)
    curvature[2, 2] = 0.0


@njit(**_OPTIONS)
def _uncertainty(
    theta: Array,
    data: Array,
    read: Array,
    noise: Array,
    valid: Array,
    u: Array,
    v: Array,
    window: int,
    stride: int,
    weighting: int,
    work: Array,
    covariance: Array,
) -> float:
    """Covariance of x, y, A, sigma_x, sigma_y, rho, B at the solution; returns reduced chi-square.

    The sandwich H^-1 M H^-1 of an estimate by weights w (White, Econometrica 50, 1, 1982) with
    H = J'wJ - sum w r d2G, M = J'w V w J and the pixel variance V = model + read noise. The second
    term of H matters where a Gaussian is only an approximation: without it widths and rho claim 12 %
    too little on physical images. Chi-square is Pearson's, with V: 1 for a matched model.
    """
    shape, weights, pulls, spare = work[0], work[1], work[2], work[3]
    _shape(theta, window, stride, shape)
    chi, pixels = 0.0, 0.0
    for k in range(data.size):
        model = theta[2] * shape[k] + theta[6]
        variance = max(model + read[k], VARIANCE_FLOOR)
        r = data[k] - model
        chi += valid[k] * r * r / variance
        pixels += valid[k]
        weights[k] = noise[k] if weighting in (UNIFORM, RELATIVE) else valid[k] / variance
        pulls[k] = weights[k] * r
    moments, t = np.empty((7, 7)), np.empty((7, 7))
    normal, middle, curvature, factor = np.empty((7, 7)), np.empty((7, 7)), np.empty((7, 7)), np.zeros((7, 7))
    _transformation(theta, t)
    _moments(shape, u, v, weights, moments)
    _normal(t, moments, normal)
    _curvature(theta, shape, u, v, pulls, spare, curvature)
    if not _factorise(normal - curvature, 0.0, factor) and not _factorise(normal, 0.0, factor):
        return np.nan
    for k in range(data.size):
        variance = max(theta[2] * shape[k] + theta[6] + read[k], VARIANCE_FLOOR)
        weights[k] *= weights[k] * variance
    _moments(shape, u, v, weights, moments)
    _normal(t, moments, middle)
    inverse, unit, column = np.empty((7, 7)), np.zeros(7), np.empty(7)
    for i in range(7):
        unit[:] = 0.0
        unit[i] = 1.0
        _solve(factor, unit, column)
        inverse[i] = column
    _normal(inverse, middle, covariance)
    rho = math.tanh(theta[5])
    scale = (1.0, 1.0, 1.0, math.exp(theta[3]), math.exp(theta[4]), 1 - rho * rho, 1.0)
    for i in range(7):
        for j in range(7):
            covariance[i, j] *= scale[i] * scale[j]
    return chi / max(pixels - 7, 1.0)


@njit(**_OPTIONS)
def fit_windows(
    image: Image,
    starts: Array,
    offset: Array,
    gain: Array,
    read_variance: Array,
    saturation: float,
    window: int,
    weighting: int,
    kappa: float,
    parameters: Array,
    covariance: Array,
    quality: Array,
) -> None:
    """Fit one Gaussian to the window about each start; NaN parameters where a fit fails.

    The window follows the particle, to a fraction of a pixel: neither where the detection put it nor
    where the particle lies between pixels moves the result.
    """
    height, width = image.shape
    half = window // 2
    stride = (window + LANES - 1) // LANES * LANES
    size = window * stride
    data, read, noise, valid = np.empty(size), np.empty(size), np.empty(size), np.empty(size)
    work, shape, theta = np.empty((4, size)), np.empty(size), np.empty(7)
    u, v = np.empty(size), np.empty(size)
    for k in range(size):
        u[k] = k % stride - half
        v[k] = k // stride - half
    for n in range(len(starts)):
        parameters[n] = np.nan
        covariance[n] = np.nan
        quality[n] = (np.nan, 0.0, 0.0, 0.0)
        if not (-0.5 <= starts[n, 0] < width - 0.5 and -0.5 <= starts[n, 1] < height - 0.5):
            continue
        column, row = round(starts[n, 0]), round(starts[n, 1])
        cut, largest = _read_window(
            image, column, row, offset, gain, read_variance, window, stride, data, read, valid
        )
        if not _start(data, valid, u, v, window, stride, theta):
            continue
        # First a rough uniform fit: a robust start for every weighting, the place of the window, and the
        # light that scales the relative weights. Then the fit itself.
        rough, iterations, done = True, 0, -1
        for _ in range(MOST_WINDOWS):
            move_x, move_y = round(theta[0]), round(theta[1])
            if move_x != 0 or move_y != 0:
                column, row = column + move_x, row + move_y
                if not (0 <= column < width and 0 <= row < height):
                    done = -1
                    break
                theta[0] -= move_x
                theta[1] -= move_y
            if move_x != 0 or move_y != 0 or done > 0:
                cut, largest = _read_window(
                    image, column, row, offset, gain, read_variance, window, stride, data, read, valid
                )
            if rough:
                rough = False
                iterations += abs(
                    _minimise(
                        theta,
                        data,
                        valid,
                        valid,
                        u,
                        v,
                        window,
                        stride,
                        UNIFORM,
                        ROUGH_ITERATIONS,
                        ROUGH,
                        work,
                    )
                )
                continue
            x, y = theta[0], theta[1]
            _soften(x, y, window, stride, valid)
            _shape(theta, window, stride, shape)
            for k in range(size):
                if weighting == UNIFORM:
                    noise[k] = valid[k]
                elif weighting == RELATIVE:
                    noise[k] = valid[k] / (shape[k] + kappa)
                else:
                    noise[k] = read[k]
            done = _minimise(
                theta, data, noise, valid, u, v, window, stride, weighting, MOST_ITERATIONS, TOLERANCE, work
            )
            iterations += abs(done)
            if done < 0 or max(abs(theta[0] - x), abs(theta[1] - y)) <= MOST_OFF_CENTRE:
                break
        quality[n, 1] = iterations
        if done < 0 or not _inside(theta, window):
            continue
        chi_square = _uncertainty(
            theta, data, read, noise, valid, u, v, window, stride, weighting, work, covariance[n]
        )
        quality[n, 0] = chi_square
        quality[n, 2] = cut
        quality[n, 3] = 1.0 if largest >= saturation else 0.0
        if math.isnan(chi_square):
            continue
        parameters[n, 0], parameters[n, 1] = column + theta[0], row + theta[1]
        parameters[n, 2], parameters[n, 6] = theta[2], theta[6]
        parameters[n, 3], parameters[n, 4] = math.exp(theta[3]), math.exp(theta[4])
        parameters[n, 5] = math.tanh(theta[5])
