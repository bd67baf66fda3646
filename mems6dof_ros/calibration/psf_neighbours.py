"""Particles in each other's light: their pixels fitted together, and where two were taken for one.

The likelihood is that of ``psf_likelihood`` with the sum of several images and one background, over the union
of their windows. At 6e4 electrons two spheres in contact still have 4/5 of the precision that each has alone,
but only together: fitted alone, either is off by the other's light.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from mems6dof_ros.calibration.psf_likelihood import render, solve

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

#: More than so many are not fitted together.
MOST = 4
_ITERATIONS = 30
_TOLERANCE = 0.01
_LEAST_MEAN = 0.1  # electrons
_LONGEST_U, _LONGEST_X = 0.4e-6, 0.7
#: Two places are sought on a grid of this step, px, within this reach of the blob's, then next to the best.
_STEP, REACH = 3, 18

_OPTIONS: dict[str, Any] = {
    "cache": True,
    "nogil": True,
    "error_model": "numpy",
    "fastmath": {"reassoc", "contract", "nsz", "arcp"},
}


def groups(places_px: Array, window_px: int) -> list[Indices]:
    """Which of ``places_px`` (n, 2), NaN for none, share pixels of their windows, directly or through others:
    two or more each."""
    apart = np.abs(places_px[:, None] - places_px[None]).max(axis=2)
    one, other = np.nonzero(apart < window_px)  # not where NaN
    links = coo_matrix((np.ones(len(one)), (one, other)), (len(places_px),) * 2)
    _, label = connected_components(links, directed=False)
    members = [np.flatnonzero(label == each) for each in np.flatnonzero(np.bincount(label) > 1)]
    return [group.astype(np.int64) for group in members]


def two_places(electrons: Array, image: Array, least_distance_px: float, others: Array) -> Array | None:
    """The two places (2, 2), column and row px from the middle, where two particles beside those at
    ``others`` (k, 2) explain the window ``electrons`` (s, s), background removed, best; None where one light
    would be negative.

    Each looks like ``image`` (w, w) of unit light in its middle, of an odd side; the window holds those of
    the others. Least squares with lights a: ``max |b^T a| = b^T G^-1 b`` for every pair of places, b their
    correlations with the window and G those of the images with each other, of both what the others leave.
    """
    half, middle = len(image) // 2, len(electrons) // 2
    reach, others = min(REACH, middle - half), np.rint(others).astype(int)
    turned = np.fft.rfft2(image, electrons.shape)
    matched = np.fft.irfft2(np.fft.rfft2(electrons) * turned.conj(), electrons.shape)
    side = len(electrons) + 2 * middle
    alike = np.fft.irfft2(np.abs(np.fft.rfft2(image, (side, side))) ** 2, (side, side))

    def pull(places: NDArray[Any]) -> Array:
        return matched[tuple((middle - half + places[..., ::-1]).T)].T

    def shared(one: NDArray[Any], other: NDArray[Any]) -> Array:
        return alike[tuple((other - one)[..., ::-1].T % side)].T

    inverse = np.linalg.pinv(shared(others[:, None], others[None]))

    def best(one: NDArray[Any], other: NDArray[Any]) -> Array | None:
        allowed = (np.abs(np.concatenate([one, other], axis=1)) <= reach).all(axis=1)
        for first, second in ((one, other[:, None]), (one, others), (other, others)):
            apart = np.hypot(*np.moveaxis(second - first[:, None], 2, 0))
            allowed &= apart.min(axis=1, initial=np.inf) >= least_distance_px
        one, other = one[allowed], other[allowed]
        if not len(one):
            return None
        of_one, of_other = (shared(p[:, None], others[None]) for p in (one, other))
        first, second = (
            pull(one) - of_one @ inverse @ pull(others),
            pull(other) - of_other @ inverse @ pull(others),
        )
        a, b, c = (
            shared(p, q) - np.einsum("ni,ij,nj->n", by_p, inverse, by_q)
            for p, q, by_p, by_q in (
                (one, one, of_one, of_one),
                (other, other, of_other, of_other),
                (one, other, of_one, of_other),
            )
        )  # fmt: skip
        light = (b * first - c * second, a * second - c * first)
        gain = np.where(np.minimum(*light) > 0, first * light[0] + second * light[1], -np.inf) / (
            a * b - c**2
        )
        index = int(np.argmax(gain))
        return np.array([one[index], other[index]]) if gain[index] > 0 else None

    grid = np.stack(np.meshgrid(*2 * [np.arange(-reach, reach + 1, _STEP)]), axis=-1).reshape(-1, 2)
    one, other = np.triu_indices(len(grid), 1)
    found = best(grid[one], grid[other])
    if found is None:
        return None
    near = np.stack(np.meshgrid(*4 * [np.arange(1 - _STEP, _STEP)]), axis=-1).reshape(-1, 4)
    found = best(found[0] + near[:, :2], found[1] + near[:, 2:])
    return None if found is None else found.astype(float)


@njit(**_OPTIONS)
def maximise_together(
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
) -> bool:
    """Fit g particles together; arguments as those of ``psf_likelihood.maximise``, n being g. All have the
    ``quality`` of the whole, and the background. False, and nothing written, where it does not converge."""
    count, modes = len(starts), curves.shape[1] - 1
    k_count, size = components.shape[0], components.shape[1]
    each = 4 + modes
    n_par = count * each + 1
    height, width = image.shape
    half = window // 2
    low, high = interval[0], interval[1]
    flat = components.reshape(k_count, size * size)
    column, row = np.empty(count, np.int64), np.empty(count, np.int64)
    for i in range(count):
        column[i], row[i] = round(starts[i, 0]), round(starts[i, 1])
    left, top = column.min() - half, row.min() - half
    across, down = column.max() + half + 1 - left, row.max() + half + 1 - top
    pixels = across * down
    data, read, valid = np.zeros((down, across)), np.ones((down, across)), np.zeros((down, across))
    for i in range(count):
        for r in range(row[i] - half, row[i] + half + 1):
            for c in range(column[i] - half, column[i] + half + 1):
                if 0 <= r < height and 0 <= c < width:
                    o = offset[r, c] if offset.size > 1 else offset[0, 0]
                    g = gain[r, c] if gain.size > 1 else gain[0, 0]
                    s2 = read_variance[r, c] if read_variance.size > 1 else read_variance[0, 0]
                    read[r - top, c - left] = s2
                    data[r - top, c - left] = (np.int64(image[r, c]) - o) / g + s2
                    valid[r - top, c - left] = 1.0
    if valid.sum() < 0.5 * count * window * window / 2:
        return False
    amplitude = np.empty((modes + 2, k_count))
    source = np.empty((modes + 2, size, size))
    rows = np.empty((size, window))
    tangent = np.empty((count, 5 + modes, window, window))
    jacobian = np.zeros((n_par, down, across))
    unit = np.zeros((count, down, across))
    mean, signal = np.empty((down, across)), np.empty((down, across))
    normal, inverse = np.empty((n_par, n_par)), np.empty((n_par, n_par))
    theta, last, step = np.zeros(n_par), np.zeros(n_par), np.zeros(n_par)
    for i in range(count):
        theta[each * i] = starts[i, 0] - column[i]
        theta[each * i + 1] = starts[i, 1] - row[i]
        theta[each * i + 2] = min(max(starts[i, 2], low), high)
    last[:] = theta
    deviance, chi, expected, done = np.inf, 0.0, 0.0, False
    for iteration in range(_ITERATIONS):
        for i in range(count):
            own = theta[each * i : each * (i + 1)]
            if not render(
                own[0], own[1], own[2], own[4:], slopes[i], curves[i], low, high, flat, amplitude,
                source, rows, tangent[i],
            ):  # fmt: skip
                return False
            r, c = row[i] - half - top, column[i] - half - left
            unit[i, r : r + window, c : c + window] = tangent[i, 3]
        if iteration == 0 and not _first_lights(unit, data - read, valid, theta, each):
            return False
        found = 0.0
        signal[:] = 0.0
        for i in range(count):
            if not theta[each * i + 3] > 0:
                return False
            signal += theta[each * i + 3] * unit[i]
            for m in range(modes):
                found += theta[each * i + 4 + m] ** 2
        chi = 0.0
        for r in range(down):
            for c in range(across):
                mu = max(signal[r, c] + theta[n_par - 1] + read[r, c], _LEAST_MEAN)
                mean[r, c] = mu
                n_c = max(data[r, c], _LEAST_MEAN)
                found += valid[r, c] * 2 * (mu - n_c + n_c * math.log(n_c / mu))
                chi += valid[r, c] * (data[r, c] - mu) ** 2 / mu
        if found > deviance + _TOLERANCE:
            for p in range(n_par):
                step[p] *= 0.5
                theta[p] = last[p] + step[p]
            continue
        deviance = found
        for i in range(count):
            light, first, t = theta[each * i + 3], each * i, tangent[i]
            r, c = row[i] - half - top, column[i] - half - left
            t[2] += slopes[i, 0] * t[0] + slopes[i, 1] * t[1]
            for p in range(each):
                scale = 1.0 if p == 3 else light
                part = t[p] if p < 4 else t[p + 1]
                jacobian[first + p, r : r + window, c : c + window] = scale * part
        jacobian[n_par - 1] = 1.0
        weight = valid / mean
        jw = (jacobian * weight).reshape(n_par, pixels)
        normal[:] = np.dot(jw, jacobian.reshape(n_par, pixels).T)
        gradient = np.dot(jw, (data - mean).reshape(pixels))
        for i in range(count):
            for m in range(each * i + 4, each * (i + 1)):
                normal[m, m] += 1.0
                gradient[m] -= theta[m]
        if not solve(normal, gradient, step, inverse):
            return False
        expected = gradient @ step
        longest = 0.0
        for i in range(count):
            s = step[each * i : each * i + 3]
            longest = max(longest, max(abs(s[0]), abs(s[1])) / _LONGEST_X, abs(s[2]) / _LONGEST_U)
        last[:] = theta
        if longest > 1:
            step /= longest
        theta += step
        for i in range(count):
            theta[each * i + 2] = min(max(theta[each * i + 2], low), high)
        if longest <= 1 and expected < _TOLERANCE:
            done = True
            break
    if not done:
        return False
    relative = misfit * signal / mean
    jm = (jacobian * valid * relative * relative).reshape(n_par, pixels)
    wrong = np.dot(inverse, np.dot(np.dot(jm, jacobian.reshape(n_par, pixels).T), inverse))
    for i in range(count):
        first = each * i
        parameters[i, :4] = theta[first : first + 4]
        parameters[i, 0] += column[i]
        parameters[i, 1] += row[i]
        parameters[i, 4] = theta[n_par - 1]
        parameters[i, 5:] = theta[first + 4 : first + each]
        for p in range(3):
            for q in range(3):
                covariance[i, p, q] = inverse[first + p, first + q] + wrong[first + p, first + q]
        quality[i, 0], quality[i, 1] = deviance - expected, chi
        quality[i, 2], quality[i, 3] = valid.sum(), (valid * signal * signal / mean).sum()
    return True


@njit(forceinline=True, **_OPTIONS)
def _first_lights(unit: Array, data: Array, valid: Array, theta: Array, each: int) -> bool:
    """Lights of the images ``unit`` (g, h, w) and the background into ``theta``, by least squares."""
    count = len(unit)
    normal, right = np.zeros((count + 1, count + 1)), np.zeros(count + 1)
    for i in range(count):
        for j in range(i + 1):
            normal[i, j] = normal[j, i] = (valid * unit[i] * unit[j]).sum()
        normal[i, count] = normal[count, i] = (valid * unit[i]).sum()
        right[i] = (valid * unit[i] * data).sum()
    normal[count, count], right[count] = valid.sum(), (valid * data).sum()
    found, inverse = np.empty(count + 1), np.empty((count + 1, count + 1))
    if not solve(normal, right, found, inverse):
        return False
    for i in range(count):
        theta[each * i + 3] = found[i]
    theta[each * count] = found[count]
    return True
