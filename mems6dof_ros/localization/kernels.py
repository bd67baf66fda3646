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

Inside, a window is flat, each row padded to a multiple of LANES; padding has weight 0. The parameters are
iterated as ``theta = (x, y, A, ln sigma_x, ln sigma_y, atanh rho, B)`` relative to the window's central
pixel, which keeps widths positive and ``|rho| < 1`` without constraints.

Where the speed comes from. The exponent is quadratic, so that E of the next row is E times a ratio
which itself changes by a constant factor: two products per pixel instead of an exponential. Every
derivative is E times a quadratic polynomial (or 1 for the background): J'WJ and J'Wr follow from 22 + 7
weighted moments and a 7 x 7 transformation per window. One pass over the pixels, eight columns at a time,
does all of it: E, model, weights, objective, and the sums over each column's rows from which the moments
follow, in registers.
"""

from __future__ import annotations

import math
from typing import Any, TypeAlias

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mems6dof_ros.localization.vectors import LANES, largest, load, log, splat, store, total, where_positive

UNIFORM, RELATIVE, LIGHT, POISSON = 0, 1, 2, 3
# What a pass over the pixels is for: to minimise with fixed weights, or with those that LIGHT and POISSON
# have at the present parameters, or to find one of the parts of the uncertainty.
FIXED, INFORMATION, SCATTER, BENT = 1, 4, 5, 6

LEAST_SHAPE = 1e-150
VARIANCE_FLOOR = 0.01  # electrons^2, as in gaussian.py
LEAST_SIGMA = 0.7  # px; with LARGEST_ATANH and windows to 65 px no exponential overflows
LARGEST_ATANH = 1.8  # rho = 0.947
MOST_ITERATIONS, ROUGH_ITERATIONS = 60, 10
# Expected decrease of chi-square at which to stop, in units of chi-square per pixel: the last step is
# then about sqrt(TOLERANCE) standard deviations, and it is still taken.
TOLERANCE, ROUGH = 1e-3, 1e-2
MOST_WINDOWS, MOST_OFF_CENTRE = 6, 1.0  # times a window is placed; px from particle to its middle

Array: TypeAlias = NDArray[np.float64]
Image: TypeAlias = NDArray[np.generic]

# Sums may be reordered (vectors). What is called so from compiled code must be inlined: a process that
# compiles it calls another copy than one that loads it from the cache, and the last digits would differ.
# Only where no NaN or infinity can come may the compiler exclude them.
_FAST = {"reassoc", "contract", "nsz", "arcp"}
_FAST_FINITE = _FAST | {"nnan"}
_OPTIONS: dict[str, Any] = {"nogil": True, "cache": True, "error_model": "numpy"}


def pixels(image: Image) -> Image:
    """``image`` as the kernels take it: contiguous and read-only, since that is part of their signature."""
    view = np.ascontiguousarray(image).view()
    view.flags.writeable = False
    return view


# Every window has ``field`` (4, size), of each pixel: electrons; variance of the read noise; how much of it
# counts; weights of the fit where they are fixed. And ``columns`` (23, stride), of each column: the
# factors by column and row of what counts; E in the central row, and its ratios to the rows below and above;
# the sums of ``_evaluate``; the powers 0 to 4 of u. Few arrays, since each costs at every call.
DATA, READ, VALID, WEIGHTS = 0, 1, 2, 3
PART, CENTRE, DOWN, UP, SUMS, POWERS = 0, 2, 3, 4, 5, 18
_FIELDS, _COLUMNS = 4, 23

_BINOMIAL = ((1, 0, 0, 0, 0), (1, 1, 0, 0, 0), (1, 2, 1, 0, 0), (1, 3, 3, 1, 0), (1, 4, 6, 4, 1))


@njit(**_OPTIONS)
def _make_field(side: int, read_variance: float) -> Array:
    field = np.zeros((_FIELDS, side * ((side + LANES - 1) // LANES * LANES)))
    field[READ] = read_variance
    return field


@njit(**_OPTIONS)
def _make_columns(side: int) -> Array:
    columns = np.zeros((_COLUMNS, (side + LANES - 1) // LANES * LANES))
    for power in range(5):
        for j in range(columns.shape[1]):
            columns[POWERS + power, j] = float(j - side // 2) ** power
    return columns


@njit(**_OPTIONS)
def _to_theta(parameters: Array, column: int, row: int, theta: Array) -> None:
    """``theta`` relative to a pixel from x, y, A, sigma_x, sigma_y, rho, B of the image."""
    theta[0], theta[1] = parameters[0] - column, parameters[1] - row
    theta[2], theta[6] = parameters[2], parameters[6]
    theta[3], theta[4] = math.log(parameters[3]), math.log(parameters[4])
    theta[5] = math.atanh(parameters[5])


# Passes over the pixels ------------------------------------------------------------------------------


@njit(fastmath=_FAST, forceinline=True, **_OPTIONS)
def _central_row(theta: Array, side: int, columns: Array) -> float:
    """E in the central row, and its ratios to the rows below and above, into ``columns``.

    From row to row either ratio changes by the factor that is returned.
    """
    stride, half = columns.shape[1], side // 2
    x, y = theta[0], theta[1]
    rho = math.tanh(theta[5])
    k = 1 / (1 - rho * rho)
    sx, sy = math.exp(theta[3]), math.exp(theta[4])
    a, b, c = k / (sx * sx), -k * rho / (sx * sy), k / (sy * sy)
    # Both ways at once. E(u+1)/E(u) is a ratio that changes by exp(-a) per column; exp(-b u) is what a
    # row's ratio to the next one has of the column.
    curve, turn, back = math.exp(-a), math.exp(-b), math.exp(b)
    right_ratio, left_ratio = math.exp(a * x - 0.5 * a + b * y), math.exp(-a * x - 0.5 * a - b * y)
    right = left = math.exp(-0.5 * (a * x * x + 2 * b * x * y + c * y * y))
    right_turn = left_turn = math.exp(b * x)
    columns[CENTRE, half], columns[DOWN, half] = right, right_turn
    for j in range(1, stride - half):
        right *= right_ratio
        right_ratio *= curve
        right_turn *= turn
        columns[CENTRE, half + j], columns[DOWN, half + j] = right, right_turn
        if j <= half:
            left *= left_ratio
            left_ratio *= curve
            left_turn *= back
            columns[CENTRE, half - j], columns[DOWN, half - j] = left, left_turn
    down_ratio, up_ratio = math.exp(c * y - 0.5 * c), math.exp(-c * y - 0.5 * c)
    for j in range(0, stride, LANES):
        turns = load(columns, DOWN, j)
        store(columns, DOWN, j, turns * down_ratio)
        store(columns, UP, j, up_ratio / turns)
    return math.exp(-c)


@njit(forceinline=True, **_OPTIONS)
def _floored(variance: Any) -> Any:
    return where_positive(variance - VARIANCE_FLOOR, variance, splat(VARIANCE_FLOOR))


@njit(fastmath=_FAST, forceinline=True, **_OPTIONS)
def _weigh(kind: int, shape: Any, field: Array, k: int, amplitude: float, background: float) -> Any:
    """Of eight pixels from ``k`` on: second and first derivatives by the model of half the objective, and the
    objective.

    Light-weighting differentiates the variance too where the model is the greater: with it frozen,
    steps and acceptance test disagree and fits do not converge.
    """
    model = shape * amplitude + background
    count = load(field, DATA, k)
    r = count - model
    if kind == FIXED:
        weight = load(field, WEIGHTS, k)
        pull = weight * r
        return weight, pull, pull * r
    inside, noise = load(field, VALID, k), load(field, READ, k)
    if kind == LIGHT:
        inverse = 1.0 / _floored(where_positive(r, count, model) + noise)
        renewed = where_positive(r, splat(1.0), r * inverse * 0.5 + 1.0)
        weight = inside * inverse * renewed
        pull = weight * r
        return weight * renewed, pull, inside * inverse * r * r
    if kind == POISSON:
        mean, count = _floored(model + noise), _floored(count + noise)
        ratio = count / mean
        return inside / mean, inside * (ratio - 1.0), inside * (mean - count + count * log(ratio)) * 2.0
    weight, variance = load(field, WEIGHTS, k), _floored(model + noise)
    if kind == INFORMATION:
        return weight, weight * r, inside * r * r / variance
    if kind == SCATTER:
        return weight * weight * variance, splat(0.0), splat(0.0)
    # BENT: _evaluate multiplies it by E^2.
    return weight * r / where_positive(shape - LEAST_SHAPE, shape, splat(LEAST_SHAPE)), splat(0.0), splat(0.0)


@njit(fastmath=_FAST, forceinline=True, **_OPTIONS)
def _evaluate(kind: int, theta: Array, side: int, field: Array, columns: Array) -> float:
    """The objective; and in ``columns``, for each column, sums over its rows of

    w E^2 v^0...4, w E v^0...2, w, p E v^0...2, p

    with the weights w and pulls p of ``_weigh``. Rows go outwards from the central one, two at a time.
    """
    stride, half = columns.shape[1], side // 2
    amplitude, background = theta[2], theta[6]
    curve = splat(_central_row(theta, side, columns))
    objective = splat(0.0)
    for j in range(0, stride, LANES):
        k = half * stride + j
        below = above = load(columns, CENTRE, j)
        down, up = load(columns, DOWN, j), load(columns, UP, j)
        w, p, loss = _weigh(kind, below, field, k, amplitude, background)
        objective += loss
        w0, t0, p0, q0 = w, w * below, p, p * below
        s0 = t0 * below
        s1 = s2 = s3 = s4 = t1 = t2 = q1 = q2 = splat(0.0)
        for i in range(1, half + 1):
            v, vv = float(i), float(i * i)
            below *= down
            down *= curve
            k = (half + i) * stride + j
            w, p, loss = _weigh(kind, below, field, k, amplitude, background)
            above *= up
            up *= curve
            k = (half - i) * stride + j
            w_up, p_up, loss_up = _weigh(kind, above, field, k, amplitude, background)
            objective += loss + loss_up
            w0 += w + w_up
            p0 += p + p_up
            t, t_up = w * below, w_up * above
            s, s_up = t * below, t_up * above
            q, q_up = p * below, p_up * above
            even, odd = s + s_up, (s - s_up) * v
            s0 += even
            s1 += odd
            s2 += even * vv
            s3 += odd * vv
            s4 += even * (vv * vv)
            even = t + t_up
            t0 += even
            t1 += (t - t_up) * v
            t2 += even * vv
            even = q + q_up
            q0 += even
            q1 += (q - q_up) * v
            q2 += even * vv
        m = SUMS
        for column in (s0, s1, s2, s3, s4, t0, t1, t2, w0, q0, q1, q2, p0):
            store(columns, m, j, column)
            m += 1
    return total(objective)


@njit(fastmath=_FAST, forceinline=True, **_OPTIONS)
def _sum(columns: Array, which: int, power: int) -> float:
    """One of the sums of ``_evaluate`` times a power of u, over the columns."""
    result = splat(0.0)
    for j in range(0, columns.shape[1], LANES):
        result += load(columns, SUMS + which, j) * load(columns, POWERS + power, j)
    return total(result)


@njit(**_OPTIONS)
def _moments(columns: Array, moments: Array) -> None:
    """The 7 x 7 weighted products of (E, E u, E v, E u^2, E u v, E v^2, 1) from their 22 moments."""
    s00, s10, s20, s30, s40 = (
        _sum(columns, 0, 0),
        _sum(columns, 0, 1),
        _sum(columns, 0, 2),
        _sum(columns, 0, 3),
        _sum(columns, 0, 4),
    )
    s01, s11, s21, s31 = _sum(columns, 1, 0), _sum(columns, 1, 1), _sum(columns, 1, 2), _sum(columns, 1, 3)
    s02, s12, s22 = _sum(columns, 2, 0), _sum(columns, 2, 1), _sum(columns, 2, 2)
    s03, s13 = _sum(columns, 3, 0), _sum(columns, 3, 1)
    s04 = _sum(columns, 4, 0)
    t00, t10, t20 = _sum(columns, 5, 0), _sum(columns, 5, 1), _sum(columns, 5, 2)
    t01, t11 = _sum(columns, 6, 0), _sum(columns, 6, 1)
    t02 = _sum(columns, 7, 0)
    w = _sum(columns, 8, 0)
    moments[0] = (s00, s10, s01, s20, s11, s02, t00)
    moments[1] = (s10, s20, s11, s30, s21, s12, t10)
    moments[2] = (s01, s11, s02, s21, s12, s03, t01)
    moments[3] = (s20, s30, s21, s40, s31, s22, t20)
    moments[4] = (s11, s21, s12, s31, s22, s13, t11)
    moments[5] = (s02, s12, s03, s22, s13, s04, t02)
    moments[6] = (t00, t10, t01, t20, t11, t02, w)


@njit(**_OPTIONS)
def _gradient(columns: Array, gradient: Array) -> None:
    """The seven products of the same functions with the pulls."""
    gradient[0], gradient[1], gradient[3] = _sum(columns, 9, 0), _sum(columns, 9, 1), _sum(columns, 9, 2)
    gradient[2], gradient[4], gradient[5] = _sum(columns, 10, 0), _sum(columns, 10, 1), _sum(columns, 11, 0)
    gradient[6] = _sum(columns, 12, 0)


@njit(fastmath=_FAST, forceinline=True, **_OPTIONS)
def _fix_weights(relative: bool, kappa: float, theta: Array, side: int, field: Array, columns: Array) -> None:
    """Weights: valid / (E + kappa), else valid / (variance of the model and the read noise)."""
    stride, half = columns.shape[1], side // 2
    amplitude, background = theta[2], theta[6]
    curve = splat(_central_row(theta, side, columns))
    for j in range(0, stride, LANES):
        for way in (1, -1):
            shape, ratio = load(columns, CENTRE, j), load(columns, DOWN if way > 0 else UP, j)
            for i in range(half + 1):
                k = (half + way * i) * stride + j
                if relative:
                    variance = shape + kappa
                else:
                    variance = _floored(shape * amplitude + background + load(field, READ, k))
                store(field, WEIGHTS, k, load(field, VALID, k) / variance)
                shape *= ratio
                ratio *= curve


# Windows ---------------------------------------------------------------------------------------------


@njit(fastmath=_FAST, forceinline=True, **_OPTIONS)
def _read_window(
    image: Image,
    column: int,
    row: int,
    offset: Array,
    gain: Array,
    read_variance: Array,
    side: int,
    field: Array,
    columns: Array,
) -> tuple[int, float]:
    """Electrons and read noise of the window about a pixel, and what of it lies inside the image.

    Returns the lines cut off at the worst edge and the largest pixel, ADU.
    """
    height, width = image.shape
    stride, half = columns.shape[1], side // 2
    top, bottom = max(row - half, 0), min(row + half, height - 1)
    left, right = max(column - half, 0), min(column + half, width - 1)
    cut = max(max(half - column, half - row), max(column + half - width + 1, row + half - height + 1), 0)
    for j in range(stride):
        columns[PART, j] = 1.0 if left <= column - half + j <= right else 0.0
        columns[PART + 1, j] = 1.0 if top <= row - half + j <= bottom else 0.0
    maps = offset.size > 1 or gain.size > 1 or read_variance.size > 1
    least, scale = offset[0, 0], 1 / gain[0, 0]
    if cut == 0 and side >= LANES and not maps:
        brightest = splat(0.0)
        for i in range(side):
            for j in range(0, side, LANES):
                j = min(j, side - LANES)  # the last overlaps
                adu = load(image, row - half + i, column - half + j)
                brightest = where_positive(adu - brightest, adu, brightest)
                store(field, DATA, i * stride + j, (adu - least) * scale)
        return cut, largest(brightest)
    field[DATA] = 0.0
    most = 0.0
    for i in range(top, bottom + 1):
        k = (i - row + half) * stride - column + half
        for j in range(left, right + 1):
            adu = float(image[i, j])
            most = max(most, adu)
            o = offset[i, j] if offset.size > 1 else least
            g = gain[i, j] if gain.size > 1 else gain[0, 0]
            field[DATA, k + j] = (adu - o) / g
            field[READ, k + j] = read_variance[i, j] if read_variance.size > 1 else read_variance[0, 0]
    return cut, most


@njit(fastmath=_FAST, forceinline=True, **_OPTIONS)
def _soften(x: float, y: float, side: int, columns: Array) -> None:
    """Cut what counts to the square of side ``window - 1`` about (x, y), edge pixels by what is inside.

    A window of whole pixels jumps by one as a particle moves; what its edge cuts from the tails of a
    defocused image then shifts the fit by half a standard deviation and more.
    """
    half = side // 2
    for j in range(columns.shape[1]):
        columns[PART, j] *= min(max(half + 0.5 - abs(j - half - x), 0.0), 1.0)
        columns[PART + 1, j] *= min(max(half + 0.5 - abs(j - half - y), 0.0), 1.0)


@njit(fastmath=_FAST, forceinline=True, **_OPTIONS)
def _cover(side: int, field: Array, columns: Array) -> float:
    """How much of each pixel counts, from its factors; returns the sum."""
    stride = columns.shape[1]
    wide, high = splat(0.0), 0.0
    for j in range(0, stride, LANES):
        wide += load(columns, PART, j)
    for i in range(side):
        part = columns[PART + 1, i]
        high += part
        for j in range(0, stride, LANES):
            store(field, VALID, i * stride + j, load(columns, PART, j) * part)
    return high * total(wide)


@njit(fastmath=_FAST_FINITE, forceinline=True, **_OPTIONS)
def _start(window: int, stride: int, field: Array, theta: Array) -> bool:
    """First parameters from the window alone: border, peak, and moments above 30 % of it.

    A Gaussian cut at the fraction f of its height and lowered by it has 0.358 of its variance
    (f = 0.3): [1 - f (1 + L) - f L^2 / 2] / [1 - f - f L], L = -ln f. False without contrast.
    """
    data, valid = field[DATA], field[VALID]
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
    for i in range(window):
        v = float(i - half)
        f0 = fu = fuu = 0.0
        for j in range(stride):
            u = float(j - half)
            f = valid[i * stride + j] * max(data[i * stride + j] - level, 0.0)
            f0 += f
            fu += f * u
            fuu += f * u * u
        m += f0
        mx += fu
        my += f0 * v
        mxx += fuu
        mxy += fu * v
        myy += f0 * v * v
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


# Algebra of the seven parameters ---------------------------------------------------------------------


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
def _normal(t: Array, moments: Array, half: Array, normal: Array) -> None:
    """``normal = t' moments t`` (7, 7); ``half``: room for it."""
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


