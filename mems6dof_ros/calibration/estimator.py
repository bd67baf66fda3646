"""From fitted shapes to positions: these methods differ only in the features they read.

``rho_amp``, the paper's route, reads its one feature; ``joint`` reads both widths, the correlation and the
moments of the residual image; without an image at hand, the shape of the fits alone.
Both look up the same forward model with the same search, so an ambiguous or insensitive place of the
field shows itself in the same way.

The corrected lateral position is x_fit - dx(z). An error of z leaks dx/dz into it, and the scatter of
real particles about the model is common to x, y and z: every position has its full 3 x 3 covariance.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray
from scipy.special import chdtri

from mems6dof_ros.calibration.axial_search import linearize, search_defocus
from mems6dof_ros.calibration.field_curves import Array
from mems6dof_ros.calibration.interface import Positions
from mems6dof_ros.calibration.moments import MOMENTS, Moments
from mems6dof_ros.calibration.optical_model import FEATURES, OpticalModel, features, field_position
from mems6dof_ros.localization.localizations import Flag, GaussianFits

#: Ways to read z. ``psf`` reads the pixels themselves, see psf_estimator.
METHODS = ("rho_amp", "joint", "psf")
#: Features that each set of them consists of.
SHAPE = ("ln_sigma_x", "ln_sigma_y", "atanh_rho")
ALL_FEATURES = (*SHAPE, *MOMENTS)

#: A second z is a candidate while its L is worse by less than this: 4 sigma of a likelihood ratio.
AMBIGUITY_GAP = 16.0
#: Probability with which the shape of an undisturbed particle may exceed the limit of chi-square.
MISFIT_PROBABILITY = 1e-5
#: Sensitivity dz/dq is lost where z would have an uncertainty beyond this part of the range.
BLIND_FRACTION = 0.25

#: A single feature is of use where its scatter stands for less than this error of z, m.
_USELESS = 0.25e-6

_GRID_STEP = 125e-9


class _Search(NamedTuple):
    """Features of n particles, their curves, and where on them they lie: best and second best."""

    measured: Array
    noise: Array
    local: Array
    inflation: Array
    limits: NDArray[np.int64]
    defocus: Array
    objective: Array
    chi_square: Array


class Estimator:
    """Positions of fitted particles from the features ``used`` of ``model``, for defocus in ``z_range`` m."""

    def __init__(
        self,
        model: OpticalModel,
        used: Sequence[str],
        z_range: tuple[float, float],
        pixel_size: float,
        image_size: tuple[int, int],
    ) -> None:
        self._model = model
        self._used = np.array([FEATURES.index(name) for name in used])
        self._z_range = z_range
        self._pixel_size = pixel_size
        self._image_size = image_size
        low, high = model.curves.interval
        steps = max(16, round((high - low) / _GRID_STEP))
        self._grid = low + (high - low) / steps * np.arange(steps + 1, dtype=np.float64)
        step = self._grid[1] - self._grid[0]
        self._basis = model.curves.basis(self._grid)
        terms = np.eye(model.curves.degree + 1)
        slopes = chebyshev.chebder(terms, scl=2 * step / (high - low))
        self._slope_basis: Array = np.ascontiguousarray(
            chebyshev.chebval(model.curves.scaled(self._grid), slopes).T, dtype=np.float64
        )
        self._scatter = np.ascontiguousarray(
            model.scatter_at(self._grid)[:, self._used[:, None], self._used[None, :]]
        )
        self._misfit = chdtri(max(len(used) - 1, 1), MISFIT_PROBABILITY)

    def locate(self, fits: GaussianFits, moments: Moments | None = None) -> Positions:
        """Positions of ``fits`` (n); see :class:`~mems6dof_ros.calibration.interface.Positions`."""
        count = len(fits)
        position = np.full((count, 3), np.nan)
        covariance = np.full((count, 3, 3), np.nan)
        z_gap = np.full(count, np.nan)
        flags = np.where(np.isfinite(fits.parameters).all(axis=1), 0, Flag.NO_Z).astype(np.uint32)
        usable = np.flatnonzero(flags == 0)
        if len(usable):
            position[usable], covariance[usable], z_gap[usable], flags[usable] = self._locate(
                fits[usable], None if moments is None else moments[usable]
            )
        return Positions(position, covariance, z_gap, flags)

    def candidates(self, fits: GaussianFits, moments: Moments | None = None) -> tuple[Array, Array]:
        """The best and second-best z (n, 2) m and the chi-square (n,) between them; NaN where none is."""
        z, gap = np.full((len(fits), 2), np.nan), np.full(len(fits), np.nan)
        usable = np.flatnonzero(np.isfinite(fits.parameters).all(axis=1))
        if len(usable):
            search = self._search(fits[usable], None if moments is None else moments[usable])
            z[usable] = search.defocus + self._model.focus(*search.measured[:, :2].T)[:, None]
            gap[usable] = search.objective[:, 1] - search.objective[:, 0]
        return z, gap

    def _search(self, fits: GaussianFits, moments: Moments | None) -> _Search:
        model, used = self._model, self._used
        x, y = field_position(fits.parameters, self._pixel_size, self._image_size)
        measured, noise = features(fits, moments, self._pixel_size, model.reference(x, y))
        measured[:, 0], measured[:, 1] = x, y
        local, inflation = model.curves.local(x, y), model.inflation(x, y)
        limits = self._limits(local)
        defocus, objective, chi_square = search_defocus(
            measured[:, used],
            noise[:, used[:, None], used[None, :]],
            local[:, used],
            inflation[:, used],
            limits,
            self._grid,
            self._basis,
            self._scatter,
        )
        return _Search(measured, noise, local, inflation, limits, defocus, objective, chi_square)

    def _locate(
        self, fits: GaussianFits, moments: Moments | None
    ) -> tuple[Array, Array, Array, NDArray[np.uint32]]:
        measured, noise, local, inflation, limits, defocus, objective, chi_square = self._search(
            fits, moments
        )
        best, second = defocus.T
        position, covariance = self._corrected(measured, noise, local, inflation, best)
        z_gap = objective[:, 1] - objective[:, 0]

        sd_u = np.sqrt(covariance[:, 2, 2])
        low, high = self._z_range
        ambiguous = z_gap < AMBIGUITY_GAP
        blind = ~(sd_u < BLIND_FRACTION * (high - low))
        first, last = self._grid[limits].T
        beyond = (best < np.maximum(low, first + sd_u)) | (best > np.minimum(high, last - sd_u))
        flags = np.where(ambiguous, Flag.Z_AMBIGUOUS, 0) | np.where(beyond, Flag.Z_OUT_OF_RANGE, 0)
        flags |= np.where(chi_square[:, 0] > self._misfit, Flag.POOR_FIT, 0) | np.where(blind, Flag.NO_Z, 0)
        if ambiguous.any():
            covariance[ambiguous] = self._mixture(
                position[ambiguous],
                covariance[ambiguous],
                self._corrected(*(a[ambiguous] for a in (measured, noise, local, inflation, second))),
                z_gap[ambiguous],
            )
        return position, covariance, z_gap, flags.astype(np.uint32)

    def _limits(self, local: Array) -> NDArray[np.int64]:
        """First and last grid point (n, 2) to consider: for a single feature the monotonic part of its curve
        through focus, as far as its scatter leaves it useful; one number cannot tell branches apart."""
        count = len(local)
        points = len(self._grid)
        if len(self._used) > 1:
            return np.tile(np.array([0, points - 1]), (count, 1))
        slope = local[:, self._used[0]] @ self._slope_basis.T / (self._grid[1] - self._grid[0])
        middle = int(np.argmin(np.abs(self._grid)))
        turns = slope * np.sign(slope[:, middle : middle + 1]) <= np.sqrt(self._scatter[:, 0, 0]) / _USELESS
        right = np.where(turns[:, middle:].any(axis=1), np.argmax(turns[:, middle:], axis=1), points - middle)
        left = np.where(turns[:, middle::-1].any(axis=1), np.argmax(turns[:, middle::-1], axis=1), middle + 1)
        # A curve that turns in focus itself leaves no branch: the particle is flagged as out of range.
        return np.stack(
            [np.minimum(middle - left + 1, middle), np.maximum(middle + right - 1, middle + 1)], axis=1
        )

    def _corrected(
        self, measured: Array, noise: Array, local: Array, inflation: Array, u: Array
    ) -> tuple[Array, Array]:
        """Positions (n, 3) at defocus ``u`` with their covariance (n, 3, 3), linearised there."""
        model = self._model
        motion, covariance = linearize(
            noise, local, inflation, u, model.curves.interval, self._used, model.nodes, model.scatter
        )
        place = measured[:, :2]
        covariance[:, 2, 2] += model.focus.variance(*place.T)
        position = np.column_stack([place - motion, u + model.focus(*place.T)])
        return position, covariance

    def _mixture(self, position: Array, covariance: Array, other: tuple[Array, Array], gap: Array) -> Array:
        """Second moment about ``position`` of two candidates whose L differ by ``gap``."""
        weight = (1 / (1 + np.exp(gap / 2)))[:, None, None]
        offset = other[0] - position
        spread = other[1] + offset[:, :, None] * offset[:, None, :]
        return (1 - weight) * covariance + weight * spread
