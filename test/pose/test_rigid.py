"""Rigid-body algebra against scipy and against finite differences."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mems6dof_ros.pose.rigid import (
    RigidPose,
    exp_so3,
    kabsch,
    left_jacobian,
    log_so3,
    quaternion,
    rotation_z,
    shift_origin,
)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-5, 1e-3, 1.0, 3.0, math.pi - 1e-8, math.pi])
def test_exponential_and_logarithm_agree_with_scipy(angle):
    axis = np.array([0.6, -0.48, 0.64])
    rotation = exp_so3(angle * axis)
    assert np.allclose(rotation, Rotation.from_rotvec(angle * axis).as_matrix(), atol=1e-14)
    # At a half turn the axis has no sign.
    assert np.allclose(exp_so3(log_so3(rotation)), rotation, atol=1e-7)
    assert np.linalg.norm(log_so3(rotation)) == pytest.approx(angle, abs=1e-7)


def test_the_quaternion_is_that_of_scipy():
    """Of turns about every axis, also by half a turn, where three of its components may vanish."""
    rotations = [*Rotation.random(100, rng=1), *(Rotation.from_rotvec(math.pi * e) for e in np.eye(3))]
    rotations += [
        Rotation.identity(),
        Rotation.from_rotvec([0, 0, 1e-9]),
        Rotation.from_rotvec([0, 2.1, 2.1]),
    ]
    for rotation in rotations:
        found = quaternion(rotation.as_matrix())
        assert found[3] >= 0
        expected = rotation.as_quat(canonical=True)
        sign = 1.0 if found @ expected > 0 else -1.0  # of half a turn either is right
        assert np.allclose(sign * found, expected, atol=1e-15)
    assert np.isnan(quaternion(np.full((3, 3), np.nan))).all()


@pytest.mark.parametrize("length", [0.0, 1e-5, 0.3, 2.0])
def test_left_jacobian_is_the_derivative_of_the_exponential(length):
    w, step = length * np.array([0.6, -0.48, 0.64]), 1e-6
    numeric = np.column_stack(
        [log_so3(exp_so3(w + step * e) @ exp_so3(w - step * e).T) / (2 * step) for e in np.eye(3)]
    )
    assert np.allclose(left_jacobian(w), numeric, atol=1e-8)


def test_poses_compose_and_invert():
    random = np.random.default_rng(1)
    one, other = (
        RigidPose(Rotation.random(random_state=seed).as_matrix(), random.normal(size=3)) for seed in (1, 2)
    )
    points = random.normal(size=(5, 3))
    assert np.allclose(one.then(other).apply(points), other.apply(one.apply(points)))
    assert np.allclose(one.inverse().apply(one.apply(points)), points)


def test_kabsch_finds_the_pose_even_of_flat_and_mirrored_looking_points():
    random = np.random.default_rng(2)
    true = RigidPose(Rotation.from_rotvec([0.1, -0.2, 2.5]).as_matrix(), np.array([1.0, 2.0, 3.0]))
    flat = np.c_[random.normal(size=(20, 2)), np.zeros(20)]
    found = kabsch(flat, true.apply(flat))
    assert np.allclose(found.rotation, true.rotation)
    assert np.linalg.det(found.rotation) == pytest.approx(1)
    weights = np.ones(20)
    measured = true.apply(flat)
    measured[0] += 100.0
    weights[0] = 0.0
    assert np.allclose(kabsch(flat, measured, weights).translation, true.translation)


def test_covariance_moves_with_the_origin_as_samples_do():
    """Monte Carlo: the covariance of the moved origin is that of moved samples (3 % of 20 000 draws)."""
    random = np.random.default_rng(3)
    root = random.normal(size=(6, 6)) * [1, 1, 1, 1e-3, 1e-3, 1e-3]
    lever = np.array([300.0, -200.0, 50.0])
    draws = random.normal(size=(20_000, 6)) @ root
    moved = np.array([np.r_[d[:3] + exp_so3(d[3:]) @ lever - lever, d[3:]] for d in draws])
    expected, sampled = shift_origin(root.T @ root, lever), np.cov(moved.T)
    scale = np.sqrt(np.diag(expected))
    assert np.abs((sampled - expected) / np.outer(scale, scale)).max() < 0.03


def test_rotation_z_turns_x_to_y():
    assert np.allclose(rotation_z(math.pi / 2) @ [1, 0, 0], [0, 1, 0])
