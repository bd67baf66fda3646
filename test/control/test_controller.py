"""The controller's decisions, one by one, and whole motions on synthetic poses."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from mems6dof_ros.control.commands import LOOK, STOP, Acknowledgement, Motion, Outcome
from mems6dof_ros.control.controller import Controller, ControllerSettings, State
from mems6dof_ros.control.validation import (
    DRIVES,
    FAULTS,
    SyntheticLoop,
    cycles_after,
    figures,
    open_loop,
    synthetic_pose,
)
from mems6dof_ros.errors import InputError
from mems6dof_ros.pose.cycle_pose import Status
from mems6dof_ros.simulation.settings import SimulationSettings

FORWARD = Motion(1, 1.0, 1)
NOW = 1e6


class Forward:
    """A law that goes on until psi reaches the target; remembers what it was asked."""

    def __init__(self):
        self.asked = []

    def next_motion(self, target, pose, made):
        self.asked.append((target, pose.cycle, made))
        return FORWARD if pose.displacement[5] < target else None


def pose(cycle, psi=0.0, at=NOW, **changes):
    displacement = np.array([0, 0, 0, 0, 0, psi])
    return replace(synthetic_pose(displacement, np.eye(6) * 1e-12, cycle, round(at * 1e9)), **changes)


def done(number, cycle, **changes):
    received_ns = changes.pop("received_ns", round((NOW + 1e5) * 1e9))  # after whatever was sent
    return replace(Acknowledgement(number, Outcome.DONE, "", 1, cycle, received_ns), **changes)


@pytest.fixture
def law():
    return Forward()


@pytest.fixture
def controller(law):
    return Controller(ControllerSettings(), law)


def test_it_looks_before_it_moves_and_acts_on_pose_and_acknowledgement_only(controller, law):
    decision = controller.set_target(1.0, NOW)
    assert decision.command.motion == LOOK
    assert controller.on_pose(pose(4), NOW) is None  # not yet acknowledged
    decision = controller.on_acknowledgement(done(1, 4), NOW + 0.01)
    assert (decision.command.id, decision.command.motion, decision.pose.cycle) == (2, FORWARD, 4)
    assert decision.command.pose_stamp_ns == round(NOW * 1e9)
    assert decision.command.expires_ns == round((NOW + 0.01 + 0.2) * 1e9)
    assert controller.on_acknowledgement(done(2, 5), NOW + 0.02) is None  # not yet seen
    decision = controller.on_pose(pose(5, 2.0, NOW + 0.02), NOW + 0.03)
    assert decision.command is None
    assert controller.state is State.ARRIVED
    assert controller.cycles == 2
    assert law.asked == [(1.0, 4, LOOK), (1.0, 5, FORWARD)]


def test_at_rest_it_says_nothing_whatever_comes(controller):
    assert controller.on_pose(pose(1, status=Status.LOST), NOW) is None
    assert controller.on_acknowledgement(done(9, 1), NOW) is None
    assert controller.on_time(NOW + 1e9) is None
    assert controller.state is State.IDLE


def test_an_answer_to_the_controller_before_this_one_is_not_taken(controller):
    controller.set_target(1.0, NOW)
    controller.on_pose(pose(4), NOW)
    assert controller.on_acknowledgement(done(1, 4, received_ns=round((NOW - 1) * 1e9)), NOW) is None
    assert controller.on_acknowledgement(done(1, 4), NOW).command.id == 2


def arrive(controller, cycle=4, psi=2.0):
    controller.set_target(1.0, NOW)
    controller.on_acknowledgement(done(1, cycle), NOW)
    controller.on_pose(pose(cycle, psi), NOW)
    assert controller.state is State.ARRIVED


def test_a_fresh_pose_saves_the_look(controller, law):
    arrive(controller)
    decision = controller.set_target(3.0, NOW + 0.1)
    assert decision.command.motion == FORWARD
    assert law.asked[-1] == (3.0, 4, None)


def test_an_old_one_does_not(controller):
    arrive(controller)
    assert controller.set_target(3.0, NOW + 5).command.motion == LOOK


def test_a_new_target_under_way_waits_for_the_pose_that_is_due(controller, law):
    controller.set_target(1.0, NOW)
    assert controller.set_target(5.0, NOW) is None
    controller.on_acknowledgement(done(1, 4), NOW)
    assert controller.on_pose(pose(4, 2.0), NOW).command.motion == FORWARD
    assert law.asked == [(5.0, 4, LOOK)]


def test_a_pose_of_before_the_command_is_not_looked_at(controller):
    controller.set_target(1.0, NOW)
    assert controller.on_pose(pose(3, at=NOW - 0.01, status=Status.LOST), NOW) is None
    assert controller.state is State.MOVING


def test_a_pose_that_waited_too_long_for_its_acknowledgement_is_stale(controller, law):
    controller.set_target(1.0, NOW)
    controller.on_pose(pose(4), NOW)
    controller.on_acknowledgement(done(1, 4), NOW + 1.01)
    assert controller.state is State.STOPPED
    assert "stale" in controller.reason
    assert not law.asked


@pytest.mark.parametrize(
    ("answered", "late", "words"),
    [(False, 0.2 + 0.5 + 1 / 90, "acknowledgement"), (True, 1.0, "pose of cycle 4")],
)
def test_deadlines(controller, answered, late, words):
    controller.set_target(1.0, NOW)
    if answered:
        controller.on_acknowledgement(done(1, 4), NOW)
    assert controller.on_time(NOW + late - 1e-3) is None
    decision = controller.on_time(NOW + late + 1e-3)
    assert decision.command.motion == STOP
    assert words in controller.reason


def test_a_target_that_takes_too_long(controller):
    controller.set_target(1.0, NOW)
    for k in range(100):
        now = NOW + k
        assert controller.on_acknowledgement(done(k + 1, k + 1), now) is None
        if (decision := controller.on_pose(pose(k + 1, at=now), now)) and not decision.command.motion.cycles:
            break
        if controller.on_time(now + 0.5):
            break
    assert controller.reason == "not arrived within 60 s"


def test_intermediate_frames_of_a_long_command_are_watched(controller, law):
    law.next_motion = lambda target, pose, made: Motion(10, 1.0, 1)
    controller.set_target(1.0, NOW)
    controller.on_acknowledgement(done(1, 1), NOW)
    assert controller.on_pose(pose(1), NOW).command.motion.cycles == 10
    assert controller.on_pose(pose(2, at=NOW + 0.01), NOW + 0.01) is None
    decision = controller.on_pose(pose(3, at=NOW + 0.02, status=Status.LOST, reason="covered"), NOW + 0.02)
    assert decision.command.motion == STOP
    assert controller.reason == "pose lost: covered"


def test_a_stop_holds_until_the_next_target(controller):
    controller.set_target(1.0, NOW)
    assert controller.stop("asked to stop").command.motion == STOP
    assert controller.on_acknowledgement(done(1, 4), NOW) is None
    assert controller.on_pose(pose(4), NOW) is None
    assert (controller.state, controller.reason) == (State.STOPPED, "asked to stop")
    assert controller.set_target(1.0, NOW).command.motion == LOOK
    assert (controller.state, controller.reason) == (State.MOVING, "")


def test_a_pose_that_comes_late_is_not_the_latest(controller):
    controller.set_target(9.0, NOW)
    controller.on_acknowledgement(done(1, 1), NOW)
    assert controller.on_pose(pose(1, 0.1, reference_version=3), NOW).command.motion == FORWARD
    assert controller.on_pose(pose(0, 0.0, at=NOW - 0.01, reference_version=2), NOW) is None
    controller.on_acknowledgement(done(2, 2), NOW)
    step = np.array([0, 0, 0, 0, 0, 0.1])
    following = pose(2, 0.2, at=NOW + 0.01, reference_version=3, increment=step, increment_cycles=1)
    assert controller.on_pose(following, NOW + 0.01).command.motion == FORWARD


def test_a_recentred_origin_changes_nothing_and_another_zero_of_psi_stops(controller):
    controller.set_target(9.0, NOW)
    controller.on_acknowledgement(done(1, 1), NOW)
    controller.on_pose(pose(1, 0.1), NOW)
    controller.on_acknowledgement(done(2, 2), NOW)
    step = np.array([0, 0, 0, 0, 0, 0.1])
    recentred = pose(2, 0.2, reference_version=3, increment=step, increment_cycles=1)
    assert controller.on_pose(recentred, NOW).command.motion == FORWARD
    controller.on_acknowledgement(done(3, 3), NOW)
    controller.on_pose(pose(3, 0.0, reference_version=4, increment=step, increment_cycles=1), NOW)
    assert controller.reason == "reference version 4: psi has another zero"


@pytest.mark.parametrize("target", [math.nan, math.inf])
def test_a_target_that_is_no_angle_is_refused(controller, target):
    with pytest.raises(InputError, match="psi in rad"):
        controller.set_target(target, NOW)
    assert controller.state is State.IDLE


# Whole motions ------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", FAULTS)
def test_no_cycle_follows_a_fault(name):
    for seed in (1, 2, 3):
        cycles, reason = cycles_after(FAULTS[name], seed)
        assert cycles == 0
        assert reason


def test_without_the_guard_a_fault_would_be_acted_on():
    """The faults above are faults: the law alone goes on from them."""
    loop = SyntheticLoop(SimulationSettings())
    loop.controller._why_stop = lambda pose, now: ""
    loop.fault, loop.fault_from = FAULTS["play beyond its limit"], 6
    assert loop.go(2.0).state is State.ARRIVED


def test_after_a_stop_the_next_target_is_reached():
    loop = SyntheticLoop(SimulationSettings())
    loop.fault, loop.fault_from = FAULTS["pose lost"], 6
    assert loop.go(2.0).state is State.STOPPED
    loop.fault_from = 10**6
    move = loop.go(2.0)
    assert move.state is State.ARRIVED
    assert abs(move.error) < 1e-3


def test_every_target_is_reached_within_the_resolution_whatever_the_drive():
    """Truth decides; the open loop, with the same knowledge of the same drives, misses by far more."""
    for drive, closed, opened in figures(seeds=4, count=20):
        error = np.array([move.error for move in closed])
        blind = np.array([move.error for move in opened])
        assert all(move.state is State.ARRIVED for move in closed), drive.name
        assert np.abs(error).max() <= drive.tolerance, drive.name
        if drive.told.fine_steps:
            assert np.sqrt((blind**2).mean()) > 15 * np.sqrt((error**2).mean()), drive.name
        spent = sum(move.cycles for move in closed) / sum(move.fewest for move in closed)
        assert spent < 1.25, drive.name


def test_a_good_drive_takes_hardly_more_than_the_fewest_cycles():
    (drive, closed, _) = next(figures(seeds=10, count=20))
    assert drive is DRIVES[0]
    extra = np.mean([move.cycles - move.fewest for move in closed])
    # The drive itself costs about one: backlash at every second target, jitter of the tolerance's size.
    assert extra < 1.5


def test_an_exact_drive_needs_no_loop():
    exact = SimulationSettings(step_error=0.0, step_jitter=0.0)
    moves = open_loop(exact, DRIVES[0].told, [0.5, -0.3, 0.1, 2.0])
    assert max(abs(move.error) for move in moves) < 1e-9
