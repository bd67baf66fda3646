"""Zernike polynomials over the field of view.

Ordered by the OSA/ANSI single index j = (n (n + 2) + m) / 2 and normalised to unit mean square on the
unit disc (Thibos et al., J. Refract. Surg. 18, S652, 2002). The disc passes through the field's
corners, so on the square field with its random beads the terms are smooth but not orthogonal.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numba import njit
from numpy.typing import NDArray


def zernike_count(order: int) -> int:
    """Number of terms up to radial ``order`` n, (n + 1)(n + 2) / 2."""
    return (order + 1) * (order + 2) // 2


def zernike_order(terms: int) -> int:
    """Radial order of a complete set of ``terms``: the inverse of :func:`zernike_count`."""
    return (math.isqrt(8 * terms + 1) - 3) // 2


def zernike(order: int, x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    """All terms up to radial ``order`` at ``x``, ``y`` (n,) in units of the disc's radius: (n, terms)."""
    return np.asarray(_evaluate(x, y, order, *_table(order)))


@njit(cache=True, nogil=True)
def _evaluate(
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    order: int,
    azimuthal: NDArray[np.int64],
    radial: NDArray[np.float64],
) -> NDArray[np.float64]:
    out = np.empty((len(x), len(azimuthal)))
    cosine, sine = np.empty(order + 1), np.empty(order + 1)  # r^m cos m phi, r^m sin m phi
    for i in range(len(x)):
        cosine[0], sine[0] = 1.0, 0.0
        for m in range(order):
            cosine[m + 1] = cosine[m] * x[i] - sine[m] * y[i]
            sine[m + 1] = cosine[m] * y[i] + sine[m] * x[i]
        radius2 = x[i] ** 2 + y[i] ** 2
        for j in range(len(azimuthal)):
            value = 0.0
            for coefficient in radial[j]:
                value = value * radius2 + coefficient
            m = azimuthal[j]
            out[i, j] = value * (sine[-m] if m < 0 else cosine[m])
    return out


@lru_cache(maxsize=32)
def _table(order: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Of each term m (terms,), and its norm times the coefficients of R_n^m(r) / r^m in powers of r^2,
    highest first, (terms, powers)."""
    terms = [(n, m) for n in range(order + 1) for m in range(-n, n + 1, 2)]
    radial = np.zeros((len(terms), order // 2 + 1))
    for j, (n, m) in enumerate(terms):
        coefficients = _radial_coefficients(n, abs(m))
        norm = math.sqrt(n + 1) if m == 0 else math.sqrt(2 * (n + 1))
        radial[j, radial.shape[1] - len(coefficients) :] = norm * np.array(coefficients)
    return np.array([m for _, m in terms]), radial


def _radial_coefficients(n: int, m: int) -> list[float]:
    """Coefficients of R_n^m(r) / r^m in powers of r^2, highest first."""
    return [
        (-1) ** k
        * math.factorial(n - k)
        / (math.factorial(k) * math.factorial((n + m) // 2 - k) * math.factorial((n - m) // 2 - k))
        for k in range((n - m) // 2 + 1)
    ]
