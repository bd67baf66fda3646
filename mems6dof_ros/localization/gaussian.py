"""The bivariate Gaussian of the image fit, its derivatives, its Cramer-Rao bound, a reference fit.

Plain NumPy and SciPy, written to be read; the compiled kernels are checked against it. Source of
the model: Copeland et al., Particle tracking of a complex microsystem in three dimensions and six
degrees of freedom, image fit. Parameters ``(x, y, A, sigma_x, sigma_y, rho, B)`` in the order of
FIT_PARAMETERS; px and electrons per pixel.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

Array = NDArray[np.float64]

#: Least variance of a pixel, electrons^2: keeps weights finite where neither light nor noise is expected.
VARIANCE_FLOOR = 0.01


def gaussian(parameters: Array, columns: Array, rows: Array) -> Array:
    """Electrons per pixel at ``columns``, ``rows`` (px, any common shape)."""
    x, y, amplitude, sigma_x, sigma_y, rho, background = parameters
    p, q = (columns - x) / sigma_x, (rows - y) / sigma_y
    return amplitude * np.exp(-(p * p - 2 * rho * p * q + q * q) / (2 * (1 - rho * rho))) + background


def derivatives(parameters: Array, columns: Array, rows: Array) -> Array:
    """Derivatives of ``gaussian`` with respect to the seven parameters, shape (..., 7)."""
    x, y, amplitude, sigma_x, sigma_y, rho, _ = parameters
    p, q = (columns - x) / sigma_x, (rows - y) / sigma_y
    k = 1 / (1 - rho * rho)
    shape = np.exp(-0.5 * k * (p * p - 2 * rho * p * q + q * q))
    light = amplitude * shape
    return np.stack(
        [
            light * k * (p - rho * q) / sigma_x,
            light * k * (q - rho * p) / sigma_y,
            shape,
            light * k * p * (p - rho * q) / sigma_x,
            light * k * q * (q - rho * p) / sigma_y,
            light * k * (p * q - rho * k * (p * p - 2 * rho * p * q + q * q)),
            np.ones_like(shape),
        ],
        axis=-1,
    )


def pixel_grid(window_px: int, centre: tuple[float, float] = (0.0, 0.0)) -> tuple[Array, Array]:
    """Columns and rows (window_px, window_px) of a window about the pixel ``centre`` (column, row)."""
    span = np.arange(window_px) - window_px // 2
    columns, rows = np.meshgrid(span + centre[0], span + centre[1])
    return columns.astype(np.float64), rows.astype(np.float64)


def cramer_rao(parameters: Array, columns: Array, rows: Array, read_noise_electrons: float = 0.0) -> Array:
    """Least covariance (7, 7) of any unbiased estimate, pixel variance ``G + read_noise^2``.

    Read noise is added to the Poisson variance (Huang et al., Nature Methods 10, 653 (2013));
    without it the bound is exact.
    """
    variance = gaussian(parameters, columns, rows) + read_noise_electrons**2
    jacobian = derivatives(parameters, columns, rows).reshape(-1, 7)
    return np.asarray(np.linalg.inv(jacobian.T @ (jacobian / variance.reshape(-1, 1))))


def residuals(
    parameters: Array, columns: Array, rows: Array, data: Array, noise: Array | float, weighting: str
) -> Array:
    """Residuals whose sum of squares the fit of that ``weighting`` minimises, flat.

    ``data`` electrons. ``noise`` electrons^2: variance of read noise; for ``relative_light_weighting`` the
    fixed variance that replaces the camera's (see docs/localization.md).
    """
    model = gaussian(parameters, columns, rows)
    if weighting == "poisson":
        mean = np.maximum(model + noise, VARIANCE_FLOOR)
        count = np.maximum(data + noise, VARIANCE_FLOOR)
        deviance = 2 * (mean - count - count * np.log(mean / count))
        return np.asarray(np.sign(count - mean) * np.sqrt(np.maximum(deviance, 0))).ravel()
    variance: Array | float = 1.0
    if weighting == "light_weighting":
        variance = np.maximum(np.maximum(data, model) + noise, VARIANCE_FLOOR)
    elif weighting == "relative_light_weighting":
        variance = noise
    return ((data - model) / np.sqrt(variance)).ravel()


def window_weights(columns: Array, rows: Array, x: float, y: float, window_px: int) -> Array:
    """The part of each pixel inside the square of side ``window_px - 1`` about (x, y)."""
    reach = (window_px - 1) / 2 + 0.5
    return np.clip(reach - np.abs(columns - x), 0, 1) * np.clip(reach - np.abs(rows - y), 0, 1)


def reference_fit(
    data: Array,
    columns: Array,
    rows: Array,
    start: Array,
    noise: Array | float,
    weighting: str,
    inside: Array | float = 1.0,
) -> Array:
    """Seven parameters that minimise the squares of ``residuals``, weighted by ``inside``.

    From ``start``, by SciPy's trust-region least squares.
    """
    low = [-np.inf, -np.inf, -np.inf, 0.1, 0.1, -0.99, -np.inf]
    high = [np.inf, np.inf, np.inf, np.inf, np.inf, 0.99, np.inf]
    root = np.sqrt(inside * np.ones_like(data)).ravel()
    solution = least_squares(
        lambda parameters: root * residuals(parameters, columns, rows, data, noise, weighting),
        start,
        bounds=(low, high),
        x_scale=np.abs(start) + 0.1,
        xtol=1e-13,
        ftol=1e-13,
        gtol=1e-13,
    )
    return np.asarray(solution.x)
