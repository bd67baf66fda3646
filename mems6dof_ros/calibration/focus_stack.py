"""Focus stacks: frames at known stage positions to one curve of Gaussian fits per bead."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mems6dof_ros.calibration.field_curves import Array
from mems6dof_ros.calibration.moments import Moments, residual_moments
from mems6dof_ros.calibration.psf_fit import BeadWindows
from mems6dof_ros.errors import InputError
from mems6dof_ros.frame import Frame
from mems6dof_ros.localization.camera import CameraNoise
from mems6dof_ros.localization.detection import DetectionSettings, detect
from mems6dof_ros.localization.fitting import fit_gaussians
from mems6dof_ros.localization.localizations import Flag, GaussianFits

#: Called as progress(done, total) after every plane. Raising from it cancels; nothing has been written.
Progress = Callable[[int, int], None]

LEAST_PLANES = 8
#: Side of the fitted window: holds a particle up to 4 um out of focus.
DEFAULT_WINDOW_PX = 41
#: Beads nearer to each other than this part of the window disturb each other when out of focus.
_NEIGHBOUR = 0.75
#: A bead must be fitted in one run through focus, at least this part of the median bead's.
_LEAST_RUN = 0.6
#: Least amplitude in its standard deviations, and largest sigma in windows, of a usable fit.
_SIGNIFICANCE, _WIDEST = 8.0, 0.4
#: Brighter or dimmer than the median bead by this factor: a clump, or debris.
_BRIGHTNESS_FACTOR = 3.0
#: Planes in which beads are looked for, spread over the sharpest part of the stack.
_SEED_PLANES = 7


@dataclass(frozen=True)
class BeadStack:
    """One bead through focus: ``stage_z`` (n,) m in the order of the planes, its ``fits`` and ``moments``,
    and the ``windows`` of its pixels where they were kept."""

    stage_z: Array
    fits: GaussianFits
    moments: Moments
    windows: BeadWindows | None = None

    @property
    def in_focus(self) -> int:
        """Index of the plane with the least sigma_x sigma_y."""
        return int(np.argmin(self.fits.parameters[:, 3] * self.fits.parameters[:, 4]))

    @property
    def flux(self) -> float:
        """Electrons of the Gaussian in focus."""
        return float(self.fits.flux[self.in_focus])


@dataclass(frozen=True)
class Rejection:
    """A bead that was not used: where (px, of the image) and why. ``stack``: index of its stack."""

    x_px: float
    y_px: float
    reason: str
    stack: int = 0


@dataclass(frozen=True)
class FocusStack:
    """The beads of one stack and what they were measured with; ``stage_z`` (planes,) m.

    ``gallery`` (planes, window, window) ADU: the bead nearest to the centre, whose index is ``shown``.
    ``sha256`` identifies the pixels and stage positions; ``description`` says where they came from.
    """

    beads: tuple[BeadStack, ...]
    rejected: tuple[Rejection, ...]
    stage_z: Array
    pixel_size: float
    image_size: tuple[int, int]
    camera: CameraNoise
    weighting: str
    window_px: int
    gallery: NDArray[np.generic]
    shown: int
    description: str
    sha256: str


def measure_stack(
    frames: Iterable[Frame],
    camera: CameraNoise,
    weighting: str,
    window_px: int,
    description: str = "",
    progress: Progress = lambda done, total: None,
) -> FocusStack:
    """Fit every bead in every plane of a focus stack.

    All frames are held in memory (8.4 MB each at 2048 x 2048), since beads are looked for in the
    sharpest planes first. Raises InputError for planes without stage position or pixel size, of
    differing size, too few of them, or without a usable bead.
    """
    planes = list(frames)
    stage_z, pixel_size, image_size = _check_planes(planes, description or "focus stack")
    seeds = _find_beads(planes)
    fits = _track(planes, seeds, camera, weighting, window_px, progress)
    moments = [residual_moments(p.image, f, camera, window_px) for p, f in zip(planes, fits, strict=True)]
    beads, rejected = _select(planes, camera, fits, moments, seeds, stage_z, window_px)
    shown, gallery = _gallery(planes, beads, window_px)
    return FocusStack(
        beads,
        rejected,
        stage_z,
        pixel_size,
        image_size,
        camera,
        weighting,
        window_px,
        gallery,
        shown,
        description,
        _digest(planes, stage_z),
    )


def _check_planes(planes: Sequence[Frame], where: str) -> tuple[Array, float, tuple[int, int]]:
    stage_z = np.array([plane.stage_z for plane in planes])
    if len(np.unique(stage_z)) < LEAST_PLANES:
        raise InputError(
            where,
            f"{len(np.unique(stage_z))} stage positions",
            f"at least {LEAST_PLANES} planes through focus",
        )
    if not np.isfinite(stage_z).all():
        first = int(np.flatnonzero(~np.isfinite(stage_z))[0])
        raise InputError(
            where, f"plane {first} without a stage position", "stage_z of every plane, or a step"
        )
    shapes = {plane.image.shape for plane in planes}
    if len(shapes) > 1:
        raise InputError(where, f"images of sizes {sorted(shapes)}", "one size")
    pixel_size = planes[0].pixel_size
    if not pixel_size > 0:
        raise InputError(where, f"pixel size {pixel_size}", "the pixel size in object space, m")
    height, width = planes[0].image.shape
    return stage_z, pixel_size, (width, height)


def _gallery(
    planes: Sequence[Frame], beads: Sequence[BeadStack], window_px: int
) -> tuple[int, NDArray[np.generic]]:
    """Windows of the bead nearest to the image's centre, for the report; -1 without beads."""
    image = planes[0].image
    if not beads:
        return -1, np.empty((0, window_px, window_px), image.dtype)
    places = np.array([bead.fits.parameters[bead.in_focus, :2] for bead in beads])
    centre = (np.array(image.shape[::-1]) - 1) / 2
    shown = int(np.argmin(np.hypot(*(places - centre).T)))
    column, row = np.rint(places[shown]).astype(int) - window_px // 2
    column, row = max(column, 0), max(row, 0)
    window = np.s_[row : row + window_px, column : column + window_px]
    return shown, np.array([plane.image[window] for plane in planes])


