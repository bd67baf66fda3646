"""The rules of the actuation interface: every command answered once, every stop within one cycle."""

from __future__ import annotations

import threading
import time
from dataclasses import replace

import pytest

from mems6dof_ros.control.actuator import Actuator
from mems6dof_ros.control.commands import LOOK, STOP, Acknowledgement, Command, Motion, Outcome, why_refused

FAST = 1e6  # Hz


def command(number, cycles=1, **changes):
    return Command(number, Motion(cycles, 1.0, 1), changes.pop("frequency", FAST), **changes)


@pytest.fixture
def answers():
    return []


@pytest.fixture
def actuator(answers):
    it = Actuator(max_frequency=FAST)
    it.on_acknowledgement = answers.append
    return it


def drive(actuator, cycles):
    for _ in range(cycles):
        assert actuator.next_cycle(0.1) is not None
        actuator.cycle_done()


def test_a_command_is_driven_cycle_by_cycle_and_answered_once(actuator, answers):
    before = time.time_ns()
    actuator.submit(command(7, cycles=3))
    drive(actuator, 2)
    assert not answers
    drive(actuator, 1)
    (answer,) = answers
    assert answer == Acknowledgement(
        7, Outcome.DONE, "", 3, 3, answer.received_ns, answer.started_ns, answer.ended_ns
    )
    assert before <= answer.received_ns <= answer.started_ns <= answer.ended_ns <= time.time_ns()
    assert actuator.next_cycle(0.0) is None


def test_a_stop_takes_effect_at_the_end_of_the_cycle_under_way(actuator, answers):
    actuator.submit(command(1, cycles=10))
    drive(actuator, 2)
    actuator.next_cycle(0.1)
    actuator.submit(Command(2, STOP, FAST))
    assert not answers
    actuator.cycle_done()
    assert [(a.id, a.outcome, a.cycles_driven, a.cycle) for a in answers] == [
        (1, Outcome.STOPPED, 3, 3),
        (2, Outcome.DONE, 0, 3),
    ]
    assert actuator.next_cycle(0.0) is None


def test_a_later_command_replaces_the_one_before_and_the_one_that_waits(actuator, answers):
    actuator.submit(command(1, cycles=10))
    actuator.next_cycle(0.1)
    actuator.submit(command(2))
    actuator.submit(command(3))
    assert [(a.id, a.outcome, a.reason) for a in answers] == [(2, Outcome.STOPPED, "replaced by command 3")]
    actuator.cycle_done()
    assert actuator.next_cycle(0.1).id == 3
    actuator.cycle_done()
    assert [(a.id, a.outcome, a.cycles_driven) for a in answers[1:]] == [
        (1, Outcome.STOPPED, 1),
        (3, Outcome.DONE, 1),
    ]


def test_a_command_replaced_in_its_last_cycle_is_done(actuator, answers):
    actuator.submit(command(1))
    actuator.next_cycle(0.1)
    actuator.submit(command(2))
    actuator.cycle_done()
    assert [(a.id, a.outcome, a.reason) for a in answers] == [(1, Outcome.DONE, "")]


def test_a_disabled_drive_ends_its_cycle_and_obeys_nothing_but_stops(actuator, answers):
    actuator.submit(command(1, cycles=10))
    actuator.next_cycle(0.1)
    actuator.enable(False)
    actuator.submit(command(2))
    actuator.cycle_done()
    actuator.submit(Command(3, STOP, FAST))
    assert [(a.id, a.outcome, a.cycles_driven) for a in answers] == [
        (2, Outcome.REFUSED, 0),
        (1, Outcome.STOPPED, 1),
        (3, Outcome.DONE, 0),
    ]
    assert actuator.next_cycle(0.0) is None
    actuator.enable(True)
    actuator.submit(command(4))
    drive(actuator, 1)
    assert answers[-1].outcome is Outcome.DONE


def test_cycles_keep_the_frequency(actuator):
    actuator.submit(command(1, cycles=6, frequency=100.0))
    start = time.monotonic()
    drive(actuator, 6)
    assert time.monotonic() - start >= 5 * 0.01 - 1e-4
    slow = command(2, cycles=2, frequency=0.01)
    actuator.submit(slow)
    drive(actuator, 1)
    start = time.monotonic()
    assert actuator.next_cycle(0.05) is None  # its second cycle is due in 100 s
    assert time.monotonic() - start < 5


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"motion": Motion(1001, 1.0, 1)}, "1001 cycles"),
        ({"motion": Motion(1, 3.1, 1)}, "amplitude 3.1"),
        ({"motion": Motion(1, float("nan"), 1)}, "amplitude nan"),
        ({"motion": Motion(1, 1.0, 0)}, "direction 0"),
        ({"frequency": 0.0}, "frequency 0 Hz"),
        ({"frequency": float("inf")}, "frequency inf"),
        ({"frequency": 201.0}, "frequency 201 Hz"),
        ({"expires_ns": 1}, "expired"),
        ({"expires_ns": 1, "motion": STOP}, "expired"),
    ],
)
def test_senseless_and_late_commands_are_refused_and_disturb_nothing(changes, words):
    answers, actuator = [], Actuator()
    actuator.on_acknowledgement = answers.append
    good = Command(1, Motion(5, 1.0, 1), 200.0)
    actuator.submit(good)
    actuator.submit(replace(good, id=2, **changes))
    (answer,) = answers
    assert (answer.id, answer.outcome, answer.cycles_driven) == (2, Outcome.REFUSED, 0)
    assert words in answer.reason
    assert actuator.next_cycle(0.1).id == 1


def test_a_stop_needs_no_frequency():
    assert why_refused(Command(1, STOP, 0.0), 0, 10, 100.0) == ""
    assert why_refused(Command(1, LOOK, 90.0), 0, 10, 100.0) == ""


def test_every_command_of_hasty_senders_is_answered_once(actuator, answers):
    sent, each = 4, 200

    def send(first):
        for k in range(each):
            actuator.submit(command(first + k, cycles=k % 3))

    def work():
        while actuator.next_cycle(0.5) is not None:
            actuator.cycle_done()

    worker = threading.Thread(target=work)
    senders = [threading.Thread(target=send, args=(1000 * n,)) for n in range(sent)]
    for thread in (worker, *senders):
        thread.start()
    for thread in (*senders, worker):
        thread.join(30)
    assert not worker.is_alive()
    assert len(answers) == len({answer.id for answer in answers}) == sent * each
    assert sum(answer.cycles_driven for answer in answers) == actuator.cycle
