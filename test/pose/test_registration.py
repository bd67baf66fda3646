"""Correspondence: annealed closest points, the global match, and their proof against chance."""

from __future__ import annotations

import math

import numpy as np
import pytest

from mems6dof_ros.pose.registration import (
    ConstellationIndex,
    PlaneMotion,
    closest_points,
    log10_false_alarms,
)

GATES = np.array([8, 4, 2, 1, 0.3, 0.05]) * 1e-6


def scene(seed, missing, spurious, angle, shift=(0.0, 0.0), particles=80):
    """Map points, what is seen of them after the motion (shuffled), and the truth per localization."""
    random = np.random.default_rng(seed)
    points = random.uniform(-130e-6, 130e-6, (particles, 2))
    moved = PlaneMotion(angle, np.array(shift)).apply(points) + random.normal(0, 3e-9, points.shape)
    kept = np.flatnonzero(random.random(particles) >= missing)
    ghosts = random.uniform(-130e-6, 130e-6, (round(spurious * particles), 2))
    identity = np.r_[kept, np.full(len(ghosts), -1)]
    order = random.permutation(len(identity))
    return points, np.r_[moved[kept], ghosts][order], identity[order]


@pytest.mark.parametrize("seed", range(5))
def test_closest_points_with_a_third_missing_and_a_third_spurious(seed):
    points, measured, identity = scene(seed, 0.3, 0.3, math.radians(1.5), (300e-9, -200e-9))
    motion, match = closest_points(points, measured, GATES, 0.3e-6)
    assert motion.angle == pytest.approx(math.radians(1.5), abs=2e-5)
    assert np.array_equal(match, identity)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("angle", [-2.0, 0.5, math.pi])
def test_global_match_finds_any_rotation(seed, angle):
    points, measured, _ = scene(seed, 0.3, 0.3, angle, (20e-6, -10e-6))
    found = ConstellationIndex(points).search(measured, 50e-9, 0.3e-6, 10)
    assert math.remainder(found.motion.angle - angle, math.tau) == pytest.approx(0, abs=1e-3)
    assert (
        np.abs(found.motion.apply(points) - PlaneMotion(angle, np.array([20e-6, -10e-6])).apply(points)).max()
        < 3e-7
    )
    assert log10_false_alarms(found.inliers, len(measured), 3e-4, found.tests) < -6


@pytest.mark.parametrize("seed", range(10))
def test_another_constellation_is_not_found(seed):
    """Nothing in common: the best of all hypotheses must look like chance."""
    points, _, _ = scene(seed, 0, 0, 0)
    _, measured, _ = scene(seed + 100, 0.1, 0.1, 0.3)
    found = ConstellationIndex(points).search(measured, 50e-9, 0.3e-6, 40)
    chance = 80 * math.pi * 0.3e-6**2 / 260e-6**2
    assert log10_false_alarms(found.inliers, len(measured), chance, found.tests) > -3


def test_false_alarms_are_those_of_random_points():
    """The predicted number of chance matches, against a count over random points (binomial, 5 sigma)."""
    random = np.random.default_rng(1)
    points, chance, draws = 30, 0.05, 200_000
    agreeing = 2 + random.binomial(points - 2, chance, draws)
    for inliers in (4, 5, 6):
        expected = 10 ** log10_false_alarms(inliers, points, chance, draws)
        assert (agreeing >= inliers).sum() == pytest.approx(expected, abs=5 * math.sqrt(expected))
    assert log10_false_alarms(2, points, chance, 1) == math.inf
    assert log10_false_alarms(200, 200, 1e-5, 1) < -900
