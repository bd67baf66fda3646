"""The closed loop as processes over DDS: frames of 512 px, measured, acted on; and interrupted."""

from __future__ import annotations

import math
import subprocess
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from peers import own_domain

from mems6dof_ros.calibration.calibrate import calibrate
from mems6dof_ros.calibration.file import save_calibration
from mems6dof_ros.calibration.focus_stack import measure_stack
from mems6dof_ros.cli.closed_loop import run_closed_loop
from mems6dof_ros.nodes.closed_loop import approach, closed_loop, data_sheet, safe_stops
from mems6dof_ros.nodes.loop_client import stages
from mems6dof_ros.nodes.runner import command
from mems6dof_ros.nodes.system import NodeSpec
from mems6dof_ros.recording import topics
from mems6dof_ros.recording.bag import BagReader
from mems6dof_ros.simulation.experiment import focus_stack
from mems6dof_ros.simulation.settings import SimulationSettings
from mems6dof_ros.sources.simulator import camera_noise

#: A gear that fits into 512 px, on a drive that errs.
SETTINGS = SimulationSettings(
    width_px=512,
    height_px=512,
    gear_diameter=60e-6,
    hub_diameter=8e-6,
    particles=30,
    step_error=0.05,
    stall_probability=0.02,
)


@pytest.fixture(autouse=True)
def domain(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[None]:
    """A ROS domain of each test's own, on this machine only, for this process and its children."""
    monkeypatch.setenv("ROS_LOG_DIR", str(tmp_path / "ros_log"))
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    with own_domain() as number:
        monkeypatch.setenv("ROS_DOMAIN_ID", str(number))
        yield


@pytest.fixture(scope="module")
def calibration(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A calibration of the default simulated optics at 512 px."""
    small = SimulationSettings(width_px=512, height_px=512)
    frames = focus_stack(small, -3e-6, 3e-6, 0.25e-6, beads=30, seed=3)
    stack = measure_stack(frames, camera_noise(small), "relative_light_weighting", 31)
    path = tmp_path_factory.mktemp("calibration") / "optics.yaml"
    save_calibration(calibrate([stack]).calibration, path)
    return path


def test_targets_are_reached_and_every_stage_is_timed(calibration: Path, tmp_path: Path) -> None:
    with closed_loop(SETTINGS, calibration, tmp_path / "nodes.log") as (client, system):
        moves = approach(client, SETTINGS, [0.4, -0.25, 1.1])
        times = stages(client)
        commands = client.received[topics.ACTUATION_COMMAND]
        answers = client.received[topics.ACTUATION_ACKNOWLEDGEMENT]
        frames = client.received[topics.TRUTH]
        pids = [process.pid for process in system.processes.values()]
    tolerance = max(data_sheet(SETTINGS).resolution, 1e-3)
    for move in moves:
        assert not move.reason
        assert abs(move.error) <= tolerance
    # One frame at rest, and one for each cycle; every command answered once.
    assert [frame.cycle for frame in frames] == list(range(len(frames)))
    assert sum(answer.cycles_driven for answer in answers) == len(frames) - 1
    assert [answer.id for answer in answers] == [message.id for message in commands]
    assert len(times["reaction"]) >= sum(move.fewest for move in moves)
    parts = [name for name in times if name not in ("bare transport", "reaction")]
    since_publication = sum(times[name] for name in parts[parts.index("frame to localizer") :])
    np.testing.assert_allclose(since_publication, times["reaction"], atol=2e-3)
    assert all((values >= 0).all() for values in times.values())
    assert (times["bare transport"] < times["reaction"]).all()
    assert not any(Path(f"/proc/{pid}").exists() for pid in pids)


def test_the_gear_stands_within_a_cycle_of_losing_view_drive_or_node(
    calibration: Path, tmp_path: Path
) -> None:
    stops = {
        name: (cycles, reason) for name, cycles, reason in safe_stops(SETTINGS, calibration, tmp_path / "log")
    }
    assert all(cycles <= 1 for cycles, _ in stops.values()), stops
    assert stops["view: lens covered"][1].startswith("pose lost")
    assert "disabled" in stops["drive: disabled"][1]
    assert stops["node: localizer killed"][1].startswith("no pose of cycle")
    assert len(stops) == 4


def test_the_demonstration_writes_what_it_says(
    calibration: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert run_closed_loop(out, calibration=calibration, settings=SETTINGS, targets=2) == 0
    printed, told = capsys.readouterr()
    assert "open loop, same drive" in printed
    assert "watch it in a browser: http://127.0.0.1:" in told
    assert (out / "closed_loop.png").stat().st_size > 10_000
    lines = [line for line in (out / "moves.csv").read_text().splitlines() if not line.startswith("#")]
    assert len(lines) == 3
    assert math.fabs(float(lines[1].split(",")[1])) < 1e-3
    with BagReader(out / "bag") as bag:
        counts = bag.counts
    assert counts["/psi_target"] == 2
    assert counts["/actuation_command"] == counts["/actuation_acknowledgement"] > 10
    assert counts["/controller_state"] > counts["/actuation_command"]


@pytest.mark.parametrize(
    ("parameters", "words"),
    [
        ({"law": "nowhere:Law"}, "nowhere"),
        ({"law": "mems6dof_ros.control.position:Nothing"}, "Nothing"),
        ({"drive.max_amplitude": 0.2}, "max_amplitude"),
        ({"max_tilt": -1.0}, "max_tilt"),
    ],
)
def test_unusable_parameters_are_refused_with_one_line(parameters: dict, words: str) -> None:
    result = subprocess.run(
        command(NodeSpec("controller", parameters)), capture_output=True, text=True, timeout=60
    )
    assert result.returncode == 1
    assert words in result.stderr
    assert "Traceback" not in result.stderr
