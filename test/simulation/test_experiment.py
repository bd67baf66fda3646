"""Whole frames: truth against image, clocks, seeds, stacks and loops."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mems6dof_ros.errors import InputError
from mems6dof_ros.simulation.experiment import (
    BeadSubstrate,
    Experiment,
    focus_stack,
    loop,
    motion_frames,
    revolution,
)
from mems6dof_ros.simulation.microsystem import LoadGear
from mems6dof_ros.simulation.settings import SimulationSettings

#: A gear of 60 um in a field of 65 um: everything in view, quickly rendered.
SMALL = {
    "width_px": 512,
    "height_px": 480,
    "gear_diameter": 50e-6,
    "hub_diameter": 8e-6,
    "particles": 12,
    "clumps": 0,
}


def small(**changes):
    return SimulationSettings.from_dict({**SMALL, **changes})


def weighted_centroid(image, x, y):
    """Centroid px under a round weight that moves along, from a start at (x, y) px."""
    rows, columns = np.indices(image.shape)
    for _ in range(30):
        weight = image * np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * 3**2))
        x, y = (columns * weight).sum() / weight.sum(), (rows * weight).sum() / weight.sum()
    return x, y


def test_truth_says_where_the_particles_are_in_the_image():
    settings = small(optics="ideal", electrons=1e6, background=1.0)
    for rotation in (0.0, 1.0):
        (frame,) = focus_stack(
            settings, 0, 0, 1e-6, beads=16, separation=9e-6, substrate_rotation=rotation, seed=5
        )
        image = (frame.image.astype(float) - 100) / 2 - 1
        place = frame.truth[0].position[:, :2] / frame.pixel_size + [(512 - 1) / 2, (480 - 1) / 2]
        within = place[((place > 25) & (place < [487, 455])).all(axis=1)]
        assert len(within) > 5
        for x, y in within:
            found = weighted_centroid(image, round(x), round(y))
            np.testing.assert_allclose(found, (x, y), atol=0.02)  # 2.5 nm: four sd at 1e6 electrons


def test_truth_is_the_rigid_transform_of_the_body():
    experiment = Experiment(small(seed=3))
    for _ in range(4):
        experiment.advance()
        truth = experiment.frame().truth[0]
        body = experiment.gear.particles.position[truth.particle_id]
        np.testing.assert_allclose(truth.position, body @ truth.rotation.T + truth.translation, atol=1e-15)
        swing = truth.rotation @ Rotation.from_rotvec([0, 0, truth.psi]).as_matrix().T
        assert Rotation.from_matrix(swing).as_rotvec()[2] == pytest.approx(0, abs=1e-12)


def test_electrons_of_the_truth_arrive_in_the_image():
    exact = {"background": 0.0, "read_noise": 0.0, "offset_spread_adu": 0.0}
    settings = small(optics="ideal", particles=1, seed=2, **exact)
    (frame,) = motion_frames(settings, 1)
    collected = (frame.image.astype(float) - 100).sum() / 2
    expected = frame.truth[0].electrons[0]
    assert 0.96 * expected < collected < 0.99 * expected


def test_full_field_shows_about_eighty_particles():
    """Geometry alone, over seeds: the frame's truth, without rendering 2048 px in a quick test."""
    visible = []
    for seed in range(10):
        gear = LoadGear(SimulationSettings(seed=seed))
        pixel = np.abs(gear.particles.position[:, :2] / 127.34e-9)
        visible.append((pixel < 1024).all(axis=1).sum())
    assert 76 < np.mean(visible) < 88


def test_the_same_seed_gives_the_same_frames_and_another_one_others():
    one, again, other = (list(motion_frames(small(seed=s), 3)) for s in (1, 1, 2))
    for a, b, c in zip(one, again, other, strict=True):
        np.testing.assert_array_equal(a.image, b.image)
        np.testing.assert_array_equal(a.truth[0].position, b.truth[0].position)
        np.testing.assert_array_equal(a.truth[0].electrons, b.truth[0].electrons)
        assert not np.array_equal(a.image, c.image)
    assert not np.array_equal(one[0].image, one[1].image)


