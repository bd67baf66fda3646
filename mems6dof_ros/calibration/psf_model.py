"""The calibrated point-spread function: a pupil whose phase varies smoothly over the field, and its scatter.

It is fitted to the pixels of the calibration beads (see psf_fit) and owes nothing to the Gaussian fits but
starting values. Heights count as in the forward model of the Gaussians, so that methods agree on z.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Protocol

import numpy as np

from mems6dof_ros.calibration.bead_field import BeadField, used_order
from mems6dof_ros.calibration.field_curves import Array
from mems6dof_ros.calibration.optical_model import FocusSurface, fit_field_map
from mems6dof_ros.calibration.psf_fit import (
    COUNT,
    DIAMETER,
    PLACE,
    REACH,
    SLOPE,
    STAGE,
    WAVEFRONT,
    BeadWindows,
    Retrieval,
    retrieve,
)
from mems6dof_ros.calibration.psf_pupil import PUPIL_TERMS, Imaging, PupilImages
from mems6dof_ros.calibration.zernike import zernike, zernike_order

#: Field orders that cross-validation chooses from, for every coefficient by itself.
FIELD_ORDERS = (0, 1, 2, 3, 4)
#: Margin of rendered windows about those of the data, px.
MARGIN_PX = 14
_MANY_BEADS = 20
_LEAST_BEADS = 4
_LEAST_SCATTER = 1e-10


@dataclass(frozen=True)
class PsfModel:
    """The pupil over the field and the scatter of particles about it.

    ``wavefront`` (terms, Zernike terms of the field) waves rms, in the order of PUPIL_TERMS; ``slope``
    (2, Zernike terms) rad of the chief ray; both on a disc of ``radius`` m, filled up with zeros where a
    term needs a lower order. ``ln_diameter``: of the mean diameter over the nominal one. ``focus``: z of
    zero defocus. ``scatter`` (terms + 1, terms + 1): covariance of single particles' coefficients and ln
    diameter about their true means; ``inflation`` is what fitted means add. ``interval`` m: defocus that
    the beads covered. ``misfit``: relative error of the model where the beads' light is, beyond noise.
    """

    imaging: Imaging
    radius: float
    wavefront: Array
    slope: Array
    ln_diameter: float
    focus: FocusSurface
    scatter: Array
    interval: tuple[float, float]
    misfit: float

    @property
    def pixel_misfit(self) -> float:
        """``misfit`` as it would be, were it every pixel's own: images are band-limited to 2 NA / lambda, so
        that pixels within lambda / 4 NA of each other are wrong together."""
        cell = self.imaging.wavelength / (4 * self.imaging.numerical_aperture)
        return self.misfit * max(1.0, cell / self.imaging.pixel_size)

    @cached_property
    def _orders(self) -> tuple[int, ...]:
        return *(used_order(coefficients) for coefficients in self.wavefront), 0

    def inflation(self, x: Array, y: Array) -> Array:
        """Standard deviations (n, terms + 1) of particles' coefficients and ln diameter about the model at
        ``x``, ``y`` (n,) m, over those of ``scatter``: the field is known from beads that scatter, and less
        well where these are far."""
        return self.focus.beads.inflation(self._orders, x, y)

    def at(self, x: Array, y: Array) -> tuple[Array, Array]:
        """Wavefronts (n, terms) waves and chief-ray slopes (n, 2) rad at field positions (n,) m."""
        order = zernike_order(self.wavefront.shape[1])
        terms = zernike(order, x / self.radius, y / self.radius)
        return terms @ self.wavefront.T, terms @ self.slope.T


@dataclass(frozen=True)
class PsfBead:
    """What the fit needs of a bead: its ``windows``, field position ``x``, ``y`` m, first guess of the stage
    position of focus ``stage_z`` m and of its ``place_px`` (column, row)."""

    windows: BeadWindows
    x: float
    y: float
    stage_z: float
    place_px: tuple[float, float]


#: Fits stage positions (b,) m of focus over the field.
FitFocus = Callable[[Array], FocusSurface]


def fit_psf(
    beads: Sequence[PsfBead],
    imaging: Imaging,
    radius: float,
    interval: tuple[float, float],
    heights: Array,
    focus: FitFocus,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> tuple[PsfModel, list[Retrieval]]:
    """Fit the pupil over the field to ``beads``.

    ``heights`` (b,) m: z of each bead in the convention of the forward model, plus its stage position, which
    fixes the origin of z. ``interval`` m: defocus to declare covered. Returns the model and every bead's
    own pupil.
    """
    side = beads[0].windows.electrons.shape[1] + MARGIN_PX
    pupil = PupilImages(imaging, side + -side % 4)
    reach = REACH * imaging.wavelength / imaging.numerical_aperture**2
    found: list[Retrieval] = []
    # From the middle of the field outwards, so that each bead can start from its neighbour's pupil.
    places = np.array([(bead.x, bead.y) for bead in beads])
    order = np.argsort(np.hypot(*(places - places.mean(axis=0)).T))
    results: dict[int, Retrieval] = {}
    for done, index in enumerate(order):
        bead = beads[index]
        start, centre = np.zeros(COUNT), np.zeros(COUNT)
        if results:
            near = min(results, key=lambda k: float(np.hypot(*(places[k] - places[index]))))
            start[SLOPE.start :] = results[near].parameters[SLOPE.start :]
        start[STAGE], start[PLACE] = bead.stage_z * 1e6, bead.place_px
        centre[STAGE], centre[PLACE] = start[STAGE], start[PLACE]
        results[int(index)] = retrieve(bead.windows.near(bead.stage_z, reach), pupil, start, centre)
        progress(done + 1, len(beads))
    found = [results[index] for index in range(len(beads))]
    return _model(places, found, imaging, radius, interval, heights, focus), found


def _model(
    places: Array,
    found: Sequence[Retrieval],
    imaging: Imaging,
    radius: float,
    interval: tuple[float, float],
    heights: Array,
    focus: FitFocus,
) -> PsfModel:
    values = np.array([r.parameters for r in found])
    noise = np.mean([r.covariance for r in found], axis=0)
    beads = len(values)
    x, y = places.T
    fitted = [fit_field_map(radius, x, y, values[:, k], FIELD_ORDERS) for k in range(SLOPE.start, DIAMETER)]
    terms = max(len(field_map.coefficients) for field_map, _ in fitted)
    field = np.array([np.pad(m.coefficients, (0, terms - len(m.coefficients))) for m, _ in fitted])
    slopes = SLOPE.stop - SLOPE.start
    mean_diameter = float(np.mean(values[:, DIAMETER]))
    stages = values[:, STAGE] * 1e-6
    surface = focus(stages)
    # Own departures from what the others say, which is as uncertain as the leverage 1 / (1 - h) - 1 says.
    own = np.column_stack(
        [left_out for _, left_out in fitted[slopes:]]
        + [(values[:, DIAMETER] - mean_diameter) * beads / max(beads - 1, 1)]
    )
    orders = [zernike_order(len(m.coefficients)) for m, _ in fitted[slopes:]] + [0]
    leverage = np.column_stack([surface.beads.leverage(order, x, y) for order in orders])
    own *= np.sqrt(np.maximum(1 - leverage, 0))
    scatter = own.T @ own / beads - noise[WAVEFRONT.start :, WAVEFRONT.start :]
    apart = max(0.0, 1 - beads / _MANY_BEADS)
    scatter = (1 - apart) * scatter + apart * np.diag(np.diag(scatter))
    # A variance known from few beads: what is measured next follows Student's distribution.
    count = max(beads, _LEAST_BEADS)
    scatter *= count / (count - 2)
    piston = float(np.mean(heights - stages - surface(x, y)))
    coefficients = surface.coefficients.copy()
    coefficients[0] += piston
    return PsfModel(
        imaging,
        radius,
        field[slopes:],
        field[:slopes] * imaging.pixel_size * 1e6,
        mean_diameter,
        replace(surface, coefficients=coefficients),
        _positive(scatter),
        (interval[0] - piston, interval[1] - piston),
        float(np.sqrt(max(float(np.mean([r.misfit for r in found])), 0.0))),
    )


def _positive(matrix: Array) -> Array:
    """The nearest positive semidefinite matrix."""
    values, vectors = np.linalg.eigh(matrix)
    return (vectors * np.maximum(values, _LEAST_SCATTER)) @ vectors.T


class Fields(Protocol):
    """Reads checked values by name (see file.py)."""

    def section(self, name: str) -> Fields: ...
    def array(self, name: str, *shape: int) -> Array: ...
    def number(self, name: str) -> float: ...
    def interval(self, name: str) -> tuple[float, float]: ...


def content(model: PsfModel) -> dict[str, Any]:
    """Plain values of ``model`` for the calibration file; ``read`` is the inverse."""
    imaging = model.imaging
    return {
        "numerical_aperture": float(imaging.numerical_aperture),
        "wavelength_m": float(imaging.wavelength),
        "nominal_diameter_m": float(imaging.diameter),
        "pixel_size_m": float(imaging.pixel_size),
        "disc_radius_m": float(model.radius),
        "pupil_terms_osa": list(PUPIL_TERMS),
        "wavefront_waves": model.wavefront.tolist(),
        "chief_ray_slope_rad": model.slope.tolist(),
        "ln_diameter_over_nominal": float(model.ln_diameter),
        "focus_surface_m": model.focus.coefficients.tolist(),
        "focus_variance_m2": float(model.focus.mean_variance),
        "scatter_covariance": model.scatter.tolist(),
        "defocus_interval_m": [float(v) for v in model.interval],
        "misfit": float(model.misfit),
    }


def read(fields: Fields, beads: BeadField) -> PsfModel:
    """The model, fitted to ``beads``, that ``content`` described; InputError for what it could not be."""
    terms = len(PUPIL_TERMS)
    radius = fields.number("disc_radius_m")
    wavefront = fields.array("wavefront_waves", terms, -1)
    return PsfModel(
        Imaging(
            fields.number("numerical_aperture"),
            fields.number("wavelength_m"),
            fields.number("nominal_diameter_m"),
            fields.number("pixel_size_m"),
        ),
        radius,
        wavefront,
        fields.array("chief_ray_slope_rad", 2, wavefront.shape[1]),
        fields.number("ln_diameter_over_nominal"),
        FocusSurface(radius, fields.array("focus_surface_m", -1), fields.number("focus_variance_m2"), beads),
        fields.array("scatter_covariance", terms + 1, terms + 1),
        fields.interval("defocus_interval_m"),
        fields.number("misfit"),
    )
