"""Positions by the likelihood of the pixels: the calibrated pupil in the form that ``psf_likelihood`` takes.

Rendered once over field and defocus, the images and their changes by the particles' own departures are
reduced to principal components, whose amplitudes are smooth curves. The fit of a particle starts from where
the shape of its Gaussian fit places it, from both places where there are two.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from mems6dof_ros.calibration.estimator import AMBIGUITY_GAP, BLIND_FRACTION, Estimator
from mems6dof_ros.calibration.field_curves import Array, FieldCurves
from mems6dof_ros.calibration.interface import Positions
from mems6dof_ros.calibration.moments import Moments
from mems6dof_ros.calibration.psf_likelihood import MARGIN, maximise
from mems6dof_ros.calibration.psf_model import MARGIN_PX, PsfModel
from mems6dof_ros.calibration.psf_pupil import PUPIL_TERMS, PupilImages
from mems6dof_ros.calibration.zernike import zernike, zernike_count, zernike_order
from mems6dof_ros.localization.camera import CameraNoise
from mems6dof_ros.localization.kernels import pixels
from mems6dof_ros.localization.localizations import Flag, GaussianFits

#: Light for which the components must be exact, electrons, and the deviance that what they lack may cost.
BRIGHT, TRUNCATION = 1e6, 0.3
#: Particles' own departures are followed along at most so many modes, such as 1e5 electrons can show.
MOST_MODES, LEAST_MODE = 4, 0.1
#: A second place is tried where its Gaussian shape is worse by less than this.
_SECOND = 60.0
#: Misfit in units of the calibration beads' that makes a fit poor, and rms residual of no concern.
_POOR, _LEAST_POOR = 4.0, 0.03
_MOST_ORDER, _DEGREE = 5, 26
_BACKGROUND = 10.0  # electrons per pixel, for weights only
_SAMPLE = 800


class _One(NamedTuple):
    """The fit of one particle."""

    position: Array
    covariance: Array
    quality: Array

    @property
    def deviance(self) -> float:
        return float(self.quality[0])


@dataclass(frozen=True)
class Components:
    """``images`` (k, side, side) and ``curves`` of their amplitudes: outputs are, for the image and then for
    each mode, the k components."""

    images: Array
    curves: FieldCurves
    modes: int


class PsfEstimator:
    """Positions of particles by their pixels, for z in ``z_range`` m."""

    def __init__(
        self,
        model: PsfModel,
        shape: Estimator,
        camera: CameraNoise,
        window_px: int,
        z_range: tuple[float, float],
        pixel_size: float,
        image_size: tuple[int, int],
        field: tuple[tuple[float, float], tuple[float, float]],
    ) -> None:
        """``shape`` says where to start; ``field``: lowest and highest x, then y, m, in which beads were."""
        self._model, self._shape, self._camera, self._window_px = model, shape, camera, window_px
        self._z_range, self._pixel_size, self._image_size = z_range, pixel_size, image_size
        self._field = field

    @cached_property
    def components(self) -> Components:
        return compress(self._model, self._window_px, self._field)

    def locate(self, fits: GaussianFits, moments: Moments, image: NDArray[np.generic]) -> Positions:
        """Positions of ``fits`` (n) in ``image``; see interface.Positions."""
        z, gap = self._shape.candidates(fits, moments)
        places = fits.parameters[:, :2]
        best = self._fit(image, places, z[:, 0])
        z_gap = np.where(gap < _SECOND, _SECOND, gap)
        for i in np.flatnonzero(gap < _SECOND):
            # Which of two places is right, the pixels decide.
            other = self._fit(image, places[i : i + 1], z[i : i + 1, 1])
            first, second = (_One(*(part[k] for part in parts)) for parts, k in ((best, i), (other, 0)))
            if not second.deviance >= first.deviance and np.isfinite(second.deviance):
                first, second = second, first
                for part, new in zip(best, first, strict=True):
                    part[i] = new
            offset = second.position - first.position
            if not abs(offset[2]) > 3 * np.sqrt(first.covariance[2, 2]):
                continue  # both have come to one place, or the second has not come anywhere
            z_gap[i] = second.deviance - first.deviance
            if z_gap[i] < AMBIGUITY_GAP:
                weight = 1 / (1 + np.exp(z_gap[i] / 2))
                spread = second.covariance + np.outer(offset, offset)
                best[1][i] = (1 - weight) * first.covariance + weight * spread
        position, covariance, quality = best
        return Positions(
            position, covariance, z_gap, self._flags(position, covariance, quality, z_gap, fits.flux)
        )

    def _fit(self, image: NDArray[np.generic], places_px: Array, z: Array) -> tuple[Array, Array, Array]:
        """Positions (n, 3) m, covariances and quality of the fits that start at ``z`` (n,) m."""
        model, components = self._model, self.components
        centre = (np.array(self._image_size) - 1) / 2
        pixel = self._pixel_size
        place = (places_px - centre) * pixel
        focus = model.focus(*place.T)
        slope = model.at(*place.T)[1]
        u = z - focus
        starts = np.column_stack([places_px - slope * u[:, None] / pixel, u])
        k = len(components.images)
        curves = components.curves.local(*place.T).reshape(len(z), 1 + components.modes, k, -1)
        parameters = np.empty((len(z), 5 + components.modes))
        covariance, quality = np.empty((len(z), 3, 3)), np.empty((len(z), 4))
        maximise(
            pixels(image),
            *self._camera.maps,
            self._window_px,
            starts,
            slope / pixel,
            components.images,
            np.ascontiguousarray(curves),
            np.array(components.curves.interval),
            model.pixel_misfit,
            parameters,
            covariance,
            quality,
        )
        position = np.column_stack([(parameters[:, :2] - centre) * pixel, parameters[:, 2] + focus])
        scale = np.array([pixel, pixel, 1.0])
        covariance *= scale[:, None] * scale
        covariance[:, 2, 2] += model.focus_variance
        return position, covariance, quality

    def _flags(
        self, position: Array, covariance: Array, quality: Array, z_gap: Array, flux: Array
    ) -> NDArray[np.uint32]:
        place, z = position[:, :2], position[:, 2]
        with np.errstate(invalid="ignore"):
            sd = np.sqrt(covariance[:, 2, 2])
            failed = ~(sd < BLIND_FRACTION * (self._z_range[1] - self._z_range[0]))
            u = z - self._model.focus(*place.T)
            low, high = self._model.interval
            beyond = (u < low + sd) | (u > high - sd)
            beyond |= (u < self._z_range[0]) | (u > self._z_range[1])
            _, chi_square, count, signal = quality.T
            usual = count + 4 * np.sqrt(2 * count) + (_POOR * self._model.misfit) ** 2 * signal
            poor = chi_square > usual + _LEAST_POOR**2 * flux
            flags = np.where(z_gap < AMBIGUITY_GAP, Flag.Z_AMBIGUOUS, 0)
        flags |= np.where(beyond, Flag.Z_OUT_OF_RANGE, 0) | np.where(poor, Flag.POOR_FIT, 0)
        return np.asarray(flags | np.where(failed, Flag.NO_Z, 0), dtype=np.uint32)


def compress(
    model: PsfModel, window_px: int, field: tuple[tuple[float, float], tuple[float, float]]
) -> Components:
    """The images of ``model`` over the ``field`` as principal components with smooth amplitudes."""
    side = window_px + MARGIN_PX
    pupil = PupilImages(model.imaging, side + -side % 4)
    scale = float(np.exp(model.ln_diameter))
    # Images are not linear in the wavefront: they vary over the field with higher orders than it does.
    order = zernike_order(model.wavefront.shape[1])
    order = min(order + 2, _MOST_ORDER) if order > 0 else 0
    grid = order + 2 if order > 0 else 1
    # Chebyshev nodes over the field as over defocus: what is fitted there is as good at the edges.
    nodes = -np.cos(np.pi * (np.arange(grid) + 0.5) / grid)
    x, y = (
        a.ravel()
        for a in np.meshgrid(*(0.5 * (high + low) + 0.5 * (high - low) * nodes for low, high in field))
    )
    low, high = model.interval
    heights = -np.cos(np.pi * (np.arange(_DEGREE + 3) + 0.5) / (_DEGREE + 3))
    u = 0.5 * (high + low) + 0.5 * (high - low) * heights
    wavefront, _ = model.at(x, y)
    modes = _modes(model, pupil, scale)
    middle, reach = pupil.side_px // 2, window_px // 2 + MARGIN
    cut = np.s_[:, middle - reach : middle + reach + 1, middle - reach : middle + reach + 1]
    size = 2 * reach + 1
    rows = np.empty((1 + len(modes), len(x), len(u), size * size))
    for index, waves in enumerate(wavefront):
        tiled = np.tile(waves, (len(u), 1))
        rows[0, index] = pupil.images(tiled, u, scale=scale)[cut].reshape(len(u), -1)
        for number, mode in enumerate(modes):
            forth = pupil.images(tiled + mode[:-1], u, scale=scale * np.exp(mode[-1]))
            back = pupil.images(tiled - mode[:-1], u, scale=scale * np.exp(-mode[-1]))
            rows[1 + number, index] = (0.5 * (forth - back))[cut].reshape(len(u), -1)
    flat = rows.reshape(-1, size * size)
    weight = 1 / np.sqrt(np.mean(rows[0], axis=(0, 1)) + _BACKGROUND / BRIGHT)
    # Neighbours in this list are all but equal: a sample of it spans the same space.
    sample = flat[np.random.default_rng(0).permutation(len(flat))[:_SAMPLE]] * weight
    values, vectors = np.linalg.eigh(sample @ sample.T)
    # What is left out of an image costs BRIGHT sum_pixels (dI)^2 / I of deviance.
    left_out = np.cumsum(np.maximum(values, 0)) * BRIGHT / len(sample) * (1 + len(modes))
    chosen = np.s_[np.searchsorted(left_out, TRUNCATION) :]
    kept = sample.T @ (vectors[:, chosen] / np.sqrt(values[chosen]))
    amplitudes = (flat * weight) @ kept
    images = (kept.T / weight).reshape(-1, size, size)
    amplitudes = amplitudes.reshape(1 + len(modes), len(x), len(u), -1)
    over_field = np.linalg.pinv(zernike(order, x / model.radius, y / model.radius))
    over_defocus = np.linalg.pinv(chebyshev.chebvander(heights, _DEGREE))
    coefficients = np.einsum("jf,du,mfuk->mkjd", over_field, over_defocus, amplitudes, optimize=True)
    coefficients = coefficients.reshape(-1, zernike_count(order), _DEGREE + 1)
    curves = FieldCurves(model.radius, model.interval, coefficients)
    return Components(np.ascontiguousarray(images), curves, len(modes))


def _modes(model: PsfModel, pupil: PupilImages, scale: float) -> Array:
    """Own departures (m, terms + 1) of unit variance that matter for images of 1e5 electrons."""
    low, high = model.interval
    u = np.linspace(max(low, -2e-6), min(high, 2e-6), 5)
    wavefront = np.tile(model.at(np.zeros(1), np.zeros(1))[0], (len(u), 1))
    found = pupil.derivatives(wavefront, u, scale=scale)
    tangents = np.concatenate([found.by_wavefront, found.by_diameter[:, None]], axis=1)
    tangents = tangents.reshape(len(u), len(PUPIL_TERMS) + 1, -1)
    weight = 1e5 / np.maximum(found.image.reshape(len(u), 1, -1) + _BACKGROUND / 1e5, 1e-6)
    information = np.mean((tangents * weight) @ tangents.swapaxes(1, 2), axis=0)
    values, vectors = np.linalg.eigh(model.scatter)
    root = vectors * np.sqrt(np.maximum(values, 0))
    seen, directions = np.linalg.eigh(root.T @ information @ root)
    chosen = np.argsort(seen)[::-1][:MOST_MODES]
    chosen = chosen[seen[chosen] > LEAST_MODE]
    return np.asarray((root @ directions[:, chosen]).T)
