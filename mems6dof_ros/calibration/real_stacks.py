"""Figures from real focus stacks (other people's micrographs, see their README): no truth but the stage."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mems6dof_ros.calibration.calibrate import CalibrationSettings, calibrate
from mems6dof_ros.calibration.field_curves import Array
from mems6dof_ros.calibration.file import Calibration
from mems6dof_ros.calibration.focus_stack import BeadStack, FocusStack, measure_stack
from mems6dof_ros.calibration.model_fit import GROUPS, Orders
from mems6dof_ros.calibration.stage_scale import BeadScan, stage_scale
from mems6dof_ros.frame import Frame
from mems6dof_ros.localization.camera import CameraNoise
from mems6dof_ros.localization.fitting import DEFAULT_WEIGHTING
from mems6dof_ros.localization.localizations import GaussianFits
from mems6dof_ros.sources.source import frames, open_source


@dataclass(frozen=True)
class StageErrors:
    """z against the stage, where not flagged: ``error`` and its claimed ``sd`` (n,) m. ``flagged``: the
    fraction of planes left out for their flags."""

    error: Array
    sd: Array
    flagged: float

    @property
    def rms(self) -> float:
        return float(np.sqrt(np.mean(self.error**2)))

    @property
    def median(self) -> float:
        return float(np.median(np.abs(self.error)))

    @property
    def claimed_over_actual(self) -> float:
        return float(1 / np.sqrt(np.mean((self.error / self.sd) ** 2)))


def astigmatic_frames(folder: Path) -> list[Frame]:
    """80 planes of 100 nm, 11 beads, NA 0.85, astigmatic lens."""
    path = folder / "bead_stack_astigmatic_air085.tif"
    return list(frames(open_source("images", path=path, step=100e-9, pixel_size=63.5e-9)))


def astigmatic_stack(planes: Sequence[Frame], window_px: int = 25) -> FocusStack:
    """The beads of ``astigmatic_frames``. The camera's numbers are unknown; photon transfer between
    successive planes gives 0.115 ADU per electron and no offset. The background of 700 electrons per pixel
    is uneven: a larger window sees more of it."""
    camera = CameraNoise(0.0, 0.115, 1.0, 255)
    return measure_stack(planes, camera, DEFAULT_WEIGHTING, window_px, "astigmatic, real")


#: Planes beyond those judged from which the scale of the stage is learnt as well, m.
_MARGIN = 200e-9

#: Of the astigmatic stack: aperture and wavelength as published, diameter as it appears (fitted, once).
ASTIGMATIC = CalibrationSettings(numerical_aperture=0.85, wavelength=520e-9, bead_diameter=350e-9)


def intrinsic_stack(folder: Path, window_px: int = 31) -> FocusStack:
    """One bead, NA 0.85, intrinsic aberrations, 300 nm steps; offset and gain by the same means."""
    source = open_source("images", path=folder / "bead_intrinsic_air085.tif", step=300e-9, pixel_size=130e-9)
    camera = CameraNoise(100.0, 1.0, 3.0, 65535)
    return measure_stack(frames(source), camera, DEFAULT_WEIGHTING, window_px, "intrinsic, real")


class LeftOut(NamedTuple):
    """z of beads that were left out, against the stage ``as_stated``, ``as_others_see`` it in the same image,
    and against the stage as stated ``on_its_scale``, which the others show (errors alone, m)."""

    as_stated: StageErrors
    as_others_see: StageErrors
    on_its_scale: Array


class _Scan(NamedTuple):
    """z against the stage as stated of every bead in every plane (b, p) m, NaN where not measured; the
    claimed ``variance`` m^2; which have no flag; which are within reach of the bead's focus."""

    z: Array
    variance: Array
    good: NDArray[np.bool_]
    near: NDArray[np.bool_]


def one_bead_left_out(
    stack: FocusStack,
    planes: Sequence[Frame],
    reach: float,
    settings: CalibrationSettings,
    methods: Sequence[str],
    beads: Sequence[int] | None = None,
) -> dict[str, LeftOut]:
    """Calibrate from all beads but one, measure that one within ``reach`` m of its focus, for every bead or
    those of the numbers in ``beads``.

    Per method the errors against the stage as stated, against the stage as the other beads in the same image
    show it, the mean of theirs, and against the stage as stated on the smooth ``stage_scale`` that the other
    beads show. The bead's own height is taken off.
    """
    found: dict[str, list[tuple[Array, ...]]] = {name: [] for name in methods}
    scaled: dict[str, list[Array]] = {name: [] for name in methods}
    stage_z = np.array([frame.stage_z for frame in planes])
    for index in range(len(stack.beads)) if beads is None else beads:
        others = replace(stack, beads=stack.beads[:index] + stack.beads[index + 1 :])
        calibration = calibrate([others], settings).calibration
        for name in methods:
            scan = _through_focus(calibration.with_method(name), stack, planes, reach, _MARGIN)
            found[name].append(_against_others(scan, index))
            scans = _bead_scans(scan, stage_z)
            scale = stage_scale([*scans[:index], *scans[index + 1 :]], float(stage_z[1] - stage_z[0]))
            scaled[name].append(scale.remaining(scans[index]))
    results = {}
    for name, parts in found.items():
        *columns, good = (np.concatenate(column) for column in zip(*parts, strict=True))
        use, flagged = good.astype(bool), 1 - float(np.mean(good))
        stated, stated_sd, apart, apart_sd = (column[use] for column in columns)
        results[name] = LeftOut(
            StageErrors(stated, stated_sd, flagged),
            StageErrors(apart, apart_sd, flagged),
            np.concatenate(scaled[name]),
        )
    return results


