"""One estimate of the field error from what several bodies tell."""

from __future__ import annotations

import numpy as np
import pytest

from mems6dof_ros.calibration.field_modes import FieldModes
from mems6dof_ros.errors import InputError
from mems6dof_ros.pose.bodies import Bodies
from mems6dof_ros.pose.estimator import PoseEstimator, PoseSettings, Region
from mems6dof_ros.pose.field import FieldError
from mems6dof_ros.pose.synthetic import Scene, SyntheticGear
from mems6dof_ros.pose.validation import two_bodies

MODES = FieldModes((130e-6, 130e-6), 3)
PRIOR = np.diag(MODES.prior_variance(5e-9, 30e-9))


def evidence(seed: int, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Random linear measurements ``design @ c = value`` of unit noise in nm, as information and vector."""
    random = np.random.default_rng(seed)
    design = random.normal(size=(count, len(MODES))) * 1e9
    value = random.normal(size=count)
    return design, value, design.T @ design, design.T @ value


def test_what_bodies_tell_adds_up_to_one_least_squares_solution():
    one, other = evidence(1, 10), evidence(2, 30)
    field = FieldError(MODES, PRIOR)
    field.tell("one", *one[2:])
    field.tell("other", *evidence(3, 5)[2:])
    field.tell("other", *other[2:])  # replaces
    design = np.concatenate([one[0], other[0], np.diag(1 / np.sqrt(np.diag(PRIOR)))])
    value = np.concatenate([one[1], other[1], np.zeros(len(MODES))])
    expected = np.linalg.lstsq(design, value, rcond=None)[0]
    np.testing.assert_allclose(field.mean, expected, rtol=1e-6, atol=1e-16)
    np.testing.assert_allclose(field.covariance, np.linalg.inv(design.T @ design), rtol=1e-6, atol=1e-26)
    np.testing.assert_allclose(field.factor @ field.factor.T, field.covariance, rtol=1e-9, atol=1e-28)


def test_a_body_can_be_taken_back_and_nonsense_changes_nothing():
    field = FieldError(MODES, PRIOR)
    field.tell("one", *evidence(1, 10)[2:])
    before = field.mean.copy()
    with pytest.raises(np.linalg.LinAlgError):
        field.tell("other", -1e30 * np.eye(len(MODES)), np.zeros(len(MODES)))
    np.testing.assert_array_equal(field.mean, before)
    field.forget("one")
    np.testing.assert_allclose(field.covariance, PRIOR, rtol=1e-9, atol=1e-28)
    assert not field.mean.any()


@pytest.mark.parametrize("seed", [3])
def test_small_bodies_that_share_the_field_are_honest(seed):
    """15 particles each, a field error that nobody claims: NEES / 6 over 120 cycles of two bodies."""
    joint, _ = two_bodies(seed, 120, particles=15)
    assert 0.7 < np.mean([run.comparison().nees_per_dof for run in joint]) < 1.35
    assert not any(run.lost or run.wrong_identities for run in joint)


def test_bodies_share_one_field_and_forget_apart():
    regions = [Region((-60e-6, 0.0), 62e-6), Region((60e-6, 0.0), 62e-6)]
    bodies = Bodies([PoseEstimator(None, name, region) for name, region in zip("ab", regions, strict=True)])
    gear = SyntheticGear(Scene(field_error_xy=5e-9, particles=150), 1)
    for _ in range(8):
        bodies.update(gear.observe()[0])
        gear.advance()
    field = bodies.measured_field()
    first, second = (estimator.constellation for estimator in bodies.estimators)
    assert first.field is second.field is field
    both = np.trace(field.covariance)
    bodies.estimators[0].reset()
    assert both < np.trace(field.covariance) < np.trace(field.prior)
    bodies.reset()
    np.testing.assert_allclose(field.covariance, field.prior, rtol=1e-9, atol=1e-28)
    with pytest.raises(InputError, match="no cycle yet"):
        bodies.measured_field()


def test_the_field_is_set_for_all_bodies_or_none():
    estimators = [
        PoseEstimator(PoseSettings(field_degree=degree), name, Region((0.0, 0.0), 1e-4))
        for name, degree in (("a", 4), ("b", 0))
    ]
    with pytest.raises(InputError, match="field_degree"):
        Bodies(estimators)
