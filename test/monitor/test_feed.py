"""What the page is told: history, alarms, events, truth, pictures."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import cv2
import numpy as np
import pytest

from mems6dof_ros.errors import InputError
from mems6dof_ros.frame import Frame, GroundTruth
from mems6dof_ros.monitor.alarms import QUANTITIES, Alarms, Limit
from mems6dof_ros.monitor.feed import MAX_BODIES, Feed
from mems6dof_ros.monitor.history import COLUMNS, History, pose_row
from mems6dof_ros.monitor.picture import encode, make_picture
from mems6dof_ros.monitor.synthetic import Machine
from mems6dof_ros.monitor.truth import TruthAlignment
from mems6dof_ros.pose.angles import from_swing_twist, swing_twist
from mems6dof_ros.pose.cycle_pose import Status
from mems6dof_ros.pose.rigid import RigidPose

COLUMN = {name: index for index, name in enumerate(COLUMNS)}


def row(**values: float) -> np.ndarray:
    made = np.full(len(COLUMNS), math.nan)
    for name, value in values.items():
        made[COLUMN[name]] = value
    return made


def test_row_holds_the_numbers_of_the_pose(machine):
    machine.cycle(0, image=False)
    _, _, pose = machine.cycle(1, image=False)
    pose = replace(pose, increment_cycles=3)
    made = pose_row(pose, body=2, truth=np.arange(6.0))
    assert len(made) == len(COLUMNS)
    assert made[COLUMN["body"]] == 2
    assert made[COLUMN["dy"]] == pose.displacement[1]
    assert made[COLUMN["sd_psi"]] == pytest.approx(math.sqrt(pose.displacement_covariance[5, 5]))
    assert made[COLUMN["rotation_per_cycle"]] == pytest.approx(pose.increment[5] / 3)
    assert made[COLUMN["sd_rotation_per_cycle"]] == pytest.approx(
        math.sqrt(pose.increment_covariance[5, 5]) / 3
    )
    assert made[COLUMN["latency_total"]] == pose.latency.total
    assert made[COLUMN["true_psi"]] == 5.0


def test_history_keeps_the_last_rows_and_skips_what_is_gone():
    history = History(10)
    for cycle in range(25):
        history.append(row(cycle=cycle))
    epoch, following, rows = history.since(0, 100)
    assert (epoch, following) == (0, 25)
    assert rows[:, COLUMN["cycle"]].tolist() == list(range(15, 25))
    assert history.since(20, 3)[2][:, COLUMN["cycle"]].tolist() == [20, 21, 22]
    assert len(history.since(25, 3)[2]) == 0
    history.clear()
    history.append(row(cycle=0))
    epoch, following, rows = history.since(following, 100)
    assert (epoch, following, len(rows)) == (1, 26, 1)


def test_alarm_begins_and_ends_once_and_counts_every_cycle_outside():
    alarms = Alarms()
    alarms.set(Limit("tilt_x", -1e-3, 1e-3))
    values = [0, 1e-3, 1.1e-3, math.nan, 0.5e-3, -2e-3, 0.4e-3, 0.2e-3, 0.1e-3, 0.3e-3]
    changes = [
        [value for _, value in alarms.judge(row(tilt_x=value, stamp=100 + 0.9 * number))]
        for number, value in enumerate(values)
    ]
    # Ended two seconds after the last value outside, the sixth.
    assert changes == [[], [], [1.1e-3], [], [], [], [], [], [0.1e-3], []]
    assert alarms.limits["tilt_x"].count == 2
    json.dumps(alarms.limits["tilt_x"].active)  # which no number of numpy is
    alarms.remove("tilt_x")
    assert alarms.judge(row(tilt_x=1.0)) == []


@pytest.mark.parametrize(("quantity", "low", "high"), [("cycle", 0, 1), ("dx", 1, 0), ("dx", math.nan, 1)])
def test_impossible_limits_are_refused(quantity, low, high):
    with pytest.raises(InputError):
        Limit(quantity, low, high)


def test_every_quantity_with_limits_is_a_column():
    assert set(QUANTITIES) <= set(COLUMNS)


def test_feed_tells_losses_status_alarms_and_a_new_run(machine):
    heard: list[str] = []
    feed = Feed(100, log=heard.append)
    poses = [machine.cycle(number, image=False)[2] for number in range(6)]
    feed.set_limit(Limit("psi", -1.0, 0.2))
    for pose in (poses[0], poses[1], poses[4]):
        feed.add_pose(pose)
    feed.add_pose(replace(poses[5], status=Status.LOST, reason="nothing in view"))
    state = feed.state()
    assert state["frames_missing"] == 2
    assert state["bodies"][0]["reason"] == "nothing in view"
    assert state["limits"][0]["active"]
    assert state["limits"][0]["count"] == 2
    assert len(heard) == 1
    assert "psi" in heard[0]
    texts = [event["text"] for event in feed.events(0)]
    assert any("lost in cycle 5: nothing in view" in text for text in texts)
    feed.add_pose(poses[0])
    assert len(feed.history.since(0, 100)[2]) == 1
    assert feed.history.epoch == 1
    json.dumps(feed.state(), allow_nan=False)


def test_feed_is_bounded_whatever_comes(machine):
    feed = Feed(50)
    pose = machine.cycle(0, image=False)[2]
    for number in range(100):
        feed.add_pose(replace(pose, body=f"body {number}", cycle=number))
        feed.tell("info", "again and again")
    assert len(feed.bodies) == MAX_BODIES
    assert len(feed.events(0)) <= 20


def test_truth_is_brought_to_the_measurement_s_origin_and_reference():
    """A body measured about another origin and reference than the simulator's must show its noise only."""
    rng = np.random.default_rng(0)
    noise = np.array([1e-9, 1e-9, 5e-9, 1e-4, 1e-4, 3e-6])
    machine = Machine(size=64)
    some_pose = machine.cycle(0, image=False)[2]
    # What the measurement calls its body is the simulator's, turned and shifted.
    own = RigidPose(from_swing_twist(0.01, -0.02, 0.4), np.array([3e-6, -2e-6, 1e-6]))
    alignment = TruthAlignment(reference_version=1)
    errors, reference = [], None
    for cycle in range(2000):
        psi = 0.08 * cycle
        true = RigidPose(from_swing_twist(*rng.normal(0, 5e-4, 2), psi), rng.normal(0, 2e-7, 3))
        body = own.then(true)
        reference = reference or body
        displacement = np.array(
            [*(body.translation - reference.translation), *swing_twist(body.rotation @ reference.rotation.T)]
        )
        displacement[5] += math.tau * round((psi - displacement[5]) / math.tau)
        measured = displacement + rng.normal(0, noise)
        pose = replace(
            some_pose,
            cycle=cycle,
            rotation=from_swing_twist(*measured[3:]),
            translation=reference.translation + measured[:3],
            displacement=measured,
        )
        truth = GroundTruth("gear", *true, psi, np.zeros(0, np.int32), np.zeros((0, 3)), np.zeros(0))
        found = alignment.add(pose, truth)
        assert (found is None) == (cycle < TruthAlignment.CYCLES)
        if found is not None:
            errors.append(found - displacement)
    # Noise of the mean of 40 cycles, in the body's frame, so that it turns with it: 5 standard deviations,
    # with the levers of 4 um for the noise of the angles.
    allowed = 5 / math.sqrt(TruthAlignment.CYCLES) * (noise + 4e-6 * np.array([0, 0, 1e-4, 0, 0, 0]))
    assert np.all(np.max(np.abs(errors), axis=0) < allowed * math.sqrt(2))


