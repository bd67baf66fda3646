"""One pose from matched particles: efficient, honest, robust in xy and z apart."""

from __future__ import annotations

import numpy as np
import pytest

from mems6dof_ros.calibration.field_modes import FieldModes
from mems6dof_ros.pose.angles import from_swing_twist
from mems6dof_ros.pose.rigid import IDENTITY, RigidPose, log_so3
from mems6dof_ros.pose.solve import FULL, LATERAL, UNUSED, solve_pose

TRUE = RigidPose(from_swing_twist(8e-4, -5e-4, 0.0), np.array([2e-7, -1e-7, 3e-7]))
COVARIANCE = np.diag([2.3e-9, 2.3e-9, 50e-9]) ** 2


def draw(seed, n=60, wrong_z=0.0, wrong_xy=0.0, field=None, field_sd=0.0):
    random = np.random.default_rng(seed)
    body = np.c_[random.uniform(-130e-6, 130e-6, (n, 2)), random.normal(0, 5e-7, n)]
    covariance = np.tile(COVARIANCE, (n, 1, 1)) * random.uniform(0.5, 3, (n, 1, 1))
    noise = np.einsum("nij,nj->ni", np.sqrt(covariance), random.normal(size=(n, 3)))
    measured = TRUE.apply(body) + noise
    z, xy = random.random(n) < wrong_z, random.random(n) < wrong_xy
    measured[z, 2] += random.uniform(1e-6, 3e-6, z.sum())
    measured[xy, :2] += 200e-9
    response = np.zeros((n, 3, 0))
    if field is not None:
        response = field.evaluate(measured) * field_sd
        measured = measured + response @ random.normal(size=len(field))
    solution = solve_pose(
        IDENTITY,
        body,
        np.tile(1e-24 * np.eye(3), (n, 1, 1)),
        measured,
        covariance,
        np.ones(n, bool),
        response,
        response @ response.transpose(0, 2, 1),
        4.5,
        4.0,
    )
    return solution, z, xy


def error(solution):
    return np.r_[
        solution.pose.translation - TRUE.translation, log_so3(solution.pose.rotation @ TRUE.rotation.T)
    ]


def nees(solution):
    e = error(solution)
    return float(e @ np.linalg.solve(solution.covariance, e))


def test_nees_of_plain_noise():
    """300 draws, chi-square with 6 x 300 degrees of freedom: 1 +- 0.1 is 3 standard deviations."""
    values = [nees(draw(seed)[0]) / 6 for seed in range(300)]
    assert np.mean(values) == pytest.approx(1, abs=0.1)


def test_field_error_is_marginalised_not_averaged():
    """A smooth error common to neighbours: honest with its modes, dishonest by far without."""
    modes = FieldModes((130e-6, 130e-6), 3)
    with_modes = [nees(draw(seed, field=modes, field_sd=3e-9)[0]) / 6 for seed in range(200)]
    assert np.mean(with_modes) == pytest.approx(1, abs=0.12)


@pytest.mark.parametrize("seed", range(10))
def test_a_wrong_branch_costs_z_only(seed):
    solution, wrong_z, wrong_xy = draw(seed, wrong_z=0.25, wrong_xy=0.05)
    assert (solution.use[wrong_xy] == UNUSED).all()
    assert (solution.use[wrong_z & ~wrong_xy] == LATERAL).all()
    assert (solution.use[~wrong_z & ~wrong_xy] == FULL).mean() > 0.97
    assert nees(solution) < 25  # 6 degrees of freedom: one in 3000


def test_noise_is_the_whole_covariance_where_nothing_else_acts():
    solution, _, _ = draw(1)
    assert np.allclose(solution.noise, solution.covariance, rtol=1e-6, atol=1e-30)


def test_freedom_takes_the_pose_off():
    """Expected squared residuals add up to 2 n - 3 and n - 3 for a flat constellation."""
    solution, _, _ = draw(3)
    full = (solution.use == FULL).sum()
    assert solution.freedom.sum() == pytest.approx(3 * full - 6, abs=2.5)


def test_two_particles_fix_no_pose():
    body = np.array([[0.0, 0, 0], [1e-4, 0, 0]])
    covariance = np.tile(COVARIANCE, (2, 1, 1))
    solution = solve_pose(
        IDENTITY,
        body,
        covariance * 1e-6,
        body,
        covariance,
        np.ones(2, bool),
        np.zeros((2, 3, 0)),
        np.zeros((2, 3, 3)),
        4.5,
        4.0,
    )
    assert not solution.ok
