"""Curves over defocus whose shape varies smoothly over the field.

    y_k(u; X, Y) = sum_jm c_kjm Z_j(X, Y) T_m(s),   s = u scaled onto [-1, 1]

with Zernike polynomials Z over the field (the paper's linear combinations) and Chebyshev polynomials T
over defocus: raw monomials of order 16 would be ill-conditioned. The regression never forms the large
design matrix. It needs only the normal equations, which are sums over beads of Kronecker products, so
leaving out whole beads in cross-validation costs next to nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from mems6dof_ros.calibration.zernike import zernike, zernike_count, zernike_order

Array = NDArray[np.float64]


@dataclass(frozen=True)
class FieldCurves:
    """``coefficients`` (outputs, Zernike terms, Chebyshev terms) on a disc of ``radius`` m and on
    ``interval`` (lowest, highest) of the curves' argument."""

    radius: float
    interval: tuple[float, float]
    coefficients: Array

    @property
    def field_order(self) -> int:
        return zernike_order(self.coefficients.shape[1])

    @property
    def degree(self) -> int:
        return self.coefficients.shape[2] - 1

    def local(self, x: Array, y: Array) -> Array:
        """Chebyshev coefficients of every curve at field positions ``x``, ``y`` (n,) m:
        (n, outputs, Chebyshev terms)."""
        terms = zernike(self.field_order, x / self.radius, y / self.radius)
        outputs, _, degrees = self.coefficients.shape
        return (terms @ self._by_zernike).reshape(len(terms), outputs, degrees)

    @cached_property
    def _by_zernike(self) -> Array:
        """The coefficients with a row for each Zernike term."""
        return self.coefficients.transpose(1, 0, 2).reshape(self.coefficients.shape[1], -1)

    def basis(self, argument: Array) -> Array:
        """Chebyshev polynomials at ``argument`` (n,): (n, terms)."""
        return np.asarray(chebyshev.chebvander(self.scaled(argument), self.degree), dtype=np.float64)

    def scaled(self, argument: Array) -> Array:
        """``argument`` mapped so that the interval becomes [-1, 1]."""
        low, high = self.interval
        return np.asarray((2 * argument - (low + high)) / (high - low), dtype=np.float64)

    def values(self, local: Array, argument: Array) -> Array:
        """Curves ``local`` (n, outputs, terms), each at its own ``argument`` (n,): (n, outputs)."""
        return np.einsum("nkm,nm->nk", local, self.basis(argument))

    def slopes(self, local: Array, argument: Array) -> Array:
        """Derivatives by the argument of ``local`` (n, outputs, terms) at ``argument`` (n,): (n, outputs)."""
        low, high = self.interval
        slope = chebyshev.chebder(local, scl=2 / (high - low), axis=2)
        basis = chebyshev.chebvander(self.scaled(argument), slope.shape[2] - 1)
        return np.einsum("nkm,nm->nk", slope, basis)


@dataclass(frozen=True)
class BeadSamples:
    """What one bead contributes to the regression: its field position ``x``, ``y`` (m), the curves'
    ``argument`` (n,), ``values`` (n, outputs) and ``weights`` (n, outputs), the inverse variances."""

    x: float
    y: float
    argument: Array
    values: Array
    weights: Array


class FieldRegression:
    """Weighted least squares of :class:`FieldCurves` for several orders and subsets of beads.

    The normal equations of every bead are formed once, at the highest degree; lower orders are
    leading sub-blocks, since both bases are nested. Fits of one subset in a row share their sums.
    """

    def __init__(
        self,
        beads: list[BeadSamples],
        radius: float,
        interval: tuple[float, float],
        field_order: int,
        degree: int,
    ) -> None:
        self.radius = radius
        self.interval = interval
        basis = FieldCurves(radius, interval, np.zeros((1, 1, degree + 1)))
        x, y = (np.array([getattr(bead, axis) for bead in beads]) / radius for axis in "xy")
        self._terms = zernike(field_order, x, y)
        gram, moment = [], []
        for bead in beads:
            t = basis.basis(bead.argument)
            gram.append(np.einsum("im,ik,il->kml", t, bead.weights, t, optimize=True))
            moment.append(np.einsum("im,ik->km", t, bead.weights * bead.values))
        self._gram = np.array(gram)
        self._moment = np.array(moment)
        self._key: bytes | None = None
        self._last: tuple[Array, Array]

    def fit(self, field_order: int, degree: int, use: NDArray[np.bool_] | None = None) -> FieldCurves:
        """Coefficients of radial order ``field_order`` and ``degree`` from the beads in ``use`` (all)."""
        gram, moment = self._sums(use)
        j, m = zernike_count(field_order), degree + 1
        gram = gram[:, :j, :m, :j, :m].reshape(len(gram), j * m, j * m)
        # A ridge of 1e-9 of the mean diagonal: below any noise, and it keeps sparse fields solvable.
        ridge = 1e-9 * np.trace(gram, axis1=1, axis2=2) / (j * m)
        solution = [
            cho_solve(cho_factor(one + r * np.eye(j * m), overwrite_a=True), right.ravel())
            for one, r, right in zip(gram, ridge, moment[:, :j, :m], strict=True)
        ]
        return FieldCurves(self.radius, self.interval, np.array(solution).reshape(len(gram), j, m))

    def _sums(self, use: NDArray[np.bool_] | None) -> tuple[Array, Array]:
        """Normal equations of the beads in ``use`` at the highest orders; the last ones are remembered."""
        key = b"" if use is None else use.tobytes()
        if key != self._key:
            beads = slice(None) if use is None else use
            z = self._terms[beads]
            self._key, self._last = (
                key,
                (
                    np.einsum("bi,bj,bkml->kimjl", z, z, self._gram[beads], optimize=True),
                    np.einsum("bi,bkm->kim", z, self._moment[beads], optimize=True),
                ),
            )
        return self._last
