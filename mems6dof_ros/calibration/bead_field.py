"""How well maps over the field are known where no calibration bead was.

A Zernike map fitted by least squares to values at the beads' places has, at any other place with the terms
z, the variance h s^2, with s^2 the variance of one bead's value and the leverage

    h = z' (Z' Z)^-1 z,   Z the terms at the beads

(Montgomery, Peck & Vining, Introduction to Linear Regression Analysis, section 3.4). Its mean over the beads
is the number of terms over that of beads; towards the field's corners, and beyond the beads, it is several
times that.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from mems6dof_ros.calibration.zernike import zernike, zernike_order

Array = NDArray[np.float64]


@dataclass(frozen=True)
class BeadField:
    """The ``places`` (b, 2) m of the beads, on a disc of ``radius`` m. None at all (0, 2) stands for unknown
    ones: in files written before they were kept."""

    radius: float
    places: Array

    @cached_property
    def _roots(self) -> dict[int, Array]:
        return {}

    def influence(self, order: int, x: Array, y: Array) -> Array:
        """Rows (n, terms) at ``x``, ``y`` (n,) m whose products are the covariance of a map of radial
        ``order``, in units of the variance of one bead's value."""
        if order not in self._roots:
            terms = zernike(order, *(self.places.T / self.radius))
            _, singular, axes = np.linalg.svd(terms, full_matrices=False)
            seen = singular > 1e-9 * singular[0]
            self._roots[order] = axes[seen].T / singular[seen]
        return np.asarray(zernike(order, x / self.radius, y / self.radius) @ self._roots[order])

    def leverage(self, order: int, x: Array, y: Array) -> Array:
        """Variance (n,) of a map of radial ``order`` at ``x``, ``y`` (n,) m over that of one bead's value;
        zero where the beads' places are unknown."""
        if not len(self.places):
            return np.zeros(len(x))
        return np.asarray(np.sum(self.influence(order, x, y) ** 2, axis=1))

    def inflation(self, orders: tuple[int, ...], x: Array, y: Array) -> Array:
        """Standard deviations (n, k) of particles about maps of radial ``orders`` (k,), over their scatter
        about the truth: sqrt(1 + leverage)."""
        found = {order: np.sqrt(1 + self.leverage(order, x, y)) for order in set(orders)}
        return np.stack([found[order] for order in orders], axis=1)


def used_order(coefficients: Array) -> int:
    """Radial order of Zernike ``coefficients`` (terms, ...) that were filled up with zeros."""
    used = np.flatnonzero(np.reshape(coefficients != 0, (len(coefficients), -1)).any(axis=1))
    return zernike_order(int(used[-1])) + 1 if len(used) else 0
