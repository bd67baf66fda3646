"""The simulated microsystem under command: a frame for every cycle, and truth in each."""

from __future__ import annotations

import threading
import time

import pytest

from mems6dof_ros.control.commands import LOOK, Command, Motion
from mems6dof_ros.errors import InputError
from mems6dof_ros.sources.simulator import CommandedSimulator, SimulatorSource
from mems6dof_ros.sources.source import open_source

SMALL = {"width_px": 256, "height_px": 256, "gear_diameter": 30e-6, "hub_diameter": 4e-6, "particles": 5}


def test_one_frame_at_rest_and_one_for_each_cycle():
    source = open_source("simulator", commanded=True, **SMALL)
    answers = []
    source.actuator.on_acknowledgement = answers.append
    source.start()
    before = time.time_ns()
    frames = [source.read(timeout=0.0)]
    source.actuator.submit(Command(1, Motion(3, 1.0, -1), 200.0))
    frames += [source.read(timeout=1.0) for _ in range(3)]
    with pytest.raises(TimeoutError):
        source.read(timeout=0.0)
    source.actuator.submit(Command(2, LOOK, 200.0))
    frames.append(source.read(timeout=1.0))
    assert [frame.cycle for frame in frames] == [0, 1, 2, 3, 4]
    assert [frame.frame_counter for frame in frames] == [0, 1, 2, 3, 4]
    assert all(frame.live for frame in frames)
    stamps = [frame.stamp_ns for frame in frames]
    assert before <= stamps[0] < stamps[1] < stamps[2] < stamps[3] < stamps[4] <= time.time_ns()
    psi = [frame.truth[0].psi for frame in frames]
    assert psi[0] > psi[1] > psi[2] > psi[3] == psi[4]
    assert [(answer.id, answer.cycles_driven, answer.cycle) for answer in answers] == [(1, 3, 3), (2, 1, 4)]
    assert answers[0].ended_ns <= stamps[3]


def test_a_reader_that_waits_is_woken_by_a_command():
    source = CommandedSimulator(**SMALL)
    source.start()
    source.read()
    timer = threading.Timer(0.05, source.actuator.submit, (Command(1, LOOK, 200.0),))
    timer.start()
    assert source.read(timeout=30.0).cycle == 1
    timer.join()


def test_the_lens_can_be_covered():
    source = CommandedSimulator(**SMALL)
    source.start()
    assert source.read().truth[0].electrons.any()
    source.experiment.cover()
    source.actuator.submit(Command(1, LOOK, 200.0))
    assert not source.read(timeout=1.0).truth[0].electrons.any()


def test_it_is_chosen_by_an_option_and_knows_no_number_of_cycles():
    assert isinstance(open_source("simulator", cycles=3, loop=0, commanded=False, **SMALL), SimulatorSource)
    assert isinstance(open_source("simulator", cycles=0, loop=0, commanded=True, **SMALL), CommandedSimulator)
    with pytest.raises(InputError, match="cycles"):
        open_source("simulator", cycles=3, commanded=True, **SMALL)
