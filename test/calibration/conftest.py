"""Simulated optics that the calibration tests share: one stack to calibrate from, other beads to measure."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest

from mems6dof_ros.calibration.calibrate import CalibrationResult, CalibrationSettings, calibrate
from mems6dof_ros.calibration.file import Calibration
from mems6dof_ros.calibration.focus_stack import FocusStack, measure_stack
from mems6dof_ros.calibration.validation import Particles
from mems6dof_ros.localization.fitting import DEFAULT_WEIGHTING, fit_gaussians
from mems6dof_ros.simulation.experiment import BeadSubstrate, focus_stack
from mems6dof_ros.simulation.settings import SimulationSettings
from mems6dof_ros.sources.simulator import camera_noise

WINDOW_PX = 41
FIELD = SimulationSettings(width_px=512, height_px=512, clumps=0, optics="paper")
IMAGING = CalibrationSettings(
    numerical_aperture=FIELD.numerical_aperture, wavelength=FIELD.wavelength, bead_diameter=FIELD.diameter
)


@dataclass(frozen=True)
class Held:
    """Held-out particles: true ``position`` (n, 3) m, found z with its sd, and which have no flag."""

    position: np.ndarray
    z: np.ndarray
    sd: np.ndarray
    good: np.ndarray

    @property
    def z_error(self) -> np.ndarray:
        """z errors (m) of unflagged particles; the origin and the substrate's tilt are conventions."""
        plane = np.column_stack([np.ones(self.good.sum()), self.position[self.good, :2]])
        error = (self.z - self.position[:, 2])[self.good]
        return error - plane @ np.linalg.lstsq(plane, error, rcond=None)[0]

    @property
    def z_sd(self) -> np.ndarray:
        return self.sd[self.good]


def make_stack(optics_seed: int, electrons: float, **options: float) -> FocusStack:
    """A stack of about 30 beads through the optics number ``optics_seed``."""
    settings = replace(FIELD, optics_seed=optics_seed, electrons=electrons, seed=optics_seed)
    frames = focus_stack(settings, -5.6e-6, 5.6e-6, 0.28e-6, beads=56, seed=10 + optics_seed, **options)
    return measure_stack(frames, camera_noise(settings), DEFAULT_WEIGHTING, WINDOW_PX, "simulated")


@cache
def make_particles(optics_seed: int, electrons: float, reach: float) -> list[Particles]:
    """Other beads of the same optics within ``reach`` m of focus."""
    settings = replace(FIELD, optics_seed=optics_seed, electrons=electrons, seed=500 + optics_seed)
    size, found = np.array(settings.image_size), []
    for seed, stage_z in enumerate(np.linspace(-reach, reach, 8)):
        frame = BeadSubstrate(settings, beads=60, seed=700 + seed).frame(float(stage_z))
        truth = frame.truth[0]
        px = truth.position[:, :2] / settings.pixel_size + (size - 1) / 2
        inside = ((px > WINDOW_PX // 2) & (px < size - 1 - WINDOW_PX // 2)).all(axis=1)
        fits = fit_gaussians(frame.image, px[inside], camera_noise(settings), DEFAULT_WEIGHTING, WINDOW_PX)
        found.append(Particles(truth.position[inside], truth.electrons[inside], fits, frame.image))
    return found


def locate(calibration: Calibration, particles: Sequence[Particles]) -> Held:
    found = [calibration.locate(p.fits, p.image) for p in particles]
    return Held(
        np.concatenate([p.position for p in particles]),
        np.concatenate([f.position[:, 2] for f in found]),
        np.sqrt(np.concatenate([f.covariance[:, 2, 2] for f in found])),
        np.concatenate([f.flags == 0 for f in found]),
    )


@pytest.fixture(scope="session")
def stack() -> FocusStack:
    return make_stack(3, 1e5)


@pytest.fixture(scope="session")
def calibrated(stack: FocusStack) -> CalibrationResult:
    """The paper's optics number 3, calibrated at 1e5 electrons for all methods."""
    return calibrate([stack], IMAGING)


@pytest.fixture(scope="session")
def particles() -> Callable[[int, float, float], list[Particles]]:
    return make_particles


@pytest.fixture(scope="session")
def held() -> Callable[[Calibration, Sequence[Particles]], Held]:
    return locate
