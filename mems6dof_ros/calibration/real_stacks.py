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


#: Of the astigmatic stack: aperture and wavelength as published, diameter as it appears (fitted, once).
ASTIGMATIC = CalibrationSettings(numerical_aperture=0.85, wavelength=520e-9, bead_diameter=350e-9)


def intrinsic_stack(folder: Path, window_px: int = 31) -> FocusStack:
    """One bead, NA 0.85, intrinsic aberrations, 300 nm steps; offset and gain by the same means."""
    source = open_source("images", path=folder / "bead_intrinsic_air085.tif", step=300e-9, pixel_size=130e-9)
    camera = CameraNoise(100.0, 1.0, 3.0, 65535)
    return measure_stack(frames(source), camera, DEFAULT_WEIGHTING, window_px, "intrinsic, real")


class _Scan(NamedTuple):
    """z against the stage as stated of every bead in every plane (b, p) m, NaN beyond reach; the claimed
    ``variance`` m^2; which have no flag."""

    z: Array
    variance: Array
    good: NDArray[np.bool_]


def one_bead_left_out(
    stack: FocusStack,
    planes: Sequence[Frame],
    reach: float,
    settings: CalibrationSettings,
    methods: Sequence[str],
    beads: Sequence[int] | None = None,
) -> dict[str, tuple[StageErrors, StageErrors]]:
    """Calibrate from all beads but one, measure that one within ``reach`` m of its focus, for every bead or
    those of the numbers in ``beads``.

    Per method the errors against the stage as stated, and against the stage as the other beads in the same
    image show it: the mean of theirs. The bead's own height is taken off.
    """
    found: dict[str, list[tuple[Array, ...]]] = {name: [] for name in methods}
    for index in range(len(stack.beads)) if beads is None else beads:
        others = replace(stack, beads=stack.beads[:index] + stack.beads[index + 1 :])
        calibration = calibrate([others], settings).calibration
        for name in methods:
            scan = _through_focus(calibration.with_method(name), stack, planes, reach)
            found[name].append(_against_others(scan, index))
    results = {}
    for name, parts in found.items():
        *columns, good = (np.concatenate(column) for column in zip(*parts, strict=True))
        use, flagged = good.astype(bool), 1 - float(np.mean(good))
        stated, stated_sd, apart, apart_sd = (column[use] for column in columns)
        results[name] = StageErrors(stated, stated_sd, flagged), StageErrors(apart, apart_sd, flagged)
    return results


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
    weight = np.where(scan.good, 1 / scan.variance, 0.0)[others]
    seen = np.isfinite(scan.z[index]) & (weight.sum(axis=0) > 0)
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
    calibration: Calibration, stack: FocusStack, planes: Sequence[Frame], reach: float
) -> _Scan:
    """All beads of ``stack`` within ``reach`` of their foci; z about the mean of each."""
    shape = len(stack.beads), len(planes)
    psf = calibration.psf if calibration.method == "psf" else None
    surface = (psf or calibration.model).focus_variance
    z, variance, good = np.full(shape, np.nan), np.full(shape, np.nan), np.zeros(shape, dtype=bool)
    for plane, frame in enumerate(planes):
        at = [
            (number, int(np.argmin(np.abs(bead.stage_z - frame.stage_z))))
            for number, bead in enumerate(stack.beads)
            if abs(frame.stage_z - bead.stage_z[bead.in_focus]) <= reach
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
        variance[beads, plane] = found.covariance[: len(at), 2, 2] - surface
        good[beads, plane] = found.flags[: len(at)] == 0
    count = np.maximum(good.sum(axis=1, keepdims=True), 1)
    return _Scan(z - np.sum(np.where(good, z, 0.0), axis=1, keepdims=True) / count, variance, good)


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
