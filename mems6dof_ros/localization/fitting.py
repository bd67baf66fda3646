"""Bivariate-Gaussian fits to the particles of one image: the public face of the kernels."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mems6dof_ros.errors import InputError
from mems6dof_ros.frame import check_image
from mems6dof_ros.localization import kernels
from mems6dof_ros.localization.camera import CameraNoise
from mems6dof_ros.localization.localizations import Flag, GaussianFits

#: The weightings by name. ``docs/localization.md`` defines and compares them.
WEIGHTINGS = {
    "relative_light_weighting": kernels.RELATIVE,
    "light_weighting": kernels.LIGHT,
    "uniform": kernels.UNIFORM,
    "poisson": kernels.POISSON,
}

#: The best by measurement: as precise as light-weighting, and what it measures does not depend on brightness.
DEFAULT_WEIGHTING = "relative_light_weighting"

#: Least variance of the relative light-weighting, in units of the amplitude.
KAPPA = 0.1

SMALLEST_WINDOW_PX, LARGEST_WINDOW_PX = 7, 65


def fit_gaussians(
    image: NDArray[np.generic],
    positions_px: ArrayLike,
    camera: CameraNoise,
    weighting: str = DEFAULT_WEIGHTING,
    window_px: int = 31,
    kappa: float = KAPPA,
) -> GaussianFits:
    """Fit one Gaussian to the window about each position.

    ``image`` (height, width) uint8 or uint16, ADU; ``positions_px`` (n, 2), column and row, good to
    about a particle's radius; ``weighting`` one of WEIGHTINGS; ``window_px`` odd side of the window that
    is read, of which the fit uses the square of side ``window_px - 1`` about the particle; ``kappa``
    least variance over amplitude of ``relative_light_weighting``.

    Flags set: FIT_FAILED (not converged, or no particle in the window), WINDOW_CUT (more than a seventh
    of the window outside the image), SATURATED. Raises InputError for an image, weighting or window that
    cannot be used; a position that is NaN or outside the image is a failed fit.
    """
    check_image(image, "image")
    camera.check_shape(image.shape)
    positions = np.array(positions_px, dtype=np.float64).reshape(-1, 2)
    check_fit(weighting, window_px)
    if not 0 < kappa < 10:
        raise InputError("kappa", f"{kappa}", "a positive number, about 0.1")
    n = len(positions)
    parameters, covariance, quality = np.empty((n, 7)), np.empty((n, 7, 7)), np.empty((n, 4))
    kernels.fit_windows(
        kernels.pixels(image),
        positions,
        *camera.maps,
        float(camera.saturation_adu),
        window_px,
        WEIGHTINGS[weighting],
        float(kappa),
        parameters,
        covariance,
        quality,
    )
    flags = np.zeros(n, dtype=np.uint32)
    flags[np.isnan(parameters[:, 0])] |= np.uint32(Flag.FIT_FAILED)
    flags[quality[:, 2] * 7 > window_px] |= np.uint32(Flag.WINDOW_CUT)
    flags[quality[:, 3] > 0] |= np.uint32(Flag.SATURATED)
    iterations = quality[:, 1].astype(np.int32)
    return GaussianFits(parameters, covariance, quality[:, 0], iterations, flags, positions)


def check_fit(weighting: str, window_px: int) -> None:
    """Raise InputError unless there is such a weighting, and a fit in such a window is possible."""
    if weighting not in WEIGHTINGS:
        raise InputError("weighting", repr(weighting), f"one of {', '.join(WEIGHTINGS)}")
    if not (SMALLEST_WINDOW_PX <= window_px <= LARGEST_WINDOW_PX and window_px % 2 == 1):
        raise InputError("window_px", f"{window_px}", f"an odd {SMALLEST_WINDOW_PX} to {LARGEST_WINDOW_PX}")
