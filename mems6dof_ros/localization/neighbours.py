"""Which of the positions in a frame are close to each other, or to others."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array: TypeAlias = NDArray[np.float64]


@njit(nogil=True, cache=True, error_model="numpy")
def close_pairs(positions: Array, distance: float) -> NDArray[np.int64]:
    """Pairs a < b (k, 2), in their order, of the ``positions`` (n, 2) that are within ``distance``.

    A sweep along x: for the hundred particles of a frame faster than to build a tree.
    """
    order = np.argsort(positions[:, 0], kind="mergesort")
    count, room = 0, 4 * len(positions)
    found = np.empty(room, np.int64)
    for i in range(len(order)):
        a = order[i]
        for j in range(i + 1, len(order)):
            b = order[j]
            dx, dy = positions[b, 0] - positions[a, 0], positions[b, 1] - positions[a, 1]
            if dx > distance:
                break
            if dx * dx + dy * dy <= distance * distance:
                if count == room:
                    found, room = np.concatenate((found, found)), 2 * room
                found[count] = min(a, b) * len(order) + max(a, b)
                count += 1
    sorted_pairs = np.sort(found[:count])
    pairs = np.empty((count, 2), np.int64)
    for k in range(count):
        pairs[k, 0], pairs[k, 1] = sorted_pairs[k] // len(order), sorted_pairs[k] % len(order)
    return pairs


@njit(nogil=True, cache=True, error_model="numpy")
def nearest(positions: Array, others: Array) -> tuple[Array, NDArray[np.int64]]:
    """Distance (n,) in the plane from each of ``positions`` (n, 2 or 3) to the nearest of ``others`` (m, 2 or
    3), and which that is, -1 for none.

    By trying all: between the fits of a frame, for a hundred, a fifth of the time of a tree.
    """
    distance, index = np.full(len(positions), np.inf), np.full(len(positions), -1)
    for i in range(len(positions)):
        for j in range(len(others)):
            dx, dy = positions[i, 0] - others[j, 0], positions[i, 1] - others[j, 1]
            square = dx * dx + dy * dy
            if square < distance[i]:
                distance[i], index[i] = square, j
    return np.sqrt(distance), index