def test_stamps_counters_and_circumstances():
    settings = small(epoch_ns=10**18, frame_rate=90.0, particles=2)
    experiment = Experiment(settings)
    first = experiment.frame()
    again = experiment.frame()
    experiment.advance(5)
    later = experiment.frame()
    assert [f.cycle for f in (first, again, later)] == [0, 0, 5]
    assert [f.frame_counter for f in (first, again, later)] == [0, 1, 2]
    period = 1e9 / 90
    assert [f.stamp_ns - 10**18 for f in (first, again, later)] == [0, round(period), round(6 * period)]
    assert (first.source, first.live, first.frame_id) == ("simulator", False, "microscope")
    assert first.pixel_size == 127.34e-9
    assert first.saturation_adu == 65535
    assert first.exposure_s == 2e-3
    assert first.stage_z == 0.0
    assert [f.cycle for f in motion_frames(small(particles=1, clumps=0), 3)] == [1, 2, 3]


def test_a_particle_that_is_dark_in_a_frame_stays_in_its_truth():
    frames = list(motion_frames(small(missing=0.5, particles=40), 2))
    for frame in frames:
        dark = frame.truth[0].electrons == 0
        assert 5 < dark.sum() < 35


def test_strays_stand_still_and_have_their_own_truth():
    one, two = motion_frames(small(stray_particles=5), 2)
    assert [t.body for t in one.truth] == ["load_gear", "strays"]
    np.testing.assert_array_equal(one.truth[1].position, two.truth[1].position)
    assert len(one.truth[1].particle_id) >= 2


def test_focus_stack_follows_the_convention_of_defocus():
    """z = height - stage_z, and the sharpest plane is where the stage reaches the bead."""
    settings = small(optics="ideal", electrons=3e5)
    frames = list(
        focus_stack(settings, -2e-6, 2e-6, 0.5e-6, beads=12, relief=400e-9, tilt=0.0, separation=12e-6)
    )
    np.testing.assert_allclose([f.stage_z for f in frames], np.arange(-2e-6, 2.1e-6, 0.5e-6), atol=1e-15)
    assert [f.cycle for f in frames] == [0] * 9
    heights = frames[4].truth[0].position[:, 2]
    ids = frames[4].truth[0].particle_id
    assert np.ptp(heights) > 0.5e-6
    for frame in frames:
        np.testing.assert_array_equal(frame.truth[0].particle_id, ids)
        np.testing.assert_allclose(frame.truth[0].position[:, 2], heights - frame.stage_z, atol=1e-15)
    place = np.rint(frames[4].truth[0].position[:, :2] / 127.34e-9 + [255.5, 239.5]).astype(int)
    inside = (np.abs(place - [255.5, 239.5]) < 200).all(axis=1)
    for (x, y), height in zip(place[inside], heights[inside], strict=True):
        peak = [f.image[y - 2 : y + 3, x - 2 : x + 3].astype(float).mean() for f in frames]
        k = int(np.argmax(peak))
        stage = [f.stage_z for f in frames[k - 2 : k + 3]]
        curve = np.polynomial.Polynomial.fit(stage, peak[k - 2 : k + 3], 4)
        roots = curve.deriv().roots()
        focus = roots[np.argmin(np.abs(roots - frames[k].stage_z))].real
        assert focus == pytest.approx(height, abs=60e-9)