def _digest(planes: Sequence[Frame], stage_z: Array) -> str:
    digest = hashlib.sha256(np.ascontiguousarray(stage_z).tobytes())
    for plane in planes:
        digest.update(np.ascontiguousarray(plane.image).tobytes())
    return digest.hexdigest()


def _find_beads(planes: Sequence[Frame]) -> Array:
    """Positions (n, 2) px of everything detected in a few planes about the sharpest one.

    Tilt and curvature put beads into focus at different planes, hence several of them.
    """
    sharpness = [float(np.var(np.diff(plane.image[::2].astype(np.float32), axis=1))) for plane in planes]
    bright = np.flatnonzero(np.array(sharpness) >= 0.5 * (max(sharpness) + min(sharpness)))
    chosen = np.unique(bright[np.linspace(0, len(bright) - 1, _SEED_PLANES).round().astype(int)])
    seeds = np.empty((0, 2))
    for index in [int(np.argmax(sharpness)), *chosen]:
        found = detect(planes[index].image)
        if len(seeds) and len(found):
            distance, _ = cKDTree(seeds).query(found)
            found = found[distance > DetectionSettings().separation_px]
        seeds = np.vstack([seeds, found])
    return seeds


def _track(
    planes: Sequence[Frame],
    seeds: Array,
    camera: CameraNoise,
    weighting: str,
    window_px: int,
    progress: Progress,
) -> list[GaussianFits]:
    """Fits of all seeds in every plane, from the sharpest plane outwards, so that a bead's last good
    position starts the next fit."""
    order = np.argsort([plane.stage_z for plane in planes], kind="stable")
    contrast = [float(np.var(planes[index].image[::4, ::4].astype(np.float32))) for index in order]
    start = int(np.argmax(contrast))
    fits: list[GaussianFits | None] = [None] * len(planes)
    done = 0
    middle = seeds
    for direction in (range(start, len(order)), range(start - 1, -1, -1)):
        positions = middle
        for index in (order[k] for k in direction):
            found = fit_gaussians(planes[index].image, positions, camera, weighting, window_px)
            fits[index] = found
            near = np.hypot(*(found.parameters[:, :2] - positions).T) < window_px / 4
            positions = np.where(near[:, None], found.parameters[:, :2], positions)
            if index == order[start]:
                middle = positions
            done += 1
            progress(done, len(planes))
    return [found for found in fits if found is not None]


