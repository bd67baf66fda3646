"""The gear: its particles, its drive, its play and tilt."""

from __future__ import annotations

import math

import numpy as np
import pytest

from mems6dof_ros.errors import InputError
from mems6dof_ros.simulation.microsystem import LoadGear
from mems6dof_ros.simulation.settings import SimulationSettings

STILL = {"drift_xy": 0.0, "drift_z": 0.0, "vibration_xy": 0.0, "vibration_z": 0.0}


def gear(**changes):
    return LoadGear(SimulationSettings.from_dict(changes))


def poses(body, cycles):
    found = []
    for _ in range(cycles):
        body.advance()
        found.append(body.pose(0.0))
    return found


def test_particles_lie_apart_on_the_ring_but_for_the_clumps():
    particles = gear(particles=300, clumps=10, seed=3).particles
    xy = particles.position[:, :2]
    radius = np.hypot(*xy.T)
    assert radius[:290].min() > 20e-6
    assert radius[:290].max() < 164e-6
    distance = np.hypot(*(xy[:, None] - xy[None]).transpose(2, 0, 1)) + np.eye(300)
    assert distance.min() > 1e-6
    assert np.all(distance[290:].min(axis=1) <= 2e-6)
    # Even over the area: half of the ring's area lies within this radius.
    middle = math.sqrt((164e-6**2 + 20e-6**2) / 2)
    assert (radius < middle).mean() == pytest.approx(0.5, abs=4 * 0.5 / math.sqrt(300))
    assert particles.position[:, 2].std() == pytest.approx(100e-9, rel=0.15)


def test_spreads_of_size_and_brightness():
    particles = gear(particles=1000, brightness_spread=0.25, diameter_spread=0.02).particles
    assert particles.electrons.mean() == pytest.approx(6e4, rel=4 * 0.25 / math.sqrt(1000))
    assert np.log(particles.electrons).std() == pytest.approx(0.25, rel=0.1)
    assert particles.diameter.mean() == pytest.approx(1e-6, rel=0.003)
    assert particles.diameter.std() == pytest.approx(0.02e-6, rel=0.1)


def test_too_many_particles_are_refused():
    with pytest.raises(InputError, match="no room"):
        gear(particles=200, clumps=0, gear_diameter=10e-6, hub_diameter=0.0)


def test_the_drive_steps_with_its_own_gain_and_jitter():
    body = gear(step_jitter=2e-3, step_error=0.02, seed=8)
    psi = np.array([0.0] + [p.psi for p in poses(body, 400)])
    steps = np.diff(psi)
    nominal = math.pi / 40
    assert body.cycle == 400
    assert np.std(steps, ddof=1) == pytest.approx(2e-3, rel=4 / math.sqrt(800))
    over = steps.mean() / nominal - 1
    assert 1e-3 < abs(over) < 0.08  # this seed's gear is not nominal
    exact = {"step_error": 0.02, "step_jitter": 0.0, "particles": 3}
    others = [poses(gear(seed=s, **exact), 1)[0].psi / nominal - 1 for s in range(200)]
    assert np.std(others) == pytest.approx(0.02, rel=0.2)
    assert abs(np.mean(others)) < 4 * 0.02 / math.sqrt(200)


def test_commands_stall_reverse_and_double():
    exact = {"step_error": 0.0, "step_jitter": 0.0, "backlash": 4e-3}
    body = gear(**exact)
    step = math.pi / 40
    body.advance(3)
    assert body.psi == pytest.approx(3 * step)
    body.advance(2, amplitude=0.3)  # friction holds
    assert body.psi == pytest.approx(3 * step)
    body.advance(1, direction=-1)  # takes up the backlash first
    assert body.psi == pytest.approx(2 * step + 4e-3)
    body.advance(1, direction=-1)
    assert body.psi == pytest.approx(step + 4e-3)
    body.advance(1, amplitude=0.65)  # half the range above friction, and the backlash again
    assert body.psi == pytest.approx(1.5 * step)
    assert body.cycle == 8
    skipping = gear(**exact, skip_probability=0.25, stall_probability=0.25)
    steps = np.rint(np.diff([0.0] + [p.psi for p in poses(skipping, 400)]) / step)
    assert set(steps) == {0, 1, 2}
    assert (steps == 0).mean() == pytest.approx(0.25, abs=0.09)
    assert (steps == 2).mean() == pytest.approx(0.25, abs=0.09)


