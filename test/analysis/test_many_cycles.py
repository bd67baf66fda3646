"""Analysis of whole recordings of one and of two bodies, against the motion that was put in."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from mems6dof_ros.analysis.many_cycles import analyse_cycles
from mems6dof_ros.analysis.motion import separate_turning
from mems6dof_ros.analysis.recording import Recording
from mems6dof_ros.analysis.relative import relative_motion
from mems6dof_ros.analysis.report import compare_with_truth, describe, describe_relative
from mems6dof_ros.errors import InputError
from mems6dof_ros.pose.bodies import Bodies
from mems6dof_ros.pose.cycle_pose import Status
from mems6dof_ros.pose.estimator import PoseEstimator
from mems6dof_ros.pose.settings import PoseSettings, Region
from mems6dof_ros.pose.synthetic import GearMotion, Scene, SyntheticGear, merged

NO_FIELD_ERROR = PoseSettings(field_degree=0)


def record(gears: list[SyntheticGear], bodies: Bodies, cycles: int) -> Recording:
    poses = {gear.body: [] for gear in gears}
    localizations, truths = {}, {}
    for index in range(cycles):
        for gear in gears:
            if index:
                gear.advance()
        views = [gear.observe() for gear in gears]
        seen, _ = merged([view for view, _ in views], index)
        localizations[seen.stamp_ns] = seen
        for _, truth in views:
            truths[seen.stamp_ns, truth.body] = truth
        for pose in bodies.update(seen):
            poses[pose.body].append(pose)
    return Recording("synthetic", {}, poses, localizations, truths, cycles, 0)


@pytest.fixture(scope="module")
def gear():
    """Two and a quarter revolutions."""
    gears = [SyntheticGear(Scene().with_visible(60), 4)]
    return record(gears, Bodies([PoseEstimator(NO_FIELD_ERROR)]), 180)


def test_play_is_the_one_put_in(gear):
    """Its rms to 5 %: at most the part that turns by chance, 1 / sqrt(180) of the variance in each direction,
    is taken for an eccentricity; the range likewise."""
    found = analyse_cycles(gear, "load_gear")
    true = np.array([gear.truths[stamp, "load_gear"].translation[:2] for stamp in gear.localizations])
    assert found.missing == {}
    assert found.turns == pytest.approx(2.24, abs=0.05)
    assert found.centre.play_rms == pytest.approx(true.std(axis=0), rel=0.05)
    assert found.centre.play_range == pytest.approx(np.ptp(true, axis=0), rel=0.05)
    assert not found.centre.drift_found
    assert found.axis.turning_found
    assert found.axis.play_rms == pytest.approx([0.3e-3] * 2, rel=0.2)
    assert found.steps.mean == pytest.approx(math.radians(4.5), rel=0.005)
    assert found.repeatability.rms[0] == pytest.approx(110e-9, rel=0.2)
    comparison = compare_with_truth(gear, "load_gear")
    assert found.budget.total == pytest.approx(comparison.rms, rel=0.25)
    assert (found.budget.noise < found.budget.total).all()


def test_every_number_is_in_the_tables(gear):
    found = analyse_cycles(gear, "load_gear")
    rows = {row.name: row for row in found.quantities()}
    assert rows["centre: play range, x"].value == found.centre.play_range[0]
    assert 0 < rows["centre: play range, x"].sd < 20e-9
    assert all(math.isfinite(row.value) for row in rows.values())
    assert len(found.play_rows()) == 180
    assert len(found.spectrum_rows()) == len(found.spectrum.order)
    page = describe(gear, found, None)
    assert {"by_angle", "spectra", "budget", "paths"} <= {picture.name for picture in page.pictures}


def test_lost_cycles_are_no_steps_of_psi(gear):
    """A line through psi over the valid poses, not over the cycles, would be off by 78 mrad a lost cycle."""
    series = [
        replace(pose, status=Status.LOST) if 60 <= pose.cycle < 70 else pose
        for pose in gear.poses["load_gear"]
    ]
    holes = analyse_cycles(replace(gear, poses={"load_gear": series}), "load_gear")
    whole = analyse_cycles(gear, "load_gear")
    assert len(holes.cycle) == len(whole.cycle) - 10
    assert holes.repeatability.rms[5] == pytest.approx(whole.repeatability.rms[5], rel=0.3)
    assert holes.budget.motion[5] == pytest.approx(whole.budget.motion[5], rel=0.3)


def test_less_than_a_revolution_gives_reasons_instead_of_numbers(gear):
    few = replace(gear, poses={"load_gear": gear.poses["load_gear"][:20]})
    found = analyse_cycles(few, "load_gear")
    assert set(found.missing) == {"centre", "axis", "spectrum", "repeatability"}
    assert found.missing["centre"] == "one or more needed, found 0.24 revolutions"
    assert found.steps is not None
    page = describe(few, found, None)
    assert not {"by_angle", "spectra"} & {picture.name for picture in page.pictures}
    nothing = analyse_cycles(replace(gear, poses={"load_gear": []}), "load_gear")
    assert nothing.steps is nothing.budget is None


def test_uncertainty_of_what_turns_knows_that_play_remembers():
    """Play that keeps 0.6 of the cycle before: errors over 60 runs as claimed, to 20 % (2 sd of 120
    values: 13 %). White noise would claim half of it."""
    errors, claimed = [], []
    for seed in range(60):
        random = np.random.default_rng(seed)
        play = np.zeros((300, 2))
        for k in range(1, 300):
            play[k] = 0.6 * play[k - 1] + random.normal(0, 80e-9, 2)
        found = separate_turning(play, np.arange(300) * math.radians(4.5))
        errors.append(found.turning)
        claimed.append(found.sd_turning)
    ratio = np.sqrt(np.mean(np.square(errors))) / np.sqrt(np.mean(np.square(claimed)))
    assert 0.8 < ratio < 1.2


def test_two_bodies_turn_by_their_ratio():
    """Squared errors of the differences as claimed: 1, the mean of 360 values, of which the map's, up to half
    of the variance in the first cycles, are common to many."""
    scenes = [
        Scene(200, 60e-6, motion=GearMotion(step=step, step_sd=0.0, centre=(x, 0.0)))
        for step, x in ((math.radians(4.5), -65e-6), (math.radians(-1.8), 65e-6))
    ]
    names = ["load_gear", "ring_gear"]
    gears = [
        SyntheticGear(scene, seed, name)
        for seed, (scene, name) in enumerate(zip(scenes, names, strict=True), start=1)
    ]
    bodies = Bodies(
        [
            PoseEstimator(NO_FIELD_ERROR, name, Region(scene.motion.centre, 62e-6))
            for scene, name in zip(scenes, names, strict=True)
        ]
    )
    recording = record(gears, bodies, 60)
    motion = relative_motion(recording, "ring_gear", "load_gear")
    assert abs(motion.ratio + 0.4) < 4 * motion.sd_ratio
    assert motion.sd_ratio < 1e-5
    assert 0.7 < np.mean((motion.error / motion.sd) ** 2) < 1.4
    distance = [float(np.hypot(*pose.translation[:2])) for pose in motion.poses[30:]]
    assert np.mean(distance) == pytest.approx(130e-6, abs=1e-6)  # the centres are fitted to a part of a turn
    assert len(motion.rows()) == 60
    assert describe_relative(motion).name == "ring_gear_to_load_gear"
    with pytest.raises(InputError, match="3 or more"):
        relative_motion(
            replace(recording, poses={**recording.poses, "ring_gear": []}), "ring_gear", "load_gear"
        )