# The fit ---------------------------------------------------------------------------------------------


@njit(**_OPTIONS)
def _minimise(
    kind: int,
    theta: Array,
    pixels: float,
    most: int,
    tolerance: float,
    side: int,
    field: Array,
    columns: Array,
    algebra: Array,
) -> int:
    """Levenberg-Marquardt from ``theta`` in place. Returns the iterations; negative: no convergence."""
    t, normal, factor, moments, spare = algebra[0], algebra[1], algebra[2], algebra[3], algebra[4]
    raw, gradient, step, trial = algebra[5, 0], algebra[5, 1], algebra[5, 2], algebra[5, 3]
    pixels = max(pixels, 8.0)
    damping = 0.0
    objective = _evaluate(kind, theta, side, field, columns)
    renew = True
    for iteration in range(1, most + 1):
        if renew:
            _moments(columns, moments)
            _gradient(columns, raw)
            _transformation(theta, t)
            _normal(t, moments, spare, normal)
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
        whole = _bounded_step(theta, step, side, trial)
        if whole and damping < 1e-2 and expected <= tolerance * objective / pixels:
            theta[:] = trial
            return iteration
        found = _evaluate(kind, trial, side, field, columns)
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
def _curvature(theta: Array, t: Array, moments: Array, raw: Array, spare: Array, curvature: Array) -> None:
    """``curvature[i, j] = sum p d2G/(dtheta_i dtheta_j)``: what residuals add to the normal matrix.

    G_i = E T_i.m with the polynomials m and the columns T_i of the transformation; hence, since
    dE/dtheta_j = E T_j.m / A where j is not A or B,  G_ij = E (dT_i/dtheta_j).m + E (T_i.m)(T_j.m) / A.
    ``t``: T; ``moments``: with p / E for the weights; ``raw``: the gradient before T.
    """
    moments[6], moments[:, 6] = 0.0, 0.0
    _normal(t, moments, spare, curvature)
    after, before, moved = np.empty((7, 7)), np.empty((7, 7)), np.empty(7)
    for i in range(7):
        for j in range(7):
            curvature[i, j] /= theta[2]
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
    pixels: float,
    side: int,
    field: Array,
    columns: Array,
    algebra: Array,
    covariance: Array,
) -> float:
    """Covariance of x, y, A, sigma_x, sigma_y, rho, B at the solution; returns reduced chi-square.

    The sandwich H^-1 M H^-1 of an estimate by weights w (White, Econometrica 50, 1, 1982) with
    H = J'wJ - sum w r d2G, M = J'w V w J and the pixel variance V = model + read noise. The second
    term of H matters where a Gaussian is only an approximation: without it widths and rho claim 12 %
    too little on physical images. Chi-square is Pearson's, with V: 1 for a matched model.
    """
    t, normal, factor, moments, spare = algebra[0], algebra[1], algebra[2], algebra[3], algebra[4]
    raw, unit, curvature = algebra[5, 0], algebra[5, 1], algebra[6]
    _transformation(theta, t)
    chi = _evaluate(INFORMATION, theta, side, field, columns)
    _moments(columns, moments)
    _gradient(columns, raw)
    _normal(t, moments, spare, normal)
    _evaluate(BENT, theta, side, field, columns)
    _moments(columns, moments)
    _curvature(theta, t, moments, raw, spare, curvature)
    for i in range(7):
        for j in range(7):
            curvature[i, j] = normal[i, j] - curvature[i, j]
    if not _factorise(curvature, 0.0, factor) and not _factorise(normal, 0.0, factor):
        return np.nan
    _evaluate(SCATTER, theta, side, field, columns)
    _moments(columns, moments)
    _normal(t, moments, spare, normal)
    inverse = curvature
    for i in range(7):
        unit[:] = 0.0
        unit[i] = 1.0
        _solve(factor, unit, inverse[i])
    _normal(inverse, normal, spare, covariance)
    rho = math.tanh(theta[5])
    scale = (1.0, 1.0, 1.0, math.exp(theta[3]), math.exp(theta[4]), 1 - rho * rho, 1.0)
    for i in range(7):
        for j in range(7):
            covariance[i, j] *= scale[i] * scale[j]
    return chi / max(pixels - 7, 1.0)


