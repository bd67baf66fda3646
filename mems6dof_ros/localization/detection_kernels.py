"""Compiled passes over the pixels and cells of detection; ``detection.py`` says what they are for."""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
from numba import njit
from numpy.typing import NDArray

Cells: TypeAlias = NDArray[np.float32]
Mask: TypeAlias = NDArray[np.uint8]

_OPTIONS: dict[str, Any] = {"nogil": True, "cache": True, "error_model": "numpy"}
_FAST = {"reassoc", "contract", "nsz", "arcp"}


@njit(fastmath=_FAST, **_OPTIONS)
def bin_cells(image: NDArray[np.generic], binning: int, cells: Cells) -> None:
    """``cells``: means over squares of ``binning`` px; lines that do not fill one are left out."""
    rows, columns = cells.shape
    sums = np.empty(columns * binning, np.float32)
    scale = np.float32(1 / (binning * binning))
    for i in range(rows):
        top = i * binning
        for j in range(sums.size):
            sums[j] = np.float32(image[top, j])
        for k in range(top + 1, top + binning):
            for j in range(sums.size):
                sums[j] += np.float32(image[k, j])
        if binning == 4:  # the default; a stride that the compiler knows is three times faster
            for j in range(columns):
                cells[i, j] = (sums[4 * j] + sums[4 * j + 1] + sums[4 * j + 2] + sums[4 * j + 3]) * scale
        else:
            for j in range(columns):
                s = np.float32(0.0)
                for k in range(j * binning, (j + 1) * binning):
                    s += sums[k]
                cells[i, j] = s * scale


@njit(fastmath=_FAST, **_OPTIONS)
def normalise(cells: Cells, background: Cells, noise: Cells, dark: float, flat: Cells, debris: Mask) -> bool:
    """``flat = (cells - background) / noise``; ``debris`` 1 where it is below ``dark``; True if anywhere."""
    found = np.uint8(0)
    level = np.float32(dark)
    for i in range(cells.shape[0]):
        for j in range(cells.shape[1]):
            value = (cells[i, j] - background[i, j]) / noise[i, j]
            flat[i, j] = value
            debris[i, j] = value < level
            found |= debris[i, j]
    return bool(found > 0)


@njit(fastmath=_FAST, **_OPTIONS)
def fill(debris: Mask, flat: Cells) -> None:
    """What is dark in ``debris`` becomes background."""
    for i in range(flat.shape[0]):
        for j in range(flat.shape[1]):
            flat[i, j] = np.float32(0.0) if debris[i, j] > 0 and flat[i, j] < 0 else flat[i, j]


@njit(**_OPTIONS)
def peaks(score: Cells, threshold: float) -> NDArray[np.int64]:
    """Row and column (n, 2) of the cells above ``threshold`` that none of their eight neighbours exceeds."""
    rows, columns = score.shape
    level = np.float32(threshold)
    found = np.empty((score.size, 2), np.int64)
    count = 0
    for i in range(rows):
        for j in range(columns):
            value = score[i, j]
            if not value > level:
                continue
            highest = True
            for k in range(max(i - 1, 0), min(i + 2, rows)):
                for m in range(max(j - 1, 0), min(j + 2, columns)):
                    highest &= not score[k, m] > value
            if highest:
                found[count] = i, j
                count += 1
    return found[:count].copy()
