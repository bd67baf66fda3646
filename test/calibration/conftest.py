"""Simulated optics that the calibration tests share: one stack to calibrate from, other beads to measure."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest

from mems6dof_ros.calibration.calibrate import CalibrationResult, calibrate
from mems6dof_ros.calibration.file import Calibration
from mems6dof_ros.calibration.focus_stack import measure_stack
from mems6dof_ros.calibration.interface import Positions
from mems6dof_ros.localization.fitting import fit_gaussians
from mems6dof_ros.simulation.experiment import BeadSubstrate, focus_stack
from mems6dof_ros.simulation.settings import SimulationSettings
from mems6dof_ros.sources.simulator import camera_noise

WEIGHTING, WINDOW_PX = "relative_light_weighting", 41
FIELD = SimulationSettings(width_px=640, height_px=640, clumps=0, optics="paper")


@dataclass(frozen=True)
class Held:
    """Held-out particles: true ``position`` (n, 3) m, and what a calibration made of them."""

    position: np.ndarray
    found: Positions

    @property
    def good(self) -> np.ndarray:
        return self.found.flags == 0

    @property
    def z_error(self) -> np.ndarray:
        """z errors (m) of unflagged particles; the origin and the substrate's tilt are conventions."""
        good = self.good
        design = np.column_stack([np.ones(good.sum()), self.position[good, :2]])
        error = (self.found.position - self.position)[good, 2]
        return error - design @ np.linalg.lstsq(design, error, rcond=None)[0]

    @property
    def z_sd(self) -> np.ndarray:
        return np.sqrt(self.found.covariance[self.good, 2, 2])


def make_calibration(optics_seed: int, electrons: float, optics: str = "paper") -> CalibrationResult:
    """Calibrate one set of optics from a stack of beads at ``electrons``."""
    settings = replace(FIELD, optics_seed=optics_seed, electrons=electrons, optics=optics, seed=optics_seed)
    frames = focus_stack(settings, -5.4e-6, 5.4e-6, 0.18e-6, beads=70, seed=10 + optics_seed)
    return calibrate([measure_stack(frames, camera_noise(settings), WEIGHTING, WINDOW_PX, "simulated")])


def measure(
    calibration: Calibration, optics_seed: int, electrons: float, reach: float, optics: str = "paper"
) -> Held:
    """Measure other beads of the same optics within ``reach`` m of focus, among them no near neighbours."""
    settings = replace(
        FIELD, optics_seed=optics_seed, electrons=electrons, optics=optics, seed=500 + optics_seed
    )
    positions, found = [], []
    for seed, stage_z in enumerate(np.linspace(-reach, reach, 9)):
        substrate = BeadSubstrate(settings, beads=60, seed=700 + seed)
        frame = substrate.frame(float(stage_z))
        truth = frame.truth[0].position
        centre = (np.array(settings.image_size) - 1) / 2
        px = truth[:, :2] / settings.pixel_size + centre
        margin = WINDOW_PX // 2
        inside = ((px > margin) & (px < np.array(settings.image_size) - 1 - margin)).all(axis=1)
        fits = fit_gaussians(frame.image, px[inside], calibration.camera, WEIGHTING, WINDOW_PX)
        positions.append(truth[inside])
        found.append(calibration.locate(fits, frame.image))
    return Held(
        np.concatenate(positions),
        Positions(*(np.concatenate([getattr(f, name) for f in found]) for name in _FIELDS)),
    )


_FIELDS = ("position", "covariance", "z_gap", "flags")


@pytest.fixture(scope="session")
def calibrated() -> CalibrationResult:
    """The paper's optics number 3, calibrated at 1e5 electrons."""
    return make_calibration(3, 1e5)


@pytest.fixture(scope="session")
def measured() -> Callable[..., Held]:
    return measure