@njit(**_OPTIONS)
def _fit(
    image: Image,
    column: int,
    row: int,
    offset: Array,
    gain: Array,
    read_variance: Array,
    weighting: int,
    kappa: float,
    theta: Array,
    side: int,
    field: Array,
    columns: Array,
    algebra: Array,
    quality: Array,
) -> tuple[int, int, float]:
    """Fit the particle near a pixel. ``theta``: out, the solution, relative to the pixel that is returned
    with the number of pixels that count, negative where the fit fails."""
    height, width = image.shape
    cut, largest = _read_window(image, column, row, offset, gain, read_variance, side, field, columns)
    count = _cover(side, field, columns)
    if not _start(side, columns.shape[1], field, theta):
        return column, row, -1.0
    # First a rough uniform fit: a robust start for every weighting, the place of the window, and the
    # light that scales the relative weights. Then the fit itself.
    rough, done = True, 0
    kind = FIXED if weighting in (UNIFORM, RELATIVE) else weighting
    for _ in range(MOST_WINDOWS):
        move_x, move_y = round(theta[0]), round(theta[1])
        if move_x != 0 or move_y != 0:
            column, row = column + move_x, row + move_y
            if not (0 <= column < width and 0 <= row < height):
                return column, row, -1.0
            theta[0] -= move_x
            theta[1] -= move_y
        if move_x != 0 or move_y != 0 or done > 0:
            cut, largest = _read_window(image, column, row, offset, gain, read_variance, side, field, columns)
        if rough:
            rough = False
            count = _cover(side, field, columns)
            field[WEIGHTS] = field[VALID]
            done = _minimise(FIXED, theta, count, ROUGH_ITERATIONS, ROUGH, side, field, columns, algebra)
            quality[1] += abs(done)
            done = 0
            continue
        x, y = theta[0], theta[1]
        _soften(x, y, side, columns)
        count = _cover(side, field, columns)
        if weighting == RELATIVE:
            _fix_weights(True, kappa, theta, side, field, columns)
        elif weighting == UNIFORM:
            field[WEIGHTS] = field[VALID]
        done = _minimise(kind, theta, count, MOST_ITERATIONS, TOLERANCE, side, field, columns, algebra)
        quality[1] += abs(done)
        if done < 0 or max(abs(theta[0] - x), abs(theta[1] - y)) <= MOST_OFF_CENTRE:
            break
    if kind != FIXED:
        _fix_weights(False, 0.0, theta, side, field, columns)
    quality[2], quality[3] = cut, largest
    return column, row, count if done > 0 and _inside(theta, side) else -1.0


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
    field, columns = _make_field(window, read_variance[0, 0]), _make_columns(window)
    algebra, theta = np.zeros((7, 7, 7)), np.empty(7)
    for n in range(len(starts)):
        parameters[n] = np.nan
        covariance[n] = np.nan
        quality[n] = (np.nan, 0.0, 0.0, 0.0)
        start = starts[n]
        if not (-0.5 <= start[0] < width - 0.5 and -0.5 <= start[1] < height - 0.5):
            continue
        column, row, pixels = _fit(
            image,
            round(start[0]),
            round(start[1]),
            offset,
            gain,
            read_variance,
            weighting,
            kappa,
            theta,
            window,
            field,
            columns,
            algebra,
            quality[n],
        )
        if pixels < 0:
            continue
        chi_square = _uncertainty(theta, pixels, window, field, columns, algebra, covariance[n])
        quality[n, 0] = chi_square
        quality[n, 3] = 1.0 if quality[n, 3] >= saturation else 0.0
        if math.isnan(chi_square):
            continue
        parameters[n, 0], parameters[n, 1] = column + theta[0], row + theta[1]
        parameters[n, 2], parameters[n, 6] = theta[2], theta[6]
        parameters[n, 3], parameters[n, 4] = math.exp(theta[3]), math.exp(theta[4])
        parameters[n, 5] = math.tanh(theta[5])


