"""The scale of a stage from beads that it carried."""

from __future__ import annotations

import numpy as np
import pytest

from mems6dof_ros.calibration.stage_scale import BeadScan, stage_scale

STEP = 100e-9


def scans(stage_error: float, seed: int) -> list[BeadScan]:
    """Ten beads at heights of 60 nm rms, seen with 15 nm of noise of their own."""
    rng = np.random.default_rng(seed)
    stated = np.arange(-8, 9) * STEP
    wrong = stage_error * np.sin(2 * np.pi * stated / 700e-9)
    found = []
    for _ in range(10):
        height = 60e-9 * rng.standard_normal()
        error = wrong + 15e-9 * rng.standard_normal(len(stated))
        near = np.abs(stated - height) < 500e-9
        error -= error[near].mean()
        found.append(BeadScan(stated - error, error, np.full(len(stated), 2.25e-16), near))
    return found


def left_out(found: list[BeadScan]) -> float:
    remaining = [
        stage_scale(found[:k] + found[k + 1 :], STEP).remaining(scan) for k, scan in enumerate(found)
    ]
    return float(np.sqrt(np.mean(np.concatenate(remaining) ** 2)))


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_bead_left_out_is_read_on_the_scale_of_the_others(seed):
    """The stage is 50 nm off (35 rms), beads are seen to 15 nm, a scale learnt from nine adds some."""
    found = scans(50e-9, seed)
    stated = np.sqrt(np.mean(np.concatenate([scan.error[scan.judged] for scan in found]) ** 2))
    assert stated > 32e-9
    assert left_out(found) < 21e-9


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_good_stage_is_left_alone(seed):
    """Noise of beads does not pass for a scale."""
    assert left_out(scans(0.0, seed)) < 15.8e-9
