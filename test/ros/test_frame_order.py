"""Which frames are taken for what, in any order of arrival."""

from __future__ import annotations

import random

import pytest

from mems6dof_ros.nodes.frame_order import Arrival, CycleCount, FrameOrder

NEXT, AGAIN, LATE, ANEW, REWOUND = Arrival
PERIOD = 11_000_000
T0 = 1_700_000_000_000_000_000


def judge(order: FrameOrder, *frames: int, counted: bool = True, later: int = 0) -> list[Arrival]:
    return [order.judge(T0 + k * PERIOD + later, k if counted else None) for k in frames]


def test_repeated_and_late_frames_are_told_apart_and_disturb_nothing():
    order = FrameOrder()
    arrivals = judge(order, 3, 4, 4, 6, 5, 6, 4, 7)
    assert arrivals == [NEXT, NEXT, AGAIN, NEXT, LATE, AGAIN, AGAIN, NEXT]


@pytest.mark.parametrize("counted", [True, False])
@pytest.mark.parametrize("seed", range(10))
def test_disorder_is_never_taken_for_a_new_beginning(seed: int, counted: bool):
    """Any frame may come again at once, or up to three places late."""
    rng = random.Random(seed)
    order = FrameOrder()
    frames = sorted(range(1, 400), key=lambda k: k + rng.choice((0, 0, 0, 3.5)))
    frames = [k for k in frames for _ in range(rng.choice((1, 1, 2)))]
    arrivals = judge(order, *frames, counted=counted)
    assert ANEW not in arrivals
    newest, seen = 0, set()
    for k, arrival in zip(frames, arrivals, strict=True):
        assert arrival is (NEXT if k > newest else AGAIN if k in seen else LATE)
        if arrival is NEXT:
            newest = k
            seen.add(k)


def test_a_camera_that_counts_from_0_again_has_begun_anew():
    order = FrameOrder()
    assert judge(order, 7, 8) == [NEXT, NEXT]
    assert judge(order, 0, 1, 2, later=10**9) == [ANEW, NEXT, NEXT]
    assert judge(order, 1, later=2 * 10**9) == [ANEW]  # its first frame was missed


def test_a_recording_from_its_beginning_has_begun_anew():
    order = FrameOrder()
    judge(order, *range(100))
    assert judge(order, 0, 1, 2) == [ANEW, NEXT, NEXT]


def test_the_first_frame_alone_comes_again():
    assert judge(FrameOrder(), 0, 0, 0) == [NEXT, AGAIN, AGAIN]


@pytest.mark.parametrize("counted", [True, False])
def test_a_recording_from_its_middle_is_known_by_a_run(counted: bool):
    order = FrameOrder()
    judge(order, *range(100), counted=counted)
    assert judge(order, *range(20, 27), counted=counted) == [LATE] * 4 + [ANEW, NEXT, NEXT]


def test_time_that_jumps_back_counts_from_the_first_frame_behind():
    """What was under way when it jumped still belongs to the old time."""
    order = FrameOrder()
    judge(order, 50, 51)
    order.rewind()
    assert judge(order, 52, 53, 10, 11) == [NEXT, NEXT, REWOUND, NEXT]
    assert judge(order, 9) == [LATE]


def test_frames_without_stamps_are_all_new():
    order = FrameOrder()
    assert [order.judge(0, None) for _ in range(3)] == [NEXT] * 3


def test_cycles_ascend_over_restarts():
    count = CycleCount()
    assert [count(k) for k in (5, 6, 8)] == [5, 6, 8]
    count.restart()
    assert [count(k) for k in (0, 1, 2)] == [9, 10, 11]
    count.restart()
    assert [count(k) for k in (7, 6, 9)] == [12, 11, 14]
