"""The forward model of the optics: what the Gaussian fit sees of a particle at (X, Y, z).

Features of every fitted image, in the order of FEATURES: the apparent lateral motion ``dx``, ``dy`` (m), the
shape ``ln sigma_x``, ``ln sigma_y`` (of px), ``atanh rho``, the paper's ``rho_amp``, and the moments of what
the Gaussian leaves over. None of them changes with brightness. The model knows how they vary with defocus
u and over the field, and how much real particles scatter about it, because local aberrations and
diameters differ.

Heights split as z = u + f(X, Y): u is the distance to the local focus (sharpest image), and the focus
surface f holds field curvature and tilt, zero on the axis.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numba import njit

from mems6dof_ros.calibration.bead_field import BeadField, used_order
from mems6dof_ros.calibration.field_curves import Array, FieldCurves
from mems6dof_ros.calibration.moments import MOMENTS, Moments
from mems6dof_ros.calibration.zernike import zernike, zernike_order
from mems6dof_ros.localization.localizations import GaussianFits

#: Order of the features everywhere in this room.
FEATURES = ("dx", "dy", "ln_sigma_x", "ln_sigma_y", "atanh_rho", "rho_amp", *MOMENTS)
_FITTED = len(FEATURES) - len(MOMENTS)
_BETTER = 0.98  # of a score, before a higher order is taken


@dataclass(frozen=True)
class FieldMap:
    """A scalar over the field: Zernike ``coefficients`` (terms,) on a disc of ``radius`` m."""

    radius: float
    coefficients: Array

    def __call__(self, x: Array, y: Array) -> Array:
        """Value at field positions ``x``, ``y`` (n,) m: (n,)."""
        order = zernike_order(len(self.coefficients))
        return zernike(order, x / self.radius, y / self.radius) @ self.coefficients


@dataclass(frozen=True)
class FocusSurface(FieldMap):
    """Where ``beads``, at unknown heights of their own, show the optics to be in focus, m.
    ``mean_variance`` m^2: of the surface, mean over the beads."""

    mean_variance: float
    beads: BeadField

    def scaled_influence(self, x: Array, y: Array) -> Array:
        """Rows (n, terms) m at ``x``, ``y`` (n,) m whose products are the covariance of the surface."""
        terms = len(self.coefficients)
        if not len(self.beads.places):
            return np.full((len(x), 1), np.sqrt(self.mean_variance))
        one_bead = self.mean_variance * len(self.beads.places) / terms
        return np.sqrt(one_bead) * self.beads.influence(zernike_order(terms), x, y)

    def variance(self, x: Array, y: Array) -> Array:
        """Variance (n,) m^2 of the surface at ``x``, ``y`` (n,) m."""
        return np.asarray(np.sum(self.scaled_influence(x, y) ** 2, axis=1))


def fit_field_map(
    radius: float, x: Array, y: Array, values: Array, orders: Sequence[int]
) -> tuple[FieldMap, Array]:
    """Map of ``values`` (b,) measured at ``x``, ``y`` (b,) m, of the lowest of ``orders`` that predicts
    values left out as well as any, and how far each value lies from what the others predict (b,)."""
    best: tuple[float, Array, Array] | None = None
    for order in orders:
        design = zernike(order, x / radius, y / radius)
        if best is not None and design.shape[1] > len(values) / 2:
            break
        inverse = np.linalg.pinv(design)
        leverage = np.einsum("bj,jb->b", design, inverse)
        left_out = (values - design @ (inverse @ values)) / np.maximum(1 - leverage, 1e-3)
        score = float(np.mean(left_out**2))
        if best is None or score < _BETTER * best[0]:
            best = score, inverse @ values, left_out
    assert best is not None
    return FieldMap(radius, best[1]), best[2]


@dataclass(frozen=True)
class OpticalModel:
    """``curves`` of the FEATURES over defocus u (m) and field; ``focus`` f(X, Y) in m; ``reference``, the
    natural logarithm of the amplitude at rho* over the flux (px^-2), for rho_amp.

    ``nodes`` (g,) m: defocus at which ``scatter`` (g, k, k) gives the covariance of the particles'
    features about the true curves, fit noise excluded; ``inflation`` is what the fitted curves add.
    ``illumination``: natural logarithm of the brightness over the field relative to the axis; None in
    files written before it was measured.
    """

    curves: FieldCurves
    focus: FocusSurface
    reference: FieldMap
    nodes: Array
    scatter: Array
    illumination: FieldMap | None = None

    @cached_property
    def _orders(self) -> tuple[int, ...]:
        return tuple(used_order(coefficients) for coefficients in self.curves.coefficients)

    def inflation(self, x: Array, y: Array) -> Array:
        """Standard deviations (n, k) of particles' features about the model at ``x``, ``y`` (n,) m, over
        those of ``scatter``: the curves are known from beads that scatter, less well where these are far."""
        return self.focus.beads.inflation(self._orders, x, y)

    def brightness(self, fits: GaussianFits, x: Array, y: Array) -> Array:
        """Electrons (n,) that the particles of ``fits`` at ``x``, ``y`` (n,) m would show on the axis."""
        return fits.flux if self.illumination is None else fits.flux / np.exp(self.illumination(x, y))

    def scatter_at(self, u: Array) -> Array:
        """``scatter`` interpolated linearly at defocus ``u`` (n,): (n, k, k)."""
        position = np.clip((u - self.nodes[0]) / (self.nodes[1] - self.nodes[0]), 0, len(self.nodes) - 1)
        left = np.minimum(position.astype(np.intp), len(self.nodes) - 2)
        weight = (position - left)[:, None, None]
        return (1 - weight) * self.scatter[left] + weight * self.scatter[left + 1]


def field_position(parameters: Array, pixel_size: float, image_size: tuple[int, int]) -> tuple[Array, Array]:
    """Field coordinates X, Y (n,) m of fitted ``parameters`` (n, 7): origin at the centre of the image."""
    width, height = image_size
    return (
        (parameters[:, 0] - (width - 1) / 2) * pixel_size,
        (parameters[:, 1] - (height - 1) / 2) * pixel_size,
    )


def features(
    fits: GaussianFits, moments: Moments | None, pixel_size: float, log_reference: Array
) -> tuple[Array, Array]:
    """FEATURES (n, k) and their covariance (n, k, k) from ``fits``; NaN for the moments without them.

    dx and dy are here the fitted positions in m (of px 0). ``log_reference`` (n,): ln of the reference
    amplitude over flux, in px^-2; with A = flux / (2 pi sigma_x sigma_y sqrt(1 - rho^2)) the paper's
    rho_amp = rho A(rho*) / A becomes 2 pi exp(log_reference) sigma_x sigma_y rho sqrt(1 - rho^2).
    """
    values = np.full((len(fits), len(FEATURES)), np.nan)
    covariance = np.zeros((len(fits), len(FEATURES), len(FEATURES)))
    _shape(fits.parameters, fits.covariance, pixel_size, log_reference, values, covariance)
    if moments is not None:
        # The residual of a well-weighted fit is all but uncorrelated with its parameters.
        values[:, _FITTED:] = moments.values
        covariance[:, _FITTED:, _FITTED:] = moments.covariance
    return values, covariance


@njit(cache=True, nogil=True)
def _shape(
    parameters: Array,
    parameter_covariance: Array,
    pixel_size: float,
    log_reference: Array,
    values: Array,
    covariance: Array,
) -> None:
    """Write the first _FITTED features and their covariance."""
    jacobian = np.zeros((_FITTED, 7))
    jacobian[0, 0] = jacobian[1, 1] = pixel_size
    product = np.empty(7)
    for i in range(len(parameters)):
        x, y, rho = parameters[i, 0], parameters[i, 1], parameters[i, 5]
        sigma_x, sigma_y = parameters[i, 3], parameters[i, 4]
        complement = 1 - rho**2
        root = math.sqrt(complement)
        scale = 2 * math.pi * math.exp(log_reference[i]) * sigma_x * sigma_y
        rho_amp = scale * rho * root
        values[i, 0], values[i, 1] = x * pixel_size, y * pixel_size
        values[i, 2], values[i, 3] = math.log(sigma_x), math.log(sigma_y)
        values[i, 4], values[i, 5] = math.atanh(rho), rho_amp
        jacobian[2, 3] = 1 / sigma_x
        jacobian[3, 4] = 1 / sigma_y
        jacobian[4, 5] = 1 / complement
        jacobian[5, 3], jacobian[5, 4] = rho_amp / sigma_x, rho_amp / sigma_y
        jacobian[5, 5] = scale * (1 - 2 * rho**2) / root
        for a in range(_FITTED):
            for q in range(7):
                product[q] = 0.0
                for p in range(7):
                    product[q] += jacobian[a, p] * parameter_covariance[i, p, q]
            for b in range(_FITTED):
                entry = 0.0
                for q in range(7):
                    entry += product[q] * jacobian[b, q]
                covariance[i, a, b] = entry
