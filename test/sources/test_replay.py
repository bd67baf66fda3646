"""Recordings from the middle and in rounds: nothing goes back, the first round is as recorded."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import tifffile

from mems6dof_ros.errors import InputError, Mems6dofError
from mems6dof_ros.frame import Frame
from mems6dof_ros.sources.replay import Replay
from mems6dof_ros.sources.source import SourceInfo, frames, open_source

T0 = 1_700_000_000_000_000_000


class Recorded:
    """Frames at the given times in ms, counters from 50 in steps of 2, cycles from 7."""

    def __init__(self, *milliseconds: int, refused: int = -1) -> None:
        self.milliseconds, self.refused = milliseconds, refused
        self.info = SourceInfo("bag", 4, 4, "mono16", frames=len(milliseconds))
        self.next = 0

    def start(self) -> None:
        self.next = 0

    def read(self, timeout: float | None = None) -> Frame | None:
        k, self.next = self.next, self.next + 1
        if k == self.refused:
            raise InputError("image", "colour", "mono16")
        if k >= len(self.milliseconds):
            return None
        image = np.full((4, 4), k, np.uint16)
        stamp = T0 + self.milliseconds[k] * 1_000_000
        return Frame(image, stamp, frame_counter=50 + 2 * k, cycle=7 + k, frames_dropped=1)

    def stop(self) -> None:
        self.next = len(self.milliseconds)


def places(read: list[Frame]) -> list[tuple[float, int, int]]:
    return [((f.stamp_ns - T0) / 1e6, f.frame_counter, f.cycle) for f in read]


def test_the_first_round_is_as_recorded_and_later_ones_follow_it():
    replay = Replay(Recorded(0, 10, 25, 30), loop=True)
    assert replay.info.frames is None
    replay.start()
    read = [replay.read() for _ in range(10)]
    assert places(read[:4]) == [(0, 50, 7), (10, 52, 8), (25, 54, 9), (30, 56, 10)]
    # The mean interval is 10 ms: the second round begins at 40 ms, one frame and one cycle on.
    assert places(read[4:8]) == [(40, 57, 11), (50, 59, 12), (65, 61, 13), (70, 63, 14)]
    assert places(read[8:]) == [(80, 64, 15), (90, 66, 16)]
    assert [int(f.image[0, 0]) for f in read] == [0, 1, 2, 3, 0, 1, 2, 3, 0, 1]
    assert [f.frames_dropped for f in read[3:6]] == [1, 0, 1]
    assert replay.rounds == 3


def test_once_without_loop_and_further_after_another_start():
    replay = Replay(Recorded(0, 10))
    assert places(list(frames(replay))) == [(0, 50, 7), (10, 52, 8)]
    assert places(list(frames(replay))) == [(20, 53, 9), (30, 55, 10)]


def test_what_goes_on_by_itself_keeps_its_time():
    """A camera that is started again counts from 0, but its clock went on."""
    source = Recorded(0, 10)
    replay = Replay(source)
    list(frames(replay))
    source.milliseconds = (500, 510)
    assert places(list(frames(replay))) == [(500, 53, 9), (510, 55, 10)]


def test_begin_leaves_out_what_is_before_in_every_round():
    replay = Replay(Recorded(0, 10, 20, 30), begin=0.015, loop=True)
    replay.start()
    read = [replay.read() for _ in range(5)]
    assert places(read) == [(20, 54, 9), (30, 56, 10), (40, 57, 11), (50, 59, 12), (60, 60, 13)]


def test_a_recording_that_ends_before_its_beginning_is_an_error():
    replay = Replay(Recorded(0, 10), begin=1.0, loop=True)
    replay.start()
    with pytest.raises(Mems6dofError, match="nothing to replay: the recording ends before 1 s"):
        replay.read()


def test_nothing_in_a_loop_ends():
    replay = Replay(Recorded(), loop=True)
    replay.start()
    assert replay.read() is None


def test_refused_frames_are_refused_in_every_round():
    replay = Replay(Recorded(0, 10, 20, refused=1), loop=True)
    replay.start()
    read, refused = [], 0
    for _ in range(9):
        try:
            read.append(replay.read())
        except InputError:
            refused += 1
    assert refused == 3
    assert all(a.stamp_ns < b.stamp_ns and a.cycle < b.cycle for a, b in pairwise(read))


def test_one_image_over_and_over(tmp_path):
    tifffile.imwrite(tmp_path / "one.tif", np.ones((4, 4), np.uint16))
    replay = Replay(open_source("images", path=tmp_path / "one.tif", period=0.5), loop=True)
    replay.start()
    read = [replay.read() for _ in range(3)]
    assert [f.stamp_ns for f in read] == [500_000_000, 600_000_000, 700_000_000]
    assert [f.cycle for f in read] == [0, 1, 2]
