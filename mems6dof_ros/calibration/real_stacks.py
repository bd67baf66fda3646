"""Figures from real focus stacks (other people's micrographs, see their README): no truth but the stage."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path

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
    """z against the stage with each bead's own height taken off, where not flagged: ``error`` and claimed
    ``sd`` (n,) m. ``flagged``: the fraction of planes left out for their flags. ``common`` (n,) m: what the
    other beads of the same image say of the stage, NaN where there are none."""

    error: Array
    sd: Array
    flagged: float
    common: Array

    @property
    def apart(self) -> StageErrors:
        """Errors apart from what is common to all beads of an image: errors of the stage, above all."""
        return replace(self, error=self.error - self.common)

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


def one_bead_left_out(
    stack: FocusStack,
    planes: Sequence[Frame],
    reach: float,
    settings: CalibrationSettings,
    methods: Sequence[str],
    beads: Sequence[int] | None = None,
) -> dict[str, StageErrors]:
    """Calibrate from all beads but one, measure that one within ``reach`` m of its focus, for every bead or
    those of the numbers in ``beads``.

    The others are measured as well: the median of their errors in an image is the stage's there.
    """
    found: dict[str, list[tuple[Array, Array, Array, NDArray[np.bool_]]]] = {name: [] for name in methods}
    for index in range(len(stack.beads)) if beads is None else beads:
        others = replace(stack, beads=stack.beads[:index] + stack.beads[index + 1 :])
        calibration = calibrate([others], settings).calibration
        for name in methods:
            z, sd, good = _through_focus(calibration.with_method(name), stack, planes, reach)
            rest = np.arange(len(z)) != index
            seen = np.isfinite(z[rest]).any(axis=0)
            common = np.full(z.shape[1], np.nan)
            common[seen] = np.nanmedian(z[rest][:, seen], axis=0)
            here = np.isfinite(z[index]) & np.isfinite(common)
            if (used := here & good[index]).any():  # the bead's own height against the others'
                common += np.mean((z[index] - common)[used])
            found[name].append((z[index, here], sd[index, here], common[here], good[index, here]))
    results = {}
    for name, parts in found.items():
        error, sd, common, good = (np.concatenate(column) for column in zip(*parts, strict=True))
        results[name] = StageErrors(error[good], sd[good], 1 - float(np.mean(good)), common[good])
    return results


def _through_focus(
    calibration: Calibration, stack: FocusStack, planes: Sequence[Frame], reach: float
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """z against the stage of every bead in every plane (b, p) m about the bead's mean, NaN beyond ``reach``;
    claimed sd; which have no flag."""
    shape = len(stack.beads), len(planes)
    psf = calibration.psf if calibration.method == "psf" else None
    surface = (psf or calibration.model).focus_variance
    z, sd, good = np.full(shape, np.nan), np.full(shape, np.nan), np.zeros(shape, dtype=bool)
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
        z[beads, plane] = found.position[:, 2] + frame.stage_z
        # Own heights are taken off, and with them what the focus surface is uncertain by.
        sd[beads, plane] = np.sqrt(found.covariance[:, 2, 2] - surface)
        good[beads, plane] = found.flags == 0
    count = np.maximum(good.sum(axis=1, keepdims=True), 1)
    return z - np.sum(np.where(good, z, 0.0), axis=1, keepdims=True) / count, sd, good


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
    return StageErrors(np.array(error), np.array(sd), 1 - len(error) / seen, np.full(len(error), np.nan))


def plain_orders(field: int, degree: int) -> Orders:
    """The same orders for all features: for stacks of too few beads to choose by cross-validation."""
    return Orders(dict.fromkeys(GROUPS, field), dict.fromkeys(GROUPS, degree), min(field, 1))


def _planes(bead: BeadStack, chosen: NDArray[np.intp]) -> BeadStack:
    return BeadStack(bead.stage_z[chosen], bead.fits[chosen], bead.moments[chosen])