@njit(fastmath=_FAST, forceinline=True, **_OPTIONS)
def _residual_sums(
    theta: Array, width: float, side: int, field: Array, columns: Array, envelope: Array
) -> None:
    """As ``_evaluate``, sums of (data - model) H v^0...4, H the Gaussian ``width`` times as wide."""
    stride, half = columns.shape[1], side // 2
    amplitude, background = theta[2], theta[6]
    curve = splat(_central_row(theta, side, columns))
    theta[3] += math.log(width)
    theta[4] += math.log(width)
    wide_curve = splat(_central_row(theta, side, envelope))
    for j in range(0, stride, LANES):
        s0 = s1 = s2 = s3 = s4 = splat(0.0)
        for way in (1, -1):
            shape, ratio = load(columns, CENTRE, j), load(columns, DOWN if way > 0 else UP, j)
            wide, wide_ratio = load(envelope, CENTRE, j), load(envelope, DOWN if way > 0 else UP, j)
            for i in range(half + 1):
                k = (half + way * i) * stride + j
                r = load(field, DATA, k) - (shape * amplitude + background)
                # The central row comes twice.
                r *= load(field, VALID, k) * wide * (0.5 if i == 0 else 1.0)
                v, vv = float(way * i), float(i * i)
                s0 += r
                s1 += r * v
                s2 += r * vv
                s3 += r * (v * vv)
                s4 += r * (vv * vv)
                shape *= ratio
                ratio *= curve
                wide *= wide_ratio
                wide_ratio *= wide_curve
        m = SUMS
        for column in (s0, s1, s2, s3, s4):
            store(columns, m, j, column)
            m += 1


