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

from mems6dof_ros.localization.camera import CameraNoise
from mems6dof_ros.localization.fitting import KAPPA
from mems6dof_ros.localization.localizations import GaussianFits

Array = NDArray[np.float64]

#: Names of the moments, in order.
MOMENTS = ("h40", "h31", "h22", "h13", "h04")

_WIDTH = 1.4
_REACH = 25.0  # a^2 + b^2 in units of w^2, beyond which nothing counts


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
    values = _moments(np.ascontiguousarray(image), fits.parameters, offset, gain, window_px, _WIDTH)
    beta = (fits.parameters[:, 6] + np.mean(read_variance)) / fits.parameters[:, 2]
    with np.errstate(invalid="ignore"):
        scale = 1 / fits.flux
    covariance = scale[:, None, None] * (_LIGHT_NOISE + np.maximum(beta, 0)[:, None, None] * _FLAT_NOISE)
    return Moments(values, covariance)


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz", "arcp"})
def _moments(
    image: NDArray, parameters: Array, offset: Array, gain: Array, window: int, width: float
) -> Array:
    height, columns = image.shape
    half = window // 2
    values = np.full((len(parameters), 5), np.nan)
    maps = offset.size > 1 or gain.size > 1
    for i in range(len(parameters)):
        x, y, amplitude, sx, sy, rho, background = parameters[i]
        if np.isnan(x):
            continue
        # Symmetric square root of S^-1: (S + sqrt(det S) 1)^-1 sqrt(tr S + 2 sqrt(det S)).
        root = sx * sy * math.sqrt(1 - rho * rho)
        trace = math.sqrt(sx * sx + sy * sy + 2 * root)
        p, q, r = sx * sx + root, rho * sx * sy, sy * sy + root
        det = (p * r - q * q) / trace
        m_aa, m_ab, m_bb = r / det / width, -q / det / width, p / det / width
        # a^2 + b^2 = k_uu u^2 + 2 k_uv u v + k_vv v^2.
        k_uu, k_uv, k_vv = m_aa * m_aa + m_ab * m_ab, m_ab * (m_aa + m_bb), m_ab * m_ab + m_bb * m_bb
        # From column to column the exponentials change by a ratio that itself changes by a constant.
        curve, sharp_curve = math.exp(-k_uu), math.exp(-k_uu * width * width)
        s40 = s31 = s22 = s13 = s04 = 0.0
        o, inverse_gain = offset[0, 0], 1 / gain[0, 0]
        middle_x, middle_y = round(x), round(y)
        for row in range(max(middle_y - half, 0), min(middle_y + half + 1, height)):
            v = row - y
            # Columns with a^2 + b^2 <= _REACH.
            spread = (k_uv * v) ** 2 - k_uu * (k_vv * v * v - _REACH)
            if spread < 0:
                continue
            spread = math.sqrt(spread) / k_uu
            middle = x - k_uv * v / k_uu
            first = max(math.ceil(middle - spread), middle_x - half, 0)
            last = min(math.floor(middle + spread), middle_x + half, columns - 1)
            u = first - x
            exponent = 0.5 * (k_uu * u * u + 2 * k_uv * u * v + k_vv * v * v)
            step = k_uu * (u + 0.5) + k_uv * v
            envelope, ratio = math.exp(-exponent), math.exp(-step)
            sharp, sharp_ratio = math.exp(-exponent * width * width), math.exp(-step * width * width)
            for column in range(first, last + 1):
                u = column - x
                a, b = m_aa * u + m_ab * v, m_ab * u + m_bb * v
                aa, bb = a * a, b * b
                if maps:
                    o = offset[row, column] if offset.size > 1 else offset[0, 0]
                    inverse_gain = 1 / (gain[row, column] if gain.size > 1 else gain[0, 0])
                electrons = (np.int64(image[row, column]) - o) * inverse_gain
                term = (electrons - background - amplitude * sharp) * envelope
                s40 += term * (aa * aa - 6 * aa + 3)
                s31 += term * (aa - 3) * a * b
                s22 += term * (aa - 1) * (bb - 1)
                s13 += term * a * (bb - 3) * b
                s04 += term * (bb * bb - 6 * bb + 3)
                envelope *= ratio
                ratio *= curve
                sharp *= sharp_ratio
                sharp_ratio *= sharp_curve
        flux = 2 * math.pi * amplitude * root
        values[i, 0] = s40 / (math.sqrt(24) * flux)
        values[i, 1] = s31 / (math.sqrt(6) * flux)
        values[i, 2] = s22 / (2 * flux)
        values[i, 3] = s13 / (math.sqrt(6) * flux)
        values[i, 4] = s04 / (math.sqrt(24) * flux)
    return values


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
