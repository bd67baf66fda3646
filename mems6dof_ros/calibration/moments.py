"""What a Gaussian leaves over: Gauss-Hermite moments of the fit's residual.

Widths and correlation are three numbers; an unknown local aberration and an unknown diameter take two or
three of them away. The light that the Gaussian does not describe (rings, lobes, their asymmetry about
focus) tells defocus from those. With the residual r and whitened coordinates (a, b) = S^-1/2 (x - x0, y - y0)
of the fitted covariance S, the moments are

    h_nm = sum_pixels r He_n(a/w) He_m(b/w) exp(-(a^2 + b^2)/(2 w^2)) / sqrt(n! m!) / flux,   n + m = 4

(He: probabilists' Hermite polynomials; w = 1.4). Lower orders belong to the Gaussian itself, third order
to coma. The moments are linear in the light and relative to the flux: brightness does not move them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mems6dof_ros.localization import kernels
from mems6dof_ros.localization.camera import CameraNoise
from mems6dof_ros.localization.fitting import KAPPA
from mems6dof_ros.localization.localizations import GaussianFits

Array = NDArray[np.float64]

#: Names of the moments, in order.
MOMENTS = ("h40", "h31", "h22", "h13", "h04")

_WIDTH = 1.4


@dataclass(frozen=True)
class Moments:
    """MOMENTS ``values`` (n, 5) with their ``covariance`` (n, 5, 5)."""

    values: Array
    covariance: Array

    def __getitem__(self, index: Any) -> Moments:
        return Moments(self.values[index], self.covariance[index])


def residual_moments(
    image: NDArray[np.generic], fits: GaussianFits, camera: CameraNoise, window_px: int
) -> Moments:
    """Moments of the residuals of ``fits`` in ``image`` (height, width), ADU.

    The covariance is that of photon, background and read noise for a Gaussian image fitted with relative
    light-weighting; other weightings differ by a few per cent. NaN where a fit has failed.
    """
    offset, gain, read_variance = camera.maps
    values, covariance = np.empty((len(fits), 5)), np.empty((len(fits), 5, 5))
    sums = np.empty((len(fits), 5, 5))
    kernels.residual_sums(
        kernels.pixels(image), np.ascontiguousarray(fits.parameters), offset, gain, window_px, _WIDTH, sums
    )
    noise = float(np.mean(read_variance))
    _moments(sums, fits.parameters, fits.flux, noise, _LIGHT_NOISE, _FLAT_NOISE, values, covariance)
    return Moments(values, covariance)


@njit(cache=True, nogil=True, error_model="numpy")
def _moments(
    sums: Array,
    parameters: Array,
    flux: Array,
    read_variance: float,
    light_noise: Array,
    flat_noise: Array,
    values: Array,
    covariance: Array,
) -> None:
    """``values`` (n, 5): moments from ``sums`` (n, 5, 5) of r H u^i v^j, with their ``covariance`` (n, 5, 5);
    NaN where those are."""
    for n in range(len(sums)):
        _, _, amplitude, sx, sy, rho, background = parameters[n]
        # Symmetric square root of S^-1: (S + sqrt(det S) 1)^-1 sqrt(tr S + 2 sqrt(det S)).
        root = sx * sy * math.sqrt(1 - rho * rho)
        trace = math.sqrt(sx * sx + sy * sy + 2 * root)
        p, q, r = sx * sx + root, rho * sx * sy, sy * sy + root
        det = (p * r - q * q) / trace * _WIDTH
        aa, ab, bb = r / det, -q / det, p / det  # a = aa u + ab v, b = ab u + bb v, both over w
        s00 = sums[n, 0, 0]
        s20 = _mixed(sums[n], 2, 0, aa, ab, bb)
        s11 = _mixed(sums[n], 1, 1, aa, ab, bb)
        s02 = _mixed(sums[n], 0, 2, aa, ab, bb)
        values[n, 0] = (_mixed(sums[n], 4, 0, aa, ab, bb) - 6 * s20 + 3 * s00) / math.sqrt(24)
        values[n, 1] = (_mixed(sums[n], 3, 1, aa, ab, bb) - 3 * s11) / math.sqrt(6)
        values[n, 2] = (_mixed(sums[n], 2, 2, aa, ab, bb) - s20 - s02 + s00) / 2
        values[n, 3] = (_mixed(sums[n], 1, 3, aa, ab, bb) - 3 * s11) / math.sqrt(6)
        values[n, 4] = (_mixed(sums[n], 0, 4, aa, ab, bb) - 6 * s02 + 3 * s00) / math.sqrt(24)
        values[n] /= flux[n]
        flat = max((background + read_variance) / amplitude, 0.0)
        covariance[n] = (light_noise + flat * flat_noise) / flux[n]


@njit(cache=True, nogil=True, error_model="numpy")
def _mixed(sums: Array, m: int, n: int, aa: float, ab: float, bb: float) -> float:
    """The sum of r H a^m b^n, from those with powers of u and v."""
    factors = np.zeros(5)  # of u^(degree - k) v^k
    factors[0] = 1.0
    for degree in range(m + n):
        of_u, of_v = (aa, ab) if degree < m else (ab, bb)
        for k in range(degree + 1, 0, -1):
            factors[k] = factors[k] * of_u + factors[k - 1] * of_v
        factors[0] *= of_u
    total = 0.0
    for k in range(m + n + 1):
        total += factors[k] * sums[m + n - k, k]
    return total


def _noise_matrices() -> tuple[Array, Array]:
    """Covariance of the moments times flux, for noise proportional to the Gaussian and for flat noise.

    In whitened coordinates with E = exp(-(a^2 + b^2)/2) the fit of weights 1/(E + KAPPA) takes from the
    residual its projection on E times {1, a, b, a^2, ab, b^2} and on a constant.
    """
    s = np.arange(-7, 7.01, 0.1)
    a, b = (grid.ravel() for grid in np.meshgrid(s, s))
    area = 0.01
    light = np.exp(-0.5 * (a**2 + b**2))
    weight = 1 / (light + KAPPA)
    fitted = np.stack(
        [light, light * a, light * b, light * a * a, light * a * b, light * b * b, np.ones_like(a)]
    )
    p, q = a / _WIDTH, b / _WIDTH
    moments = np.exp(-0.5 * (p**2 + q**2)) * np.stack(
        [
            (p**4 - 6 * p**2 + 3) / math.sqrt(24),
            (p**3 - 3 * p) * q / math.sqrt(6),
            (p**2 - 1) * (q**2 - 1) / 2,
            p * (q**3 - 3 * q) / math.sqrt(6),
            (q**4 - 6 * q**2 + 3) / math.sqrt(24),
        ]
    )
    projection = np.linalg.solve((fitted * weight) @ fitted.T, fitted @ moments.T).T
    kept = moments - projection @ (fitted * weight)
    return (kept * light) @ kept.T * area / (2 * math.pi), kept @ kept.T * area / (2 * math.pi)


_LIGHT_NOISE, _FLAT_NOISE = _noise_matrices()
