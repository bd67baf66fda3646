"""The acceptance figures of field self-calibration: x and y of single particles against simulation truth.

A gear that turns once shows the field error; another gear, with other noise, is then localized by the
corrected calibration. One similarity per set of optics is taken off: where the microscope frame lies, how it
is turned and how long its metre is are definitions that neither beads nor a turning gear can tell. The
static distortion stays in the comparison: truth knows nothing of the optics.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mems6dof_ros.analysis.field_calibration import calibrate_field
from mems6dof_ros.calibration.file import Calibration
from mems6dof_ros.figures import Figure, at_most, between, information
from mems6dof_ros.localization.localizer import Localizer
from mems6dof_ros.pose.bodies import Bodies
from mems6dof_ros.pose.estimator import PoseEstimator
from mems6dof_ros.simulation.experiment import motion_frames
from mems6dof_ros.simulation.settings import SimulationSettings
from mems6dof_ros.sources.simulator import camera_noise

Array = NDArray[np.float64]

#: A little more than a revolution to learn from; others to measure.
LEARNT_CYCLES, HELD_CYCLES = 84, 24
#: Farther from a true place a localization is of something else, m.
_SAME = 0.3e-6


@dataclass(frozen=True)
class LateralErrors:
    """Errors ``error`` (n, 2) m in x and y of unflagged particles, a similarity taken off, with the variances
    (n, 2) m^2 that their covariances claim: ``noise``, and with what remains of the field error ``total``."""

    error: Array
    noise: Array
    total: Array


def lateral_errors(calibration: Calibration, settings: SimulationSettings, cycles: int) -> LateralErrors:
    """Localize ``cycles`` of the gear that ``settings`` describe, and compare with truth."""
    localizer = Localizer(camera_noise(settings), calibration)
    error, noise, place = [], [], []
    for frame in motion_frames(settings, cycles):
        found, truth = localizer.localize(frame), frame.truth[0].position
        good = np.flatnonzero(found.flags == 0)
        distance, nearest = cKDTree(truth[:, :2]).query(found.position[good, :2])
        good, nearest = good[distance < _SAME], nearest[distance < _SAME]
        error.append((found.position[good] - truth[nearest])[:, :2])
        noise.append(np.diagonal(found.covariance[good], axis1=1, axis2=2)[:, :2])
        place.append(truth[nearest])
    position, variance = np.concatenate(place), np.concatenate(noise)
    remaining = np.zeros_like(variance)
    if calibration.correction is not None:
        covariance = calibration.correction.remaining(position)
        remaining = np.diagonal(covariance, axis1=1, axis2=2)[:, :2]
    return LateralErrors(_without_similarity(np.concatenate(error), position), variance, variance + remaining)


def _without_similarity(error: Array, position: Array) -> Array:
    """``error`` (n, 2) less the shift, rotation and scale that explain most of it."""
    x, y = position[:, 0], position[:, 1]
    one, none = np.ones(len(x)), np.zeros(len(x))
    design = np.concatenate([np.column_stack([one, none, x, -y]), np.column_stack([none, one, y, x])])
    flat = error.T.ravel()
    return np.asarray((flat - design @ np.linalg.lstsq(design, flat, rcond=None)[0]).reshape(2, -1).T)


def learn_field(calibration: Calibration, settings: SimulationSettings, cycles: int) -> Calibration:
    """``calibration`` with the field error that ``cycles`` of the gear of ``settings`` show."""
    localizer = Localizer(camera_noise(settings), calibration)
    found = map(localizer.localize, motion_frames(settings, cycles))
    name = f"simulated gear, seed {settings.seed}"
    return calibrate_field(
        calibration, found, lambda s, field: Bodies([PoseEstimator(s, field=field)]), name, name
    ).calibration


def field_figures(
    seeds: Sequence[int],
    calibrated: Callable[[int], Calibration],
    optics: str = "paper",
    tell: Callable[[str], None] = lambda _: None,
) -> list[Figure]:
    """Rows for the table of the calibration; ``calibrated(seed)``: the ``optics`` number seed, from beads."""
    before, after = [], []
    for seed in seeds:
        gear: dict[str, Any] = {"optics": optics, "optics_seed": seed, "electrons": 6e4}
        tell(f"optics {seed}, a gear turning")
        beads = calibrated(seed)
        learnt = learn_field(beads, SimulationSettings(seed=seed, **gear), LEARNT_CYCLES)
        # Another gear, every particle of 6e4 electrons.
        held = SimulationSettings(seed=1000 + seed, brightness_spread=0.0, **gear)
        before.append(lateral_errors(beads, held, HELD_CYCLES))
        after.append(lateral_errors(learnt, held, HELD_CYCLES))
    raw, error = (np.concatenate([e.error for e in part]) for part in (before, after))
    noise, total = (np.concatenate([getattr(e, name) for e in after]) for name in ("noise", "total"))
    what = "x and y of a particle, 6e4 electrons, after field self-calibration"
    claimed = 1 / _rms(error / np.sqrt(total))
    return [
        information("x and y of a particle, 6e4 electrons, beads alone, nm rms per axis", _rms(raw) * 1e9),
        *(at_most(f"{what}: {axis}, nm rms", _rms(error[:, k]) * 1e9, 2.4) for k, axis in enumerate("xy")),
        information(f"{what}: noise claimed, nm", float(np.sqrt(noise.mean())) * 1e9),
        between(f"claimed over actual {what}", claimed, 0.9, 1.15),
    ]


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))
