"""The rows of `mems6dof validate lab` about broken messages, in short."""

from __future__ import annotations

from pathlib import Path

import pytest
from peers import SMALL_GEAR

from mems6dof_ros.figures import Figure
from mems6dof_ros.nodes.validation import hostile
from mems6dof_ros.simulation.settings import SimulationSettings

SETTINGS = SimulationSettings(**SMALL_GEAR)


def assert_passed(rows: list[Figure], least: int) -> None:
    verdicts = [row["passed"] for row in rows if row["passed"] is not None]
    assert len(verdicts) >= least
    assert all(verdicts), [row for row in rows if row["passed"] is False]


def test_broken_frames_and_localizations_change_no_pose(calibration: str, tmp_path: Path) -> None:
    assert_passed(list(hostile.broken_frames(SETTINGS, Path(calibration), 18, tmp_path)), 9)


@pytest.mark.parametrize("seed", [1])
def test_nonsense_on_every_topic_ends_no_node(calibration: str, tmp_path: Path, seed: int) -> None:
    assert_passed(list(hostile.fuzzed_topics(SETTINGS, Path(calibration), 4, seed, tmp_path)), 16)