def test_picture_shows_what_belongs_together(machine):
    frame, found, pose = machine.cycle(0)
    picture = make_picture(frame, found, [pose], {"load_gear": 0})
    overlay = json.loads(json.dumps(picture.overlay, allow_nan=False))
    assert overlay["width"] == 256
    assert len(overlay["x_px"]) == len(found)
    assert overlay["bodies"][0]["particle_id"] == pose.particle_id.tolist()
    used = np.array(overlay["bodies"][0]["particle_id"]) >= 0
    assert [value is not None for value in overlay["bodies"][0]["residual_x"]] == used.tolist()
    assert overlay["bodies"][0]["residual_x"][int(np.flatnonzero(used)[0])] == pytest.approx(
        pose.residual[used][0, 0], abs=1e-12
    )
    image = cv2.imdecode(np.frombuffer(picture.jpeg, np.uint8), cv2.IMREAD_UNCHANGED)
    assert image.shape == (256, 256)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_picture_is_small_and_uses_the_greys_that_there_are(dtype):
    rng = np.random.default_rng(0)
    image = rng.integers(100, 120, (1500, 2048)).astype(dtype)
    image[600:700, 900:1000] = 200
    image[10, 10] = np.iinfo(dtype).max  # a hot pixel does not set the scale
    jpeg, (dark, bright) = encode(image)
    shown = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_UNCHANGED)
    assert shown.shape == (750, 1024)
    assert 100 <= dark <= 110
    assert 195 <= bright <= 205
    assert shown[325, 475] > 245
    assert shown[100, 100] < 40


def test_flat_picture_is_no_trouble():
    jpeg, _ = encode(np.full((32, 32), 7, np.uint16))
    assert jpeg[:2] == b"\xff\xd8"


def test_picture_without_image_or_pose():
    frame = Frame(np.zeros((8, 8), np.uint16), 1, 1, 1)
    assert "x_px" not in make_picture(frame, None, [], {}).overlay
    assert make_picture(None, None, [], {}).jpeg == b""
