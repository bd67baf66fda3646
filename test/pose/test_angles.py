"""Tilt, intrinsic rotation and the paper's angles: exact, regular at zero tilt, unbiased."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mems6dof_ros.pose.angles import (
    from_swing_twist,
    paper_angles,
    swing_twist,
    swing_twist_jacobian,
    unwrap_near,
)
from mems6dof_ros.pose.rigid import exp_so3


@pytest.mark.parametrize("psi", [0.0, 1.0, math.pi - 1e-9, -3.0])
@pytest.mark.parametrize("tilt", [(0.0, 0.0), (1e-9, 0.0), (1e-3, -2e-3), (0.3, 0.4)])
def test_swing_twist_round_trip(tilt, psi):
    found = swing_twist(from_swing_twist(*tilt, psi))
    assert np.allclose(found[:2], tilt, atol=1e-13)
    assert math.remainder(found[2] - psi, math.tau) == pytest.approx(0, abs=1e-13)


def test_swing_twist_is_the_papers_z_y_z():
    """alpha, beta of the axis; psi = alpha + gamma' of scipy's intrinsic ZYZ (science, section 5)."""
    alpha, beta, third = 0.7, 2e-3, -1.9
    rotation = Rotation.from_euler("ZYZ", [alpha, beta, third]).as_matrix()
    tilt_x, tilt_y, psi = swing_twist(rotation)
    assert (tilt_x, tilt_y) == pytest.approx((-beta * math.sin(alpha), beta * math.cos(alpha)), abs=1e-15)
    assert psi == pytest.approx(alpha + third, abs=1e-12)
    displacement = np.array([0, 0, 0, tilt_x, tilt_y, psi])
    angles = paper_angles(displacement, np.diag([1e-9] * 3 + [1e-5, 1e-5, 1e-6]) ** 2)
    assert angles.alpha == pytest.approx(alpha)
    assert angles.beta == pytest.approx(beta, rel=1e-4)
    assert angles.gamma == psi
    assert angles.alpha_valid
    assert angles.beta_valid


@pytest.mark.parametrize("tilt", [(0.0, 0.0), (1e-3, -2e-3), (0.3, 0.4)])
def test_jacobian_against_differences(tilt):
    rotation, step = from_swing_twist(*tilt, 0.8), 1e-6
    numeric = np.column_stack(
        [
            (np.array(swing_twist(exp_so3(step * e) @ rotation)) - swing_twist(exp_so3(-step * e) @ rotation))
            / (2 * step)
            for e in np.eye(3)
        ]
    )
    assert np.allclose(swing_twist_jacobian(*tilt), numeric, atol=1e-8)


def test_nothing_jumps_through_zero_tilt_and_full_turns():
    """The body's axis passes through the microscope's while psi passes 2 pi: all published numbers but
    alpha are continuous, alpha is marked, nothing is NaN."""
    covariance = np.diag([1e-9, 1e-9, 1e-8, 1e-4, 1e-4, 3e-6]) ** 2
    psi, rows, marks = 0.0, [], []
    for turn in np.linspace(-0.01, 4 * math.pi, 1501):
        tilt = 1e-3 * (turn - 2 * math.pi)
        *tilts, twist = swing_twist(from_swing_twist(tilt, 0.0, turn))
        psi = unwrap_near(twist, psi)
        angles = paper_angles(np.array([0, 0, 0, *tilts, psi]), covariance)
        rows.append([*tilts, psi, angles.beta, angles.gamma, angles.alpha, angles.sd_alpha])
        marks.append((abs(tilt) / 1e-4, angles.alpha_valid, angles.beta_valid))
    rows = np.array(rows)
    assert np.isfinite(rows).all()
    steps = np.abs(np.diff(rows[:, :5], axis=0)).max(axis=0)
    assert (steps < [2e-5, 1e-9, 1e-2, 2e-4, 1e-2]).all()
    for sigmas, alpha_valid, beta_valid in marks:
        assert alpha_valid == (sigmas >= 3)
        assert beta_valid == (sigmas >= math.sqrt(-2 * math.log(0.05)))


@pytest.mark.parametrize("snr", [4.0, 6.0, 10.0])
def test_beta_is_unbiased_where_it_is_detected(snr):
    """Monte Carlo, 40 000 draws: raw beta is biased by sd / (2 snr); the estimate by less than a fifth
    of that plus three standard errors."""
    random, sd = np.random.default_rng(1), 1e-4
    covariance = np.diag([1e-9, 1e-9, 1e-8, sd, sd, 3e-6]) ** 2
    draws = random.normal([snr * sd, 0], sd, (40_000, 2))
    beta = [paper_angles(np.array([0, 0, 0, *tilt, 0]), covariance).beta for tilt in draws]
    raw_bias = np.hypot(*draws.T).mean() - snr * sd
    assert raw_bias == pytest.approx(sd / (2 * snr), rel=0.2)
    assert abs(np.mean(beta) - snr * sd) < raw_bias / 5 + 3 * sd / 200
    assert np.std(beta) == pytest.approx(
        paper_angles(np.array([0, 0, 0, snr * sd, 0, 0]), covariance).sd_beta, rel=0.05
    )
