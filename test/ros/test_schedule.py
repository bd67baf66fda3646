"""When frames are due."""

from __future__ import annotations

import pytest

from mems6dof_ros.nodes.schedule import Schedule


def test_a_rate_is_kept_without_drift():
    schedule, now = Schedule(), 100.0
    published = []
    for k in range(50):
        now = max(now, schedule.due(k, 20.0, 0.0)) + 0.003  # each wait ends 3 ms late
        assert schedule.keep(k, now, 20.0, 0.0)
        published.append(now)
    assert published[-1] - published[0] == pytest.approx(49 / 20, abs=0.0031)


@pytest.mark.parametrize("speed", [0.5, 1.0, 4.0])
def test_stamps_tell_the_pace(speed: float):
    schedule, stamps = Schedule(), [0, 10_000_000, 500_000_000, 500_000_000, 2_000_000_000]
    assert schedule.due(stamps[0], 1.0, speed) == 0.0
    schedule.keep(stamps[0], 7.0, 1.0, speed)
    for stamp in stamps[1:]:
        due = schedule.due(stamp, 1.0, speed)
        assert due == pytest.approx(7.0 + stamp * 1e-9 / speed)
        schedule.keep(stamp, due, 1.0, speed)


def test_what_is_late_begins_a_new_schedule():
    schedule = Schedule()
    schedule.keep(0, 10.0, 10.0, 0.0)
    assert not schedule.keep(1, 10.25, 10.0, 0.0)
    assert schedule.due(2, 10.0, 0.0) == pytest.approx(10.35)


def test_a_change_of_pace_counts_from_the_last_frame():
    schedule = Schedule()
    schedule.keep(0, 10.0, 1.0, 0.0)
    assert schedule.due(1, 4.0, 0.0) == 10.25
    assert schedule.due(1, 0.0, 0.0) == 10.0


def test_after_a_pause_the_next_is_due_at_once():
    schedule = Schedule()
    schedule.keep(0, 10.0, 1.0, 0.0)
    schedule.restart()
    assert schedule.due(1, 1.0, 0.0) == 0.0
