"""A scan through focus takes the frames that show the stage at rest, and no others."""

from __future__ import annotations

import math

import numpy as np
import pytest

from mems6dof_ros.errors import InputError
from mems6dof_ros.frame import NAN, Frame
from mems6dof_ros.sources.simulator import SubstrateSimulator, open_simulator
from mems6dof_ros.sources.stage import FocusScan, Stage, Standing, scan, shows

IMAGE = np.zeros((4, 4), np.uint16)


@pytest.mark.parametrize(
    ("start", "stop", "step", "positions"),
    [
        (-1e-6, 1e-6, 0.5e-6, [-1e-6, -0.5e-6, 0, 0.5e-6, 1e-6]),
        (1e-6, -1e-6, 1e-6, [1e-6, 0, -1e-6]),
        (1e-6, -1e-6, -1e-6, [1e-6, 0, -1e-6]),
        (0, 1e-6, 0.4e-6, [0, 0.4e-6, 0.8e-6]),
    ],
)
def test_positions(start: float, stop: float, step: float, positions: list[float]) -> None:
    assert FocusScan(start, stop, step).positions == pytest.approx(positions, abs=1e-15)


@pytest.mark.parametrize(
    ("start", "stop", "step", "frames"),
    [(0, 1e-6, 0, 1), (0, math.nan, 1e-7, 1), (0, 1e-7, 1e-6, 1), (0, 1, 1e-7, 1), (0, 1e-6, 1e-7, 0)],
)
def test_no_scan(start: float, stop: float, step: float, frames: int) -> None:
    with pytest.raises(InputError, match="focus scan"):
        FocusScan(start, stop, step, frames)


@pytest.mark.parametrize(
    ("frame", "shown"),
    [
        (Frame(IMAGE, 2_000, 0, 0, live=True), True),
        (Frame(IMAGE, 2_000, 0, 0, live=True, exposure_s=3e-6), False),  # began 500 ns after the stage moved
        (Frame(IMAGE, 500, 0, 0, live=True), False),
        (Frame(IMAGE, 500, 0, 0, stage_z=1e-6), True),  # replayed: its stamp tells nothing
        (Frame(IMAGE, 2_000, 0, 0, live=True, stage_z=2e-6), False),
        (Frame(IMAGE, 2_000, 0, 0, live=True, stage_z=NAN), True),
    ],
)
def test_only_frames_of_the_stage_at_rest(frame: Frame, shown: bool) -> None:
    assert shows(frame, Standing(1e-6, 1_000)) is shown


def test_scan_of_the_simulated_substrate() -> None:
    source = open_simulator(substrate=True, substrate_beads=3, width_px=128, height_px=128)
    assert isinstance(source, SubstrateSimulator)
    assert isinstance(source, Stage)
    clock = [0]

    def move(z: float) -> Standing:
        clock[0] = source.read().stamp_ns  # a frame of the position before is on its way
        return Standing(source.move_to(z), clock[0])

    told: list[tuple[int, int, float]] = []
    plan = FocusScan(-2e-6, 2e-6, 2e-6, 2)
    frames = list(scan(plan, move, lambda: source.read(), lambda *at: told.append(at)))
    assert [frame.stage_z for frame in frames] == [-2e-6, -2e-6, 0, 0, 2e-6, 2e-6]
    assert told == [(0, 3, -2e-6), (1, 3, 0), (2, 3, 2e-6), (3, 3, 2e-6)]
    peak = [int(frame.image.max()) for frame in frames]
    assert peak[2] > peak[0]
    assert peak[3] > peak[5]


def test_a_simulator_is_one_thing() -> None:
    with pytest.raises(InputError, match="both"):
        open_simulator(substrate=True, commanded=True)
    with pytest.raises(InputError, match="cycles"):
        open_simulator(substrate=True, cycles=3)
