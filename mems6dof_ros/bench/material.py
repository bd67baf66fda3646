"""The frames and the calibration that the figures are measured with: simulated, made once per run."""

from __future__ import annotations

import dataclasses
import math
from functools import cached_property
from pathlib import Path
from typing import Any

from mems6dof_ros.calibration.calibrate import CalibrationSettings, calibrate
from mems6dof_ros.calibration.file import Calibration, load_calibration, save_calibration
from mems6dof_ros.calibration.focus_stack import DEFAULT_WINDOW_PX, measure_stack
from mems6dof_ros.frame import Frame
from mems6dof_ros.localization.fitting import DEFAULT_WEIGHTING
from mems6dof_ros.localization.localizer import Localizer
from mems6dof_ros.simulation.experiment import focus_stack, motion_frames
from mems6dof_ros.simulation.settings import SimulationSettings
from mems6dof_ros.sources.simulator import camera_noise

#: Cycles of a revolution; the drive makes no error, so that the frames can be repeated without a jump.
CYCLES = 40
#: On the gear, of which about 100 lie in the field.
PARTICLES = 130


@dataclasses.dataclass(frozen=True)
class Material:
    """``directory``: for files, the caller's to remove; ``quick``: less of everything; ``calibration_file``:
    one to use, of the simulator's default optics; None: made here."""

    directory: Path
    quick: bool = False
    calibration_file: Path | None = None
    size: int = 2048

    @cached_property
    def settings(self) -> SimulationSettings:
        """Of the frames."""
        return SimulationSettings(width_px=self.size, height_px=self.size, **self.simulation)

    @property
    def simulation(self) -> dict[str, Any]:
        """What differs from the simulator's defaults."""
        exact = {"step_error": 0.0, "step_jitter": 0.0}
        return {"particles": PARTICLES, "step": 2 * math.pi / CYCLES, **exact}

    @cached_property
    def frames(self) -> list[Frame]:
        """One revolution."""
        return list(motion_frames(self.settings, CYCLES))

    @cached_property
    def calibration_path(self) -> Path:
        """A calibration of these optics."""
        if self.calibration_file:
            return self.calibration_file
        settings = dataclasses.replace(self.settings, electrons=2e5)
        planes = focus_stack(settings, -4e-6, 4e-6, 0.5e-6 if self.quick else 0.25e-6, beads=150)
        stack = measure_stack(
            planes, camera_noise(settings), DEFAULT_WEIGHTING, DEFAULT_WINDOW_PX, "simulated focus stack"
        )
        path = self.directory / "optics.yaml"
        save_calibration(calibrate([stack], CalibrationSettings()).calibration, path)
        return path

    @cached_property
    def calibration(self) -> Calibration:
        return load_calibration(self.calibration_path, None)

    @property
    def localizer(self) -> Localizer:
        return Localizer(self.calibration.camera, self.calibration)