@njit(**_OPTIONS)
def residual_sums(
    image: Image,
    parameters: Array,
    offset: Array,
    gain: Array,
    window: int,
    width: float,
    sums: Array,
) -> None:
    """``sums`` (n, 5, 5): of each fit, sum over its window of (data - model) H u^i v^j for i + j <= 4.

    (u, v): from the particle, px; H: the fitted Gaussian, of unit amplitude and ``width`` times as wide. NaN
    where ``parameters`` (n, 7) are. The other arguments are those of ``fit_windows``.
    """
    field, columns, nothing = _make_field(window, 0.0), _make_columns(window), np.zeros((1, 1))
    envelope, theta = np.empty_like(columns), np.empty(7)
    half = window // 2
    for n in range(len(parameters)):
        sums[n] = np.nan
        x, y = parameters[n, 0], parameters[n, 1]
        if math.isnan(x):
            continue
        column, row = round(x), round(y)
        _read_window(image, column, row, offset, gain, nothing, window, field, columns)
        _cover(window, field, columns)
        _to_theta(parameters[n], column, row, theta)
        for power in range(5):
            for j in range(columns.shape[1]):
                columns[POWERS + power, j] = (j - half - theta[0]) ** power
        _residual_sums(theta, width, window, field, columns, envelope)
        # Rows are counted from the middle of the window: v' = v + dy.
        dy = -theta[1]
        for i in range(5):
            raw = (
                _sum(columns, 0, i),
                _sum(columns, 1, i),
                _sum(columns, 2, i),
                _sum(columns, 3, i),
                _sum(columns, 4, i),
            )
            for j in range(5 - i):
                s = 0.0
                for k in range(j + 1):
                    s += _BINOMIAL[j][k] * dy ** (j - k) * raw[k]
                sums[n, i, j] = s
