"""Figures from real focus stacks (other people's micrographs, see their README): no truth but the stage."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mems6dof_ros.calibration.calibrate import CalibrationSettings, calibrate
from mems6dof_ros.calibration.field_curves import Array
from mems6dof_ros.calibration.focus_stack import BeadStack, FocusStack, measure_stack
from mems6dof_ros.calibration.model_fit import GROUPS, Orders
from mems6dof_ros.localization.camera import CameraNoise
from mems6dof_ros.localization.fitting import DEFAULT_WEIGHTING
from mems6dof_ros.sources.source import frames, open_source


@dataclass(frozen=True)
class StageErrors:
    """z against the stage with each bead's own height taken off, where not flagged: ``error`` and claimed
    ``sd`` (n,) m. ``flagged``: the fraction of planes left out for their flags."""

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


def astigmatic_stack(folder: Path, window_px: int = 31) -> FocusStack:
    """11 beads, NA 0.85, astigmatic lens, 100 nm steps. The camera's numbers are unknown; photon transfer
    between successive planes gives 0.115 ADU per electron and no offset."""
    source = open_source(
        "images", path=folder / "bead_stack_astigmatic_air085.tif", step=100e-9, pixel_size=63.5e-9
    )
    camera = CameraNoise(0.0, 0.115, 1.0, 255)
    return measure_stack(frames(source), camera, DEFAULT_WEIGHTING, window_px, "astigmatic, real")


def intrinsic_stack(folder: Path, window_px: int = 31) -> FocusStack:
    """One bead, NA 0.85, intrinsic aberrations, 300 nm steps; offset and gain by the same means."""
    source = open_source("images", path=folder / "bead_intrinsic_air085.tif", step=300e-9, pixel_size=130e-9)
    camera = CameraNoise(100.0, 1.0, 3.0, 65535)
    return measure_stack(frames(source), camera, DEFAULT_WEIGHTING, window_px, "intrinsic, real")


def one_bead_left_out(stack: FocusStack, reach: float, orders: Orders | None, method: str) -> StageErrors:
    """Calibrate from all beads but one, measure that one within ``reach`` m of its focus, for every bead."""
    error, sd, seen = [], [], 0
    for index, bead in enumerate(stack.beads):
        others = replace(stack, beads=stack.beads[:index] + stack.beads[index + 1 :])
        calibration = calibrate([others], CalibrationSettings(orders=orders)).calibration.with_method(method)
        found = calibration.locate(bead.fits)
        z = found.position[:, 2] + bead.stage_z
        near = np.abs(bead.stage_z - bead.stage_z[bead.in_focus]) <= reach
        seen += int(np.count_nonzero(near))
        near &= found.flags == 0
        error.append(z[near] - np.mean(z[near]) if near.any() else z[near])
        sd.append(np.sqrt(found.covariance[near, 2, 2]))
    errors = np.concatenate(error)
    return StageErrors(errors, np.concatenate(sd), 1 - len(errors) / seen)


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
