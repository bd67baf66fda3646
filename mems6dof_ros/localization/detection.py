"""Where the particles are, to about a pixel: the start of the fits.

On a binned image, against a local background, by differences of Gaussians at two sizes: the smaller
finds particles in focus, the larger what defocus has spread.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from mems6dof_ros.errors import InputError
from mems6dof_ros.frame import check_image
from mems6dof_ros.localization import detection_kernels
from mems6dof_ros.localization.kernels import pixels
from mems6dof_ros.localization.neighbours import close_pairs

Cells: TypeAlias = NDArray[np.float32]

#: Median absolute deviation to standard deviation of a normal distribution.
_MAD_TO_SD = 1.4826
#: Mean absolute deviation likewise.
_MEAN_TO_SD = 1.2533

#: Cells below this many standard deviations of the background are debris.
_DARK = -3.0
#: Standard deviation of a spot, in cells, down to which cells may be merged.
_FINE = 1.25

_NEIGHBOURS = np.ones((3, 3), np.uint8)


@dataclass(frozen=True)
class DetectionSettings:
    """How particles are found.

    ``binning`` px to a side of one cell that detection works on. ``spot_sigmas_px``: sizes of spots to
    look for, standard deviations in px. ``threshold``: least contrast of a spot in standard deviations of
    the filtered background. ``separation_px``: of two candidates closer than this only the brighter stays.
    ``background_px``: size over which the background may vary, several times that of a spot.
    """

    binning: int = 4
    spot_sigmas_px: tuple[float, ...] = (5.0, 11.0)
    threshold: float = 8.0
    separation_px: float = 16.0
    background_px: int = 160

    def __post_init__(self) -> None:
        if not 1 <= self.binning <= 16:
            raise InputError("detection.binning", f"{self.binning}", "1 to 16 px")
        if not self.spot_sigmas_px or not all(0.5 <= s <= 100 for s in self.spot_sigmas_px):
            raise InputError("detection.spot_sigmas_px", f"{self.spot_sigmas_px}", "sizes of 0.5 to 100 px")
        if not 3 <= self.threshold < float("inf"):
            raise InputError("detection.threshold", f"{self.threshold}", "3 or more standard deviations")
        if not 1 <= self.separation_px < float("inf"):
            raise InputError("detection.separation_px", f"{self.separation_px}", "1 px or more")
        if not self.background_px >= 10 * self.binning:
            raise InputError("detection.background_px", f"{self.background_px}", "10 cells or more")


def detect(image: NDArray[np.generic], settings: DetectionSettings | None = None) -> NDArray[np.float64]:
    """Candidates (n, 2), column and row in px, brightest contrast first.

    ``image`` (height, width) uint8 or uint16. Offset and gain of the camera do not matter: contrast is
    measured against the noise of the image itself. An image without contrast has no particles. Raises
    InputError for an image that is none.
    """
    check_image(image, "image")
    settings = settings or DetectionSettings()
    cells = _bin(image, settings.binning)
    if min(cells.shape) < 3:
        return np.empty((0, 2))
    score = _score(cells, settings)
    rows, columns = detection_kernels.peaks(score, settings.threshold).T
    order = np.argsort(-score[rows, columns], kind="stable")
    rows, columns = rows[order], columns[order]
    positions = np.stack(
        [columns + _vertex(score, rows, columns, 0, 1), rows + _vertex(score, rows, columns, 1, 0)], axis=1
    )
    positions = (positions + 0.5) * settings.binning - 0.5
    return positions[_separated(positions, settings.separation_px)]


def _bin(image: NDArray[np.generic], binning: int) -> Cells:
    """Means over cells of ``binning`` px. (OpenCV would round them to the type of the pixels.)"""
    cells = np.empty([n // binning for n in image.shape], np.float32)
    detection_kernels.bin_cells(pixels(image), binning, cells)
    return cells


def _score(cells: Cells, settings: DetectionSettings) -> Cells:
    """Contrast of spots in standard deviations of the background, the best of all sizes."""
    size = settings.background_px // settings.binning
    shape = cells.shape
    background = _resize(_typical(cells, size), shape)
    # Noise grows with the background. The floor, far below one count, keeps rounding from becoming contrast.
    noise = _MEAN_TO_SD * _typical(np.abs(cells - background), size)
    noise = np.maximum(noise, np.float32(max(0.3 * float(np.median(noise)), 0.01)))
    flat, debris = np.empty_like(cells), np.empty(shape, np.uint8)
    # Dark debris, edges and all, becomes background: filtered, its rim would look like bright spots.
    if detection_kernels.normalise(cells, background, _resize(noise, shape), _DARK, flat, debris):
        detection_kernels.fill(cv2.dilate(debris, _NEIGHBOURS), flat)
    best: Cells | None = None
    for sigma in settings.spot_sigmas_px:
        response = _response(flat, sigma / settings.binning)
        best = response if best is None else np.maximum(best, response, out=best)
    assert best is not None
    return best


def _response(flat: Cells, sigma: float) -> Cells:
    """Difference of Gaussians of ``sigma`` and 2 ``sigma`` cells, in its own robust standard deviations."""
    # Large spots need no small cells.
    coarse = max(int(sigma / _FINE), 1)
    smaller = _resize(flat, tuple(max(round(n / coarse), 1) for n in flat.shape))
    sigma = max(sigma / coarse, 0.5)
    response = _blur(smaller, sigma) - _blur(smaller, 2 * sigma)
    response *= 1 / max(_deviation(response), 0.01)
    return _resize(response, flat.shape)


def _typical(cells: Cells, size: int) -> Cells:
    """Median over about ``size`` cells, of means over a fifth of it: one value for each of the latter."""
    coarse = tuple(max(round(5 * n / size), 1) for n in cells.shape)
    return np.asarray(cv2.medianBlur(_resize(cells, coarse), 5), np.float32)


def _resize(cells: Cells, shape: tuple[int, ...]) -> Cells:
    """Means where ``shape`` is coarser, linear interpolation where it is finer."""
    if cells.shape == shape:
        return cells
    interpolation = cv2.INTER_AREA if shape[0] < cells.shape[0] else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(cells, shape[::-1], interpolation=interpolation), np.float32)


def _blur(cells: Cells, sigma: float) -> Cells:
    size = 2 * int(np.ceil(2.5 * sigma)) + 1
    blurred = cv2.GaussianBlur(cells, (size, size), sigma, borderType=cv2.BORDER_REFLECT_101)
    return np.asarray(blurred, dtype=np.float32)


def _deviation(cells: Cells) -> float:
    """Robust standard deviation, from a sixteenth of the cells."""
    sample = cells[::4, ::4]
    return _MAD_TO_SD * float(np.median(np.abs(sample - np.median(sample))))


def _vertex(score: NDArray[np.float32], rows: NDArray, columns: NDArray, down: int, right: int) -> NDArray:
    """Offset, within half a cell, of the parabola's vertex through a maximum and its two neighbours."""
    height, width = score.shape
    before = score[np.maximum(rows - down, 0), np.maximum(columns - right, 0)]
    after = score[np.minimum(rows + down, height - 1), np.minimum(columns + right, width - 1)]
    curvature = 2 * score[rows, columns] - before - after
    offset = np.where(curvature > 0, 0.5 * (after - before) / np.where(curvature > 0, curvature, 1), 0)
    return np.clip(offset, -0.5, 0.5)


def _separated(positions: NDArray[np.float64], separation: float) -> NDArray[np.bool_]:
    """Which of the positions, best first, have no better one that stays within ``separation``."""
    stays = np.ones(len(positions), dtype=bool)
    for better, worse in close_pairs(positions, separation):
        if stays[better]:
            stays[worse] = False
    return stays
