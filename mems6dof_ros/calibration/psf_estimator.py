"""Positions by the likelihood of the pixels: the calibrated pupil in the form that ``psf_likelihood`` takes.

Rendered once over field and defocus, the images and their changes by the particles' own departures are
reduced to principal components, whose amplitudes are smooth curves. The fit of a particle starts from where
the shape of its Gaussian fit places it, from both places where there are two.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from mems6dof_ros.calibration.estimator import AMBIGUITY_GAP, BLIND_FRACTION, Estimator
from mems6dof_ros.calibration.field_curves import Array, FieldCurves
from mems6dof_ros.calibration.interface import Positions
from mems6dof_ros.calibration.moments import Moments
from mems6dof_ros.calibration.psf_likelihood import MARGIN, maximise
from mems6dof_ros.calibration.psf_model import MARGIN_PX, PsfModel
from mems6dof_ros.calibration.psf_neighbours import MOST, REACH, groups, maximise_together, two_places
from mems6dof_ros.calibration.psf_pupil import PUPIL_TERMS, PupilImages
from mems6dof_ros.calibration.zernike import zernike, zernike_count, zernike_order
from mems6dof_ros.localization.camera import CameraNoise
from mems6dof_ros.localization.kernels import pixels
from mems6dof_ros.localization.localizations import Flag, GaussianFits

Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]

#: Light for which the components must be exact, electrons, and the deviance that what they lack may cost.
BRIGHT, TRUNCATION = 1e6, 0.3
#: Particles' own departures are followed along at most so many modes, such as 1e5 electrons can show.
MOST_MODES, LEAST_MODE = 4, 0.1
#: A second place is tried where its Gaussian shape is worse by less than this.
_SECOND = 60.0
#: Misfit in units of the calibration beads' that makes a fit poor, and rms residual of no concern.
_POOR, _LEAST_POOR = 4.0, 0.03
#: Of several particles fitted together, the light of the faintest over that of the brightest, at least.
LEAST_LIGHT = 0.02
#: Each of two that were taken for one has at least this of the median light of the others.
LEAST_OF_SPLIT = 0.4
_MOST_ORDER, _DEGREE = 5, 26
_BACKGROUND = 10.0  # electrons per pixel, for weights only
_SAMPLE = 800


class _One(NamedTuple):
    """The fit of one particle."""

    position: Array
    covariance: Array
    quality: Array
    light: Array

    @property
    def deviance(self) -> float:
        return float(self.quality[0])


class _Start(NamedTuple):
    """Where fits of n particles begin: ``starts`` (n, 3), ``slopes`` (n, 2) and ``curves`` as for the
    likelihood, ``focus`` (n,) m; and room for their ``parameters``."""

    starts: Array
    slopes: Array
    curves: Array
    focus: Array
    parameters: Array


class _Joint(NamedTuple):
    """Particles fitted together: ``of`` (g,): the Gaussian fit that each was in, ``position`` (g, 3) m,
    ``covariance``, ``flags``, the places ``seen`` (g, 2) px and ``light`` (g,) electrons."""

    of: Indices
    position: Array
    covariance: Array
    flags: NDArray[np.uint32]
    seen: Array
    light: Array


@dataclass(frozen=True)
class Components:
    """``images`` (k, side, side) and ``curves`` of their amplitudes: outputs are, for the image and then for
    each mode, the k components. ``shares`` (m, terms + 1): of the pupil's coefficients and ln diameter in
    what each mode changes."""

    images: Array
    curves: FieldCurves
    shares: Array

    @property
    def modes(self) -> int:
        return len(self.shares)


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
        self._centre_px = (np.array(image_size) - 1) / 2

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
        position, covariance, quality, light = best
        flags = self._flags(position, covariance, quality, z_gap, fits.flux)
        return self._with_neighbours(fits, image, Positions(position, covariance, z_gap, flags), light)

    def _fit(
        self, image: NDArray[np.generic], places_px: Array, z: Array
    ) -> tuple[Array, Array, Array, Array]:
        """Positions (n, 3) m, covariances, quality and light of the fits that start at ``z`` (n,) m."""
        start = self._start(places_px, z)
        n = len(z)
        parameters, covariance, quality = start.parameters, np.empty((n, 3, 3)), np.empty((n, 4))
        maximise(*self._arguments(image, start), parameters, covariance, quality)
        return *self._in_metres(start, covariance), quality, parameters[:, 3]

    def _start(self, places_px: Array, z: Array) -> _Start:
        """Where fits of particles seen at ``places_px`` (n, 2) begin that are taken to be at ``z`` (n,) m."""
        model, components, pixel = self._model, self.components, self._pixel_size
        place = (places_px - self._centre_px) * pixel
        focus = model.focus(*place.T)
        slope = model.at(*place.T)[1]
        u = z - focus
        starts = np.column_stack([places_px - slope * u[:, None] / pixel, u])
        curves = components.curves.local(*place.T).reshape(
            len(z), 1 + components.modes, len(components.images), -1
        )
        # A mode of unit prior is as large as particles differ from the fitted field there.
        larger = np.sqrt(model.inflation(*place.T) ** 2 @ components.shares.T)
        curves[:, 1:] *= larger[:, :, None, None]
        parameters = np.empty((len(z), 5 + components.modes))
        return _Start(starts, slope / pixel, np.ascontiguousarray(curves), focus, parameters)

    def _arguments(self, image: NDArray[np.generic], start: _Start) -> tuple[Any, ...]:
        """What both likelihoods want to know."""
        return (
            pixels(image), *self._camera.maps, self._window_px, start.starts, start.slopes,
            self.components.images, start.curves, np.array(self.components.curves.interval),
            self._model.pixel_misfit,
        )  # fmt: skip

    def _in_metres(self, start: _Start, covariance: Array) -> tuple[Array, Array]:
        """Positions and covariances of fits in px and m of defocus."""
        pixel, parameters = self._pixel_size, start.parameters
        position = np.column_stack(
            [(parameters[:, :2] - self._centre_px) * pixel, parameters[:, 2] + start.focus]
        )
        scale = np.array([pixel, pixel, 1.0])
        covariance = covariance * scale[:, None] * scale
        covariance[:, 2, 2] += self._model.focus.variance(*position[:, :2].T)
        return position, covariance

    # ------------------------------------------------------------------------ neighbours

    def _with_neighbours(
        self, fits: GaussianFits, image: NDArray[np.generic], found: Positions, light: Array
    ) -> Positions:
        """``found``, of ``light`` electrons, with particles in each other's light fitted together, and with
        two positions for what one Gaussian was fitted to where the pixels show two particles."""
        unclear = (found.flags & (Flag.POOR_FIT | Flag.NO_Z)) != 0
        if unclear.all():
            return found
        # All particles of a body are at about one height: where a fit alone is of no use, that is the start.
        usual = float(np.median(found.position[~unclear, 2]))
        # And of about one light, so that one out of focus is not taken for two.
        least_light = LEAST_OF_SPLIT * float(np.median(light[~unclear]))
        z = np.where(unclear, usual, found.position[:, 2])
        places = fits.parameters[:, :2]
        failed = np.isnan(places[:, 0])
        if fits.sought is not None:
            # Where the light of several is no Gaussian at all, it is known where they were seen.
            places = np.where(unclear[:, None], fits.sought, places)

        def explained(members: Indices) -> _Joint | None:
            if len(members) > MOST:
                return None
            if len(members) > 1 and (fit := self._together(image, members, places[members], z[members])):
                return fit
            for blob in members[unclear[members]] if len(members) < MOST else ():
                others = members[members != blob]
                two = self._two_places(image, places[blob], places[others], usual)
                if two is None:
                    continue
                of = np.r_[blob, blob, others]
                heights = np.r_[usual, usual, z[others]]
                fit = self._together(image, of, np.concatenate([two, places[others]]), heights)
                if fit and fit.light[:2].min() > least_light:
                    return fit
            return None

        joints = []
        todo = groups(places, self._window_px)
        alone = unclear & np.isfinite(places).all(axis=1)
        alone[np.concatenate([*todo, np.empty(0, np.int64)])] = False
        todo += [np.array([one]) for one in np.flatnonzero(alone)]
        while todo:
            members = todo.pop()
            if fit := explained(members):
                joints.append(fit)
            elif failed[members].any():
                # Perhaps nothing was there.
                rest = members[~failed[members]]
                todo += [rest[part] for part in groups(places[rest], self._window_px)]
        return _replaced(fits, found, light, ~unclear, joints) if joints else found

    def _together(self, image: NDArray[np.generic], of: Indices, places_px: Array, z: Array) -> _Joint | None:
        """Joint fit of particles seen at ``places_px`` (g, 2), taken to be at ``z`` (g,) m; None where that
        does not explain the pixels."""
        start, g = self._start(places_px, z), len(z)
        covariance, quality = np.empty((g, 3, 3)), np.empty((g, 4))
        if not maximise_together(*self._arguments(image, start), start.parameters, covariance, quality):
            return None
        light = start.parameters[:, 3]
        position, covariance = self._in_metres(start, covariance)
        flags = self._flags(position, covariance, quality, np.full(g, np.inf), np.full(g, light.sum()))
        if (flags & (Flag.POOR_FIT | Flag.NO_Z)).any() or light.min() < LEAST_LIGHT * light.max():
            return None
        seen = start.parameters[:, :2] + start.slopes * start.parameters[:, 2:3]
        return _Joint(of, position, covariance, flags, seen, light)

    def _two_places(self, image: NDArray[np.generic], blob: Array, others: Array, z: float) -> Array | None:
        """Two places (2, 2) px that explain what is seen about ``blob`` (2,) px beside what is at ``others``
        (k, 2), for heights of ``z`` m; None where there are none."""
        model, components, window = self._model, self.components, self._window_px
        start = self._start(blob[None], np.array([z]))
        low, high = components.curves.interval
        s = np.clip((2 * start.starts[0, 2] - low - high) / (high - low), -1, 1)
        amplitudes = chebyshev.chebval(s, start.curves[0, 0].T)
        margin = (components.images.shape[1] - window) // 2
        unit = np.tensordot(amplitudes, components.images, 1)[margin:-margin, margin:-margin]
        middle = np.rint(blob).astype(int)
        reach = max(REACH, math.ceil(np.abs(others - middle).max(initial=0)))
        half = window // 2 + reach
        # Beyond the image's edge nothing is known, and no light is the middle course.
        columns, rows = (np.arange(c - half, c + half + 1) for c in middle)
        inside = np.ix_(*((r >= 0) & (r < n) for r, n in zip((rows, columns), image.shape, strict=True)))
        part = np.ix_(*(r[(r >= 0) & (r < n)] for r, n in zip((rows, columns), image.shape, strict=True)))
        offset, gain, _ = (v[part] if v.size > 1 else v for v in self._camera.maps)
        seen = (image[part].astype(float) - offset) / gain
        if not seen.size:
            return None
        electrons = np.zeros((2 * half + 1, 2 * half + 1))
        electrons[inside] = seen - np.percentile(seen, 20)
        least = 0.8 * model.imaging.diameter / self._pixel_size
        places = two_places(electrons, unit, least, others - middle)
        return None if places is None else places + middle

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


def _replaced(
    fits: GaussianFits, found: Positions, light: Array, clear: Mask, joints: Sequence[_Joint]
) -> Positions:
    """``found``, of ``light`` (n,), with the particles of ``joints`` in place of their Gaussians. Of two that
    were in one, the second is appended. What was not ``clear`` (n,) has the shape of what was."""
    shape, usual = np.median(fits.parameters[clear], axis=0), float(np.median(light[clear]))
    of, rows = list(range(len(fits))), []
    for joint in joints:
        for number, row in enumerate(joint.of.tolist()):
            if row in joint.of[:number]:
                of.append(row)
                row = len(of) - 1
            rows.append(row)
    fits = fits[np.array(of)]
    position, covariance, flags = found.position[of], found.covariance[of], found.flags[of]
    position[rows] = np.concatenate([joint.position for joint in joints])
    covariance[rows] = np.concatenate([joint.covariance for joint in joints])
    flags[rows] = np.concatenate([joint.flags for joint in joints])
    z_gap = found.z_gap[of]
    z_gap[rows] = np.nan
    parameters = fits.parameters[rows]
    unlike = ~clear[np.array(of)[rows]]
    parameters[unlike] = shape
    parameters[unlike, 2] *= np.concatenate([joint.light for joint in joints])[unlike] / usual
    parameters[:, :2] = np.concatenate([joint.seen for joint in joints])
    fits.parameters[rows] = parameters
    # What was said against the Gaussians is explained.
    fits.flags[rows] &= ~np.uint32(Flag.NEIGHBOUR | Flag.POOR_FIT | Flag.FIT_FAILED)
    return Positions(position, covariance, z_gap, flags, fits)


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
    modes, shares = _modes(model, pupil, scale)
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
    return Components(np.ascontiguousarray(images), curves, shares)


def _modes(model: PsfModel, pupil: PupilImages, scale: float) -> tuple[Array, Array]:
    """Own departures (m, terms + 1) of unit variance that matter for images of 1e5 electrons, and the shares
    of their coefficients in it."""
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
    modes = (root @ directions[:, chosen]).T
    shares = modes**2 * np.diag(information)
    return modes, shares / shares.sum(axis=1, keepdims=True)