def _select(
    planes: Sequence[Frame],
    camera: CameraNoise,
    fits: Sequence[GaussianFits],
    moments: Sequence[Moments],
    seeds: Array,
    stage_z: Array,
    window_px: int,
) -> tuple[tuple[BeadStack, ...], tuple[Rejection, ...]]:
    parameters = np.array([found.parameters for found in fits])
    flags = np.array([found.flags for found in fits])
    order = np.argsort(stage_z, kind="stable")
    good = (flags[order] & (Flag.FIT_FAILED | Flag.WINDOW_CUT)) == 0
    good &= np.array([_significant(found, window_px) for found in fits])[order]
    runs = [order[_run_through_focus(parameters[order, n], good[:, n])] for n in range(len(seeds))]
    least_run = max(LEAST_PLANES, _LEAST_RUN * float(np.median([len(run) for run in runs] or [0])))
    crowd = cKDTree(seeds).query(seeds, k=2)[0][:, 1] if len(seeds) > 1 else np.full(len(seeds), np.inf)
    beads, places, rejected = [], [], []
    for number, seed in enumerate(seeds):
        used = runs[number]
        if (flags[:, number] & Flag.WINDOW_CUT).any():
            reason = "its window leaves the image"
        elif crowd[number] < _NEIGHBOUR * window_px:
            reason = f"overlaps: another particle at {crowd[number]:.0f} px"
        elif len(used) < least_run:
            reason = f"unfittable: fitted in {len(used)} of {len(stage_z)} planes in a row"
        elif (flags[used, number] & Flag.SATURATED).any():
            reason = f"saturated in {np.count_nonzero(flags[used, number] & Flag.SATURATED)} planes"
        else:
            bead = _bead(
                [fits[k][[number]] for k in used], [moments[k][[number]] for k in used], stage_z[used]
            )
            bead = replace(bead, windows=_windows([planes[k] for k in used], camera, bead, window_px))
            if 1 < bead.in_focus < len(used) - 2:
                beads.append(bead)
                places.append(seed)
                continue
            reason = "its focus is not inside the stack"
        rejected.append(Rejection(float(seed[0]), float(seed[1]), reason))
    flux = np.array([bead.flux for bead in beads])
    keep = []
    for bead, place, ratio in zip(beads, places, flux / np.median(flux) if len(flux) else flux, strict=True):
        if 1 / _BRIGHTNESS_FACTOR < ratio < _BRIGHTNESS_FACTOR:
            keep.append(bead)
        else:
            rejected.append(
                Rejection(
                    float(place[0]),
                    float(place[1]),
                    f"{ratio:.2g} times the median brightness: a clump or debris",
                )
            )
    return tuple(keep), tuple(rejected)


def _significant(fits: GaussianFits, window_px: int) -> NDArray[np.bool_]:
    """Fits (n,) that stand out of the noise and are narrower than their window."""
    with np.errstate(invalid="ignore"):
        stands_out = fits.parameters[:, 2] > _SIGNIFICANCE * np.sqrt(fits.covariance[:, 2, 2])
        return stands_out & (fits.parameters[:, 3:5].max(axis=1) < _WIDEST * window_px)


def _run_through_focus(parameters: Array, good: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Indices of the unbroken run of ``good`` planes about the brightest image."""
    if not good.any():
        return np.empty(0, dtype=np.intp)
    focus = int(np.argmax(np.where(good, parameters[:, 2], -np.inf)))
    bad = np.flatnonzero(~good)
    first = bad[bad < focus].max(initial=-1) + 1
    last = bad[bad > focus].min(initial=len(good))
    return np.arange(first, last)


def _bead(fits: Sequence[GaussianFits], moments: Sequence[Moments], stage_z: Array) -> BeadStack:
    """One bead from its fits and moments, one of each per plane."""
    return BeadStack(
        stage_z,
        GaussianFits(
            *(np.concatenate([getattr(f, field.name) for f in fits]) for field in fields(GaussianFits))
        ),
        Moments(np.concatenate([m.values for m in moments]), np.concatenate([m.covariance for m in moments])),
    )


def _windows(planes: Sequence[Frame], camera: CameraNoise, bead: BeadStack, window_px: int) -> BeadWindows:
    """The same window of every plane, in electrons, about the bead in focus or as near as the edge allows."""
    height, width = planes[0].image.shape
    corner = np.rint(bead.fits.parameters[bead.in_focus, :2]).astype(int) - window_px // 2
    column, row = np.clip(corner, 0, [width - window_px, height - window_px])
    cut = np.s_[row : row + window_px, column : column + window_px]
    offset, gain, read_variance = (values[cut] if values.size > 1 else values for values in camera.maps)
    electrons = np.array([(plane.image[cut].astype(np.float64) - offset) / gain for plane in planes])
    return BeadWindows(
        (int(column), int(row)), bead.stage_z, electrons.astype(np.float32), float(np.mean(read_variance))
    )
