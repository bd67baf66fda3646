"""Zernike polynomials over the field of view.

Ordered by the OSA/ANSI single index j = (n (n + 2) + m) / 2 and normalised to unit mean square on the
unit disc (Thibos et al., J. Refract. Surg. 18, S652, 2002). The disc passes through the field's
corners, so on the square field with its random beads the terms are smooth but not orthogonal.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray


def zernike_count(order: int) -> int:
    """Number of terms up to radial ``order`` n, (n + 1)(n + 2) / 2."""
    return (order + 1) * (order + 2) // 2


def zernike_order(terms: int) -> int:
    """Radial order of a complete set of ``terms``: the inverse of :func:`zernike_count`."""
    return (math.isqrt(8 * terms + 1) - 3) // 2


def zernike(order: int, x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    """All terms up to radial ``order`` at ``x``, ``y`` (n,) in units of the disc's radius: (n, terms)."""
    azimuthal = [np.ones(len(x), dtype=np.complex128)]
    for _ in range(order):
        azimuthal.append(azimuthal[-1] * (x + 1j * y))
    radius2 = x**2 + y**2
    terms = []
    for n in range(order + 1):
        for m in range(-n, n + 1, 2):
            angular = azimuthal[abs(m)].imag if m < 0 else azimuthal[abs(m)].real
            norm = math.sqrt(n + 1) if m == 0 else math.sqrt(2 * (n + 1))
            radial: Any
            radial, *lower = _radial_coefficients(n, abs(m))
            for coefficient in lower:
                radial = radial * radius2 + coefficient
            terms.append(norm * radial * angular)
    return np.stack(terms, axis=1)


@lru_cache(maxsize=256)
def _radial_coefficients(n: int, m: int) -> list[float]:
    """Coefficients of R_n^m(r) / r^m in powers of r^2, highest first."""
    return [
        (-1) ** k
        * math.factorial(n - k)
        / (math.factorial(k) * math.factorial((n + m) // 2 - k) * math.factorial((n - m) // 2 - k))
        for k in range((n - m) // 2 + 1)
    ]
