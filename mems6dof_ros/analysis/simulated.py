"""Calibration of simulated optics, from simulated focus stacks alone: what demonstrations and validations
of everything behind it begin with."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

from mems6dof_ros.calibration.calibrate import CalibrationResult, CalibrationSettings, calibrate
from mems6dof_ros.calibration.focus_stack import DEFAULT_WINDOW_PX, measure_stack
from mems6dof_ros.localization.fitting import DEFAULT_WEIGHTING
from mems6dof_ros.simulation.experiment import focus_stack
from mems6dof_ros.simulation.settings import SimulationSettings
from mems6dof_ros.sources.simulator import camera_noise

#: Two orientations of the bead substrate tell its tilt from the curvature of the field.
ROTATIONS = (0.0, math.pi)
#: Scanned beyond what is calibrated, so that particles out of range are known for what they are, m.
SCAN, RANGE, STEP = 6e-6, 4e-6, 0.25e-6


def calibrate_simulated(
    settings: SimulationSettings,
    progress: Callable[[int, int], None] = lambda done, total: None,
    beads: int = 200,
    psf: bool = False,
) -> CalibrationResult:
    """Calibrate the optics and camera of ``settings``, with so many ``beads`` in view, with ``psf`` also what
    method psf needs. ``progress(done, total)`` counts planes; what it raises ends the work."""
    planes = round(2 * SCAN / STEP) + 1
    stacks = []
    for index, rotation in enumerate(ROTATIONS):

        def counted(done: int, _: int, before: int = index * planes) -> None:
            progress(before + done, len(ROTATIONS) * planes)

        stacks.append(
            measure_stack(
                focus_stack(settings, -SCAN, SCAN, STEP, beads=beads, substrate_rotation=rotation),
                camera_noise(settings),
                DEFAULT_WEIGHTING,
                DEFAULT_WINDOW_PX,
                f"simulated focus stack, substrate at {math.degrees(rotation):.0f} degrees",
                counted,
            )
        )
    wanted = CalibrationSettings(axial_range=RANGE, rotations=ROTATIONS)
    if psf:
        wanted = replace(
            wanted,
            numerical_aperture=settings.numerical_aperture,
            wavelength=settings.wavelength,
            bead_diameter=settings.diameter,
        )
    return calibrate(stacks, wanted)
