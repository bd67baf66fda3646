"""Source, localizer and pose in one process: the same topics, the same numbers."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from peers import PATIENCE, SMALL_GEAR

from mems6dof_ros.analysis.recording import load_recording
from mems6dof_ros.analysis.truth import compare
from mems6dof_ros.calibration.file import load_calibration
from mems6dof_ros.errors import InputError
from mems6dof_ros.localization.localizer import Localizer
from mems6dof_ros.nodes.recorder import DEFAULT_TOPICS
from mems6dof_ros.nodes.runner import run_system
from mems6dof_ros.nodes.system import SYSTEMS, chain, simulated
from mems6dof_ros.pose.estimator import PoseEstimator
from mems6dof_ros.recording.bag import BagReader
from mems6dof_ros.sources.source import frames, open_source

CYCLES = 24


def record(path: Path, calibration: str, **parameters: object) -> None:
    """Run the pipeline with ``parameters`` beside a recorder, images included."""
    nodes = chain(
        simulated(CYCLES, **SMALL_GEAR),
        calibration=calibration,
        output=str(path),
        recorded=(*DEFAULT_TOPICS, "image_raw"),
        arrangement="pipeline",
    )
    assert [node.executable for node in nodes] == ["pipeline", "recorder"]
    nodes[0] = replace(nodes[0], parameters={**nodes[0].parameters, **parameters})
    lines: list[str] = []
    with run_system(nodes, on_line=lines.append) as system:
        system.wait("pipeline", timeout=PATIENCE)
        codes = system.stop()
    assert codes == {"pipeline": 0, "recorder": 0}, "\n".join(lines)


def test_the_same_topics_and_poses_as_by_function_calls(tmp_path: Path, calibration: str) -> None:
    record(tmp_path / "bag", calibration)
    with BagReader(tmp_path / "bag") as bag:
        counts = {topic: bag.counts[topic] for topic in bag.counts if topic != "/diagnostics"}
        poses = [recorded.message for recorded in bag.messages(["/pose_6dof"])]
    published = ("image_raw", "frame_info", "camera_info", "truth", "localizations", "pose_6dof")
    published += ("pose", "pose_with_covariance")
    assert counts == {f"/{topic}": CYCLES for topic in published}
    optics = load_calibration(calibration)
    localizer, estimator = Localizer(optics.camera, optics), PoseEstimator()
    for pose, frame in zip(poses, frames(open_source("bag", path=tmp_path / "bag")), strict=True):
        expected = estimator.update(localizer.localize(frame))
        found = [getattr(pose, name) for name in ("dx", "dy", "dz", "tilt_x", "tilt_y", "psi")]
        np.testing.assert_allclose(found, expected.displacement, rtol=0, atol=1e-12)
        stages = pose.latency_localization + pose.latency_pose
        assert pose.latency_total == pytest.approx(stages, abs=1e-6)  # nothing is sent in between


def test_tracking_stays_true(tmp_path: Path, calibration: str) -> None:
    """As accurate as its covariance claims: NEES / 6 over 24 cycles of six degrees of freedom."""
    record(tmp_path / "bag", calibration, **{"tracking.enabled": True})
    recording = load_recording(tmp_path / "bag")
    poses = recording.poses["load_gear"]
    assert len(poses) == CYCLES
    assert all(pose.valid for pose in poses)
    truths = [truth for truth in recording.truth_of(poses) if truth is not None]
    assert 0.4 < compare(poses, truths).nees_per_dof < 2


def test_a_pipeline_needs_a_source_and_an_arrangement_a_name() -> None:
    with pytest.raises(InputError, match="arrangement"):
        SYSTEMS["live"].table({"source": "none", "arrangement": "pipeline"})
    with pytest.raises(InputError, match="processes or pipeline"):
        SYSTEMS["demo"].table({"arrangement": "threads"})


def test_tracking_follows_but_one_body(tmp_path: Path, calibration: str) -> None:
    bodies = tmp_path / "bodies.yaml"
    bodies.write_text(
        "bodies: {a: {region: {centre: [0, 0], outer_radius: 1.0e-5}},"
        " b: {region: {centre: [2.0e-5, 0], outer_radius: 1.0e-5}}}"
    )
    nodes = chain(
        simulated(2, **SMALL_GEAR), calibration=calibration, bodies=str(bodies), arrangement="pipeline"
    )
    nodes[0] = replace(nodes[0], parameters={**nodes[0].parameters, "tracking.enabled": True})
    lines: list[str] = []
    with run_system(nodes, on_line=lines.append) as system:
        assert system.wait("pipeline", timeout=PATIENCE) == {"pipeline": 1}
    assert "tracking.enabled: found several bodies" in "\n".join(lines)