def test_rotated_substrate_turns_beads_and_tilt():
    settings = small()
    straight = next(focus_stack(settings, 0, 0, 1e-6, beads=30, tilt=2e-3, relief=50e-9)).truth[0]
    turned = next(
        focus_stack(settings, 0, 0, 1e-6, beads=30, tilt=2e-3, relief=50e-9, substrate_rotation=math.pi / 2)
    ).truth[0]
    common = np.intersect1d(straight.particle_id, turned.particle_id)
    assert len(common) > 10
    a = straight.position[np.isin(straight.particle_id, common)]
    b = turned.position[np.isin(turned.particle_id, common)]
    np.testing.assert_allclose(b, a @ Rotation.from_rotvec([0, 0, math.pi / 2]).as_matrix().T, atol=1e-15)
    # Tilted about x: height rises along y; turned: it rises along -x.
    assert np.polyfit(a[:, 1], a[:, 2], 1)[0] == pytest.approx(2e-3, abs=1e-3)
    assert np.polyfit(b[:, 0], b[:, 2], 1)[0] == pytest.approx(-2e-3, abs=1e-3)


def test_stage_noise_is_in_the_truth_but_not_in_the_reading():
    substrate = BeadSubstrate(small(), beads=4, stage_noise=20e-9)
    frames = [substrate.frame(1e-6) for _ in range(30)]
    assert {f.stage_z for f in frames} == {1e-6}
    z = np.array([f.truth[0].translation[2] for f in frames])
    assert z.std() == pytest.approx(20e-9, rel=0.5)
    assert abs(z.mean() + 1e-6) < 4 * 20e-9 / math.sqrt(30)


def test_noise_of_stacks_and_experiment_is_independent():
    settings = small(electrons=0.0)
    images = [
        next(motion_frames(settings, 1)).image,
        next(focus_stack(settings, 0, 0, 1e-6, beads=1)).image,
        next(focus_stack(settings, 0, 0, 1e-6, beads=1, substrate_rotation=1.0)).image,
        next(focus_stack(settings, 0, 0, 1e-6, beads=1, seed=1)).image,
    ]
    centred = [(i - i.mean()).ravel() for i in images]
    correlation = np.corrcoef(centred)
    # Offset and gain pattern are the camera's and common: 0.5 ADU of about 7.
    assert np.abs(correlation - np.eye(4)).max() < 0.03


@pytest.mark.parametrize(
    ("start", "step"), [(-1e-6, 0.0), (-1e-6, -1e-7), (-1e-6, math.nan), (-math.inf, 1e-7), (math.nan, 1e-7)]
)
def test_a_step_that_never_arrives_is_refused(start, step):
    with pytest.raises(InputError, match="a step towards stop"):
        next(focus_stack(small(), start, 1e-6, step))


def test_loop_continues_stamps_cycles_and_psi():
    frames = revolution(small(step=math.pi / 4, epoch_ns=10**18, particles=3, step_error=0.1))
    assert len(frames) == 8
    assert frames[-1].truth[0].psi == pytest.approx(2 * math.pi)
    played = [frame for frame, _ in zip(loop(frames), range(20), strict=False)]
    assert [f.cycle for f in played] == list(range(1, 21))
    assert [f.frame_counter for f in played] == list(range(20))
    np.testing.assert_allclose(np.diff([f.stamp_ns for f in played]), 1e9 / 90, atol=1)
    np.testing.assert_allclose(np.diff([f.truth[0].psi for f in played]), math.pi / 4, atol=1e-12)
    assert played[8].image is frames[0].image
    np.testing.assert_array_equal(played[8].truth[0].rotation, frames[0].truth[0].rotation)


def test_loops_and_revolutions_without_sense_are_refused():
    with pytest.raises(InputError, match="no frames"):
        next(loop([]))
    with pytest.raises(InputError, match="fraction of 2 pi"):
        revolution(small(step=0.1))
    with pytest.raises(InputError, match="fraction of 2 pi"):
        revolution(dataclasses.replace(small(), step=0.0))