@pytest.mark.parametrize(
    "command", [{"direction": 2}, {"cycles": -1}, {"amplitude": math.nan}, {"amplitude": -0.1}]
)
def test_senseless_commands_are_refused(command):
    with pytest.raises(InputError):
        gear().advance(**command)


def test_play_fills_the_clearance_and_never_leaves_it():
    settings = {"eccentricity": 0.0, "gear_x": 2e-6, "gear_y": -1e-6, **STILL}
    t = np.array([p.translation for p in poses(gear(**settings, play=390e-9, play_z=100e-9), 800)])
    centre = np.array([2e-6, -1e-6])
    assert np.hypot(*(t[:, :2] - centre).T).max() <= 195e-9 * (1 + 1e-9)
    assert np.abs(t[:, 2]).max() <= 50e-9 * (1 + 1e-9)
    # Close to the paper's 394 nm in x and 387 nm in y, once some hundred cycles have been seen.
    assert np.all(np.ptp(t[:, :2], axis=0) > 370e-9)
    rigid = np.array([p.translation for p in poses(gear(**settings, play=0.0, play_z=0.0), 20)])
    np.testing.assert_allclose(rigid, np.tile([2e-6, -1e-6, 0], (20, 1)), atol=1e-18)


def test_eccentricity_turns_with_the_body():
    body = gear(**STILL, play=0.0, play_z=0.0, eccentricity=300e-9, gear_x=0.0, gear_y=0.0)
    found = poses(body, 30)
    x, y, _ = np.array([p.translation for p in found]).T
    np.testing.assert_allclose(np.hypot(x, y), 300e-9)
    lag = np.exp(1j * np.array([p.psi for p in found])) / ((x + 1j * y) / 300e-9)
    np.testing.assert_allclose(lag, lag[0], atol=1e-9)


def test_rotation_is_a_swing_after_a_twist_by_psi():
    for pose in poses(gear(tilt_field=2e-3, tilt_body=1e-3, seed=4), 100):
        # Undo the twist; the rest must turn about an axis in the x-y plane: its matrix is symmetric there.
        c, s = math.cos(pose.psi), math.sin(pose.psi)
        swing = pose.rotation @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
        assert swing[0, 1] == pytest.approx(swing[1, 0], abs=1e-14)
        np.testing.assert_allclose(swing @ swing.T, np.eye(3), atol=1e-14)
        assert np.linalg.det(swing) == pytest.approx(1)
        assert math.acos(swing[2, 2]) < 2e-3 + 1e-3 + 0.5e-3


def test_tilt_parts_fixed_in_field_and_body():
    body = gear(tilt_field=1e-3, tilt_body=0.4e-3, tilt_play=0.0, step_error=0.0, step_jitter=0.0)
    axis = np.array([p.rotation[:2, 2] for p in poses(body, 80)])
    assert np.linalg.norm(axis.mean(axis=0)) == pytest.approx(1e-3, rel=1e-3)
    np.testing.assert_allclose(np.linalg.norm(axis - axis.mean(axis=0), axis=1), 0.4e-3, rtol=2e-3)


def test_drift_and_vibration_add_up():
    quiet = {"play": 0.0, "play_z": 0.0, "eccentricity": 0.0, "gear_x": 0.0, "gear_y": 0.0}
    body = gear(**quiet, drift_xy=3e-9, drift_z=4e-9, vibration_xy=0.0, vibration_z=0.0)
    moved = body.pose(100.0).translation - body.pose(0.0).translation
    assert np.hypot(*moved[:2]) == pytest.approx(300e-9)
    assert abs(moved[2]) == pytest.approx(400e-9)
    shaking = gear(**quiet, drift_xy=0.0, drift_z=0.0, vibration_xy=1e-9, vibration_z=3e-9)
    t = np.array([shaking.pose(0.0).translation for _ in range(1000)])
    np.testing.assert_allclose(t.std(axis=0), [1e-9, 1e-9, 3e-9], rtol=4 / math.sqrt(2000))


def test_bleaching_and_missing_particles():
    body = gear(bleaching=1e-3, particles=400)
    before = body.electrons()
    body.advance(500)
    ratio = body.electrons() / before
    assert np.all((ratio < 1) & (ratio > 0))
    assert ratio.mean() == pytest.approx(math.exp(-0.5), rel=0.08)
    assert ratio.std() > 0.02  # each at its own rate
    flickering = gear(missing=0.3, particles=400)
    dark = np.array([flickering.electrons() == 0 for _ in range(20)])
    assert dark.mean() == pytest.approx(0.3, abs=4 * math.sqrt(0.21 / 8000))
    assert not np.array_equal(dark[0], dark[1])
