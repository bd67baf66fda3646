"""The calibrator: a camera that runs, a stage that moves, and an action that can be called off."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from peers import NodeProcess, Peer

from mems6dof_msgs.action import Calibrate
from mems6dof_msgs.srv import MoveStage
from mems6dof_ros.calibration.calibrate import CalibrationSettings, calibrate
from mems6dof_ros.calibration.file import load_calibration
from mems6dof_ros.calibration.focus_stack import measure_stack
from mems6dof_ros.cli.main import main
from mems6dof_ros.errors import Mems6dofError
from mems6dof_ros.nodes.calibration_client import request_calibration
from mems6dof_ros.nodes.runner import command
from mems6dof_ros.nodes.system import NodeSpec
from mems6dof_ros.recording.frames import camera_to_json
from mems6dof_ros.simulation.settings import SimulationSettings
from mems6dof_ros.sources.simulator import camera_noise
from mems6dof_ros.sources.source import frames, open_recording

Start = Callable[..., NodeProcess]

SETTINGS = SimulationSettings(width_px=512, height_px=512)
CAMERA = camera_noise(SETTINGS)
BEADS = 30


def start_node(start: Start, executable: str, **parameters: Any) -> NodeProcess:
    arguments = command(NodeSpec(executable, parameters))
    return start(executable, *arguments[arguments.index("--ros-args") + 1 :])


def start_substrate(start: Start) -> NodeProcess:
    """A camera that looks at beads, and their stage."""
    options = {"substrate": True, "substrate_beads": BEADS, "width_px": 512, "height_px": 512}
    parameters = {f"simulator.{name}": value for name, value in options.items()}
    return start_node(start, "frame_source", source="simulator", pacing="rate", rate=30.0, **parameters)


def start_calibrator(start: Start, **parameters: Any) -> NodeProcess:
    camera = {f"camera.{name}": float(value) for name, value in json.loads(camera_to_json(CAMERA)).items()}
    node = start_node(start, "calibrator", window_px=31, **camera, **parameters)
    node.wait_for_line("ready")
    return node


def goal(path: Path, **fields: Any) -> Calibrate.Goal:
    values: dict[str, Any] = {"start": -3e-6, "stop": 3e-6, "step": 0.25e-6, "output": str(path), **fields}
    return Calibrate.Goal(**values)


def test_calibration_of_a_scan_is_that_of_its_frames(start: Start, tmp_path: Path) -> None:
    start_substrate(start)
    start_calibrator(start)
    out, kept = tmp_path / "optics.yaml", tmp_path / "scan"
    told: list[tuple[str, int, int]] = []
    result = request_calibration(
        goal(out, stack_output=str(kept), axial_range=2.5e-6),
        lambda feedback: told.append((feedback.phase, feedback.plane, feedback.planes)),
    )
    assert [each for each in told if each[0] == "scanning"] == [("scanning", n, 25) for n in range(26)]
    assert [each for each in told if each[0] == "fitting"] == [("fitting", n, 25) for n in range(1, 26)]
    assert told[-1] == ("modelling", 0, 0)
    assert f"Calibration {result.calibration_id}" in Path(result.report).read_text()
    assert result.beads > 10
    # The same frames, without ROS: the same calibration to the last digit.
    recorded = list(frames(open_recording(kept)))
    assert [frame.stage_z for frame in recorded] == pytest.approx(np.linspace(-3e-6, 3e-6, 25), abs=1e-15)
    stack = measure_stack(recorded, CAMERA, "relative_light_weighting", 31)
    again = calibrate([stack], CalibrationSettings(axial_range=2.5e-6)).calibration
    assert load_calibration(out).calibration_id == result.calibration_id == again.calibration_id


def test_a_cancelled_goal_writes_nothing_and_the_next_one_is_taken(
    start: Start, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    start_substrate(start)
    start_calibrator(start)
    folder = tmp_path / "results"
    folder.mkdir()

    def interrupt(phase: str) -> Callable[[Calibrate.Feedback], None]:
        def at(feedback: Calibrate.Feedback) -> None:
            if feedback.phase == phase and feedback.plane == 3:
                raise KeyboardInterrupt

        return at

    asked = goal(folder / "optics.yaml", stack_output=str(folder / "scan"))
    for phase in ("scanning", "fitting"):
        with pytest.raises(KeyboardInterrupt):
            request_calibration(asked, interrupt(phase))
        assert list(folder.iterdir()) == []
    # By the command that a user types.
    assert main(["scan", "3e-6", "0.25e-6", "--out", str(folder / "optics.yaml")]) == 0
    said = capfd.readouterr()
    assert "beads, method joint" in said.out
    assert "plane: 25 of 25" in said.err
    assert {path.name for path in folder.iterdir()} == {"optics.yaml", "optics.html"}


def test_reasons(start: Start, peer: Peer, tmp_path: Path) -> None:
    """What cannot be done is said in one line, and the calibrator lives on."""
    start_calibrator(start, stage_timeout=0.5, frame_timeout=0.5)

    def refused(**fields: Any) -> str:
        with pytest.raises(Mems6dofError) as caught:
            request_calibration(goal(tmp_path / "optics.yaml", **fields))
        return str(caught.value)

    assert "found nobody; expected a stage" in refused()
    assert "focus scan" in refused(step=0.0)
    assert "goal output" in refused(output=str(tmp_path / "nowhere" / "optics.yaml"))
    assert "rotations: found 3 values" in refused(rotations=[0.0, 1.0, 2.0])
    assert "none.tif" in refused(earlier_stacks=[str(tmp_path / "none.tif")])

    stuck = threading.Event()

    def on_move(request: MoveStage.Request, response: MoveStage.Response) -> MoveStage.Response:
        response.success, response.message = not stuck.is_set(), "the motor is hot"
        response.z = request.z
        return response

    peer.node.create_service(MoveStage, "move_stage", on_move)
    assert "image_raw: found no frame within 0.5 s" in refused()
    stuck.set()
    assert "the stage does not move to -3.000 um: the motor is hot" in refused()
    assert list(tmp_path.glob("optics*")) == []
