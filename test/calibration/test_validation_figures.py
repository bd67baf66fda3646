"""What the table of `mems6dof validate calibration` must not overlook."""

from __future__ import annotations

import numpy as np
import pytest

from mems6dof_ros.calibration.validation import Errors, brightness_bias

TRUE_Z = np.random.default_rng(1).uniform(-1.5e-6, 1.5e-6, 600)


def measured(shift: np.ndarray | float, seed: int, flagged: int = 0) -> Errors:
    """z 10 nm about the truth, shifted; the first ``flagged`` particles have a flag."""
    z = TRUE_Z + shift + 10e-9 * np.random.default_rng(seed).standard_normal(len(TRUE_Z))
    z[:flagged] = np.nan
    good = np.isfinite(z)
    position = np.zeros((good.sum(), 3))
    error = np.column_stack([position[:, :2], (z - TRUE_Z)[good]])
    return Errors(error, np.full_like(error, 10e-9), position, z)


def verdicts(shift: np.ndarray | float) -> list[bool | None]:
    """Of two sets of optics, of which brightness shifts the second alone."""
    there = [measured(0.0, 1), measured(shift, 2, flagged=20)]
    here = [measured(0.0, 3, flagged=30), measured(0.0, 4)]
    return [row["passed"] for row in brightness_bias("method", there, here, [TRUE_Z, TRUE_Z])]


def test_a_shift_of_all_particles_of_one_set_of_optics_fails() -> None:
    # The mean of 600 differences of 14 nm is known to 0.6 nm.
    assert verdicts(0.0) == [True, True]
    assert verdicts(7e-9) == [False, True]


def test_a_bias_that_changes_sign_through_focus_fails() -> None:
    assert verdicts(40e-9 * np.sign(TRUE_Z)) == [True, False]


def test_flagged_particles_are_not_judged_but_counted() -> None:
    found = measured(0.0, 5, flagged=60)
    assert found.kept == pytest.approx(0.9)
    assert found.used.sum() == len(found.error) == 540