def test_a_covered_lens_shows_only_the_camera_and_the_view_comes_back():
    experiment = Experiment(small(offset_spread_adu=0.0))
    experiment.cover()
    experiment.advance()
    dark = experiment.frame()
    assert dark.image.mean() == pytest.approx(100, abs=0.05)  # the offset; the background would add 20
    assert dark.image.std() == pytest.approx(2 * 1.6, rel=0.05)  # read noise times gain
    assert len(dark.truth[0].particle_id) == 12
    assert not dark.truth[0].electrons.any()
    experiment.cover(False)
    experiment.advance()
    assert experiment.frame().image.max() > 1000


def test_a_shift_moves_image_and_truth_together():
    still = {"play": 0.0, "play_z": 0.0, "tilt_play": 0.0, "drift_xy": 0.0, "vibration_xy": 0.0}
    experiment = Experiment(small(optics="ideal", background=1.0, stray_particles=1, **still))
    before = experiment.frame()
    experiment.shift(40 * before.pixel_size, -25 * before.pixel_size)
    after = experiment.frame()
    for body in (0, 1):
        moved = after.truth[body].translation - before.truth[body].translation
        np.testing.assert_allclose(moved[:2] / before.pixel_size, (40, -25), atol=1e-6)
    overlap = before.image[25:, :-40].astype(float), after.image[:-25, 40:].astype(float)
    assert np.corrcoef(overlap[0].ravel(), overlap[1].ravel())[0, 1] > 0.9
    experiment.shift(0, 0)
    np.testing.assert_allclose(
        experiment.frame().truth[0].translation[:2], before.truth[0].translation[:2], atol=1e-12
    )


def test_another_constellation_on_the_same_gear_and_back():
    experiment, other = Experiment(small(seed=4)), Experiment(small(seed=5))
    own = experiment.gear.particles.position
    experiment.exchange_particles(5)
    np.testing.assert_array_equal(experiment.gear.particles.position, other.gear.particles.position)
    experiment.advance()
    assert experiment.frame().truth[0].psi == experiment.gear.psi != other.gear.psi
    experiment.exchange_particles(4)
    np.testing.assert_array_equal(experiment.gear.particles.position, own)


def test_the_ring_gear_is_a_second_body_that_turns_against_the_load_gear():
    ring = {"ring_particles": 60, "ring_diameter": 125e-6, "ring_width": 40e-6, "ring_direction": 0.5}
    settings = small(gear_x=-20e-6, gear_y=-15e-6, backlash=0.05, vibration_xy=0.0, **ring)
    experiment = Experiment(settings)
    start = experiment.frame()
    assert [truth.body for truth in start.truth] == ["load_gear", "ring_gear"]
    assert len(start.truth[1].particle_id) > 5
    experiment.advance(3)
    forward = experiment.frame()
    gear, wheel = forward.truth
    assert wheel.psi == pytest.approx(-80 / 200 * gear.psi, abs=1e-12)
    body = experiment.ring.particles.position[wheel.particle_id]
    np.testing.assert_allclose(wheel.position, body @ wheel.rotation.T + wheel.translation, atol=1e-15)
    # Each within its own half of the clearance, about axes half of both diameters apart.
    apart = np.hypot(*(wheel.translation - gear.translation)[:2])
    assert apart == pytest.approx((125e-6 + 50e-6) / 2, abs=390e-9 + 2 * 200e-9)
    # The drive turns the ring at once; the load gear follows when the backlash has been taken up.
    experiment.advance(1, direction=-1)
    gear_turned, ring_turned = (
        after.psi - before.psi for after, before in zip(experiment.frame().truth, forward.truth, strict=True)
    )
    assert -ring_turned / 0.4 - gear_turned == pytest.approx(-0.05, abs=1e-12)


def test_a_ring_gear_changes_nothing_of_the_load_gear():
    alone, accompanied = Experiment(small()), Experiment(small(ring_particles=5))
    for experiment in (alone, accompanied):
        experiment.advance(2)
    np.testing.assert_array_equal(alone.frame().truth[0].position, accompanied.frame().truth[0].position)