def _bead_scans(scan: _Scan, stage_z: Array) -> list[BeadScan]:
    """What ``stage_scale`` wants to know of every bead of ``scan``."""
    found = []
    for z, variance, good, near in zip(*scan, strict=True):
        error, stated = z[good], stage_z[good]
        found.append(BeadScan(stated - error, error, variance[good], near[good]))
    return found


def stage_departures(
    stack: FocusStack,
    planes: Sequence[Frame],
    reach: float,
    settings: CalibrationSettings,
    methods: Sequence[str],
) -> dict[str, Array]:
    """What all beads within ``reach`` m of their foci say in common of where the stage stood in each plane
    (p,) m, against the position stated; NaN where none says anything."""
    calibration = calibrate([stack], settings).calibration
    found = {}
    for name in methods:
        scan = _through_focus(calibration.with_method(name), stack, planes, reach)
        weight = np.where(scan.good, 1 / scan.variance, 0.0)
        with np.errstate(invalid="ignore"):
            found[name] = np.sum(weight * np.nan_to_num(scan.z), axis=0) / weight.sum(axis=0)
    return found


def _against_others(scan: _Scan, index: int) -> tuple[Array, ...]:
    """Of the bead ``index``: error and sd against the stage as stated, error and sd against the other beads,
    and which have no flag. The others' own uncertainty is in the latter sd."""
    others = np.arange(len(scan.z)) != index
    weight = np.where(scan.good & scan.near, 1 / scan.variance, 0.0)[others]
    seen = scan.near[index] & (weight.sum(axis=0) > 0)
    weight, z, good = weight[:, seen], scan.z[index, seen], scan.good[index, seen]
    stage_variance = 1 / weight.sum(axis=0)
    stage = np.sum(weight * np.nan_to_num(scan.z[others][:, seen]), axis=0) * stage_variance
    variance = scan.variance[index, seen]
    # The bead's own height, the mean, takes a part of the error with it.
    count = max(int(np.count_nonzero(good)), 2)
    results = []
    for error, total in ((z, variance), (z - stage, variance + stage_variance)):
        height = np.mean(error[good]) if good.any() else 0.0
        results += [error - height, np.sqrt(total * (1 - 1 / count))]
    return (*results, good)


def _through_focus(
    calibration: Calibration, stack: FocusStack, planes: Sequence[Frame], reach: float, margin: float = 0.0
) -> _Scan:
    """All beads of ``stack`` within ``reach`` and ``margin`` of their foci; z about the mean in reach."""
    shape = len(stack.beads), len(planes)
    psf = calibration.psf if calibration.method == "psf" else None
    focus = (psf or calibration.model).focus
    z, variance = np.full(shape, np.nan), np.full(shape, np.nan)
    good, near = np.zeros(shape, dtype=bool), np.zeros(shape, dtype=bool)
    for plane, frame in enumerate(planes):
        at = [
            (number, int(np.argmin(np.abs(bead.stage_z - frame.stage_z))))
            for number, bead in enumerate(stack.beads)
            if abs(frame.stage_z - bead.stage_z[bead.in_focus]) <= reach + margin
            and np.abs(bead.stage_z - frame.stage_z).min() < 1e-9
        ]
        if not at:
            continue
        beads = [number for number, _ in at]
        fits = GaussianFits(
            *(
                np.array([getattr(stack.beads[number].fits, f.name)[k] for number, k in at])
                for f in fields(GaussianFits)
            )
        )
        found = calibration.locate(fits, frame.image)
        z[beads, plane] = found.position[: len(at), 2] + frame.stage_z
        # Own heights are taken off, and with them what the focus surface is uncertain by.
        surface = focus.variance(*found.position[: len(at), :2].T)
        variance[beads, plane] = found.covariance[: len(at), 2, 2] - surface
        good[beads, plane] = found.flags[: len(at)] == 0
        focus_z = np.array([stack.beads[b].stage_z[stack.beads[b].in_focus] for b in beads])
        near[beads, plane] = np.abs(frame.stage_z - focus_z) <= reach
    judged = good & near
    height = np.sum(np.where(judged, z, 0.0), axis=1) / np.maximum(judged.sum(axis=1), 1)
    return _Scan(z - height[:, None], variance, good, near)


def one_plane_left_out(stack: FocusStack, reach: float, orders: Orders) -> StageErrors:
    """Calibrate from all planes of the only bead but one, measure that plane, for every plane."""
    bead = stack.beads[0]
    error, sd, seen = [], [], 0
    for index in np.flatnonzero(np.abs(bead.stage_z - bead.stage_z[bead.in_focus]) <= reach):
        rest = np.arange(len(bead.stage_z)) != index
        others = replace(stack, beads=(_planes(bead, np.flatnonzero(rest)),))
        result = calibrate([others], CalibrationSettings(orders=orders))
        found = result.calibration.locate(_planes(bead, np.array([index])).fits)
        seen += 1
        if found.flags[0] == 0:
            error.append(found.position[0, 2] + bead.stage_z[index] - result.fit.sharpest[0])
            sd.append(np.sqrt(found.covariance[0, 2, 2]))
    return StageErrors(np.array(error), np.array(sd), 1 - len(error) / seen)


def plain_orders(field: int, degree: int) -> Orders:
    """The same orders for all features: for stacks of too few beads to choose by cross-validation."""
    return Orders(dict.fromkeys(GROUPS, field), dict.fromkeys(GROUPS, degree), min(field, 1))


def _planes(bead: BeadStack, chosen: NDArray[np.intp]) -> BeadStack:
    return BeadStack(bead.stage_z[chosen], bead.fits[chosen], bead.moments[chosen])
