"""Load gear and ring gear in one field, through the real nodes: topics, truth, relative motion, replay."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from peers import PATIENCE, NodeProcess, Peer
from std_srvs.srv import Trigger

from mems6dof_msgs.msg import Localizations as LocalizationsMessage
from mems6dof_msgs.msg import Pose6DOF
from mems6dof_ros.analysis.check import check_bag
from mems6dof_ros.analysis.recording import load_recording
from mems6dof_ros.analysis.truth import compare
from mems6dof_ros.calibration.file import load_calibration
from mems6dof_ros.nodes.runner import run_system
from mems6dof_ros.nodes.system import chain, simulated
from mems6dof_ros.pose.bodies import relative_pose
from mems6dof_ros.pose.bodies_file import load_bodies
from mems6dof_ros.pose.field import FieldError
from mems6dof_ros.pose.settings import PoseSettings
from mems6dof_ros.pose.synthetic import Scene, SyntheticGear
from mems6dof_ros.recording import messages
from mems6dof_ros.recording.bag import BagReader
from mems6dof_ros.recording.poses import pose_topics

CYCLES = 40
#: A load gear and its ring gear, both wholly in the field of 65 um.
TWO_GEARS = {
    "width_px": 512, "height_px": 512, "particles": 14, "clumps": 0, "gear_diameter": 24e-6,
    "hub_diameter": 4e-6, "gear_x": -17e-6, "gear_y": 0.0, "ring_particles": 14, "ring_diameter": 30e-6,
    "ring_width": 12e-6, "play": 100e-9, "electrons": 1e5,
}  # fmt: skip
BODIES = """
bodies:
  load_gear: {region: {centre: [-17.0e-6, 0], outer_radius: 13.0e-6}}
  ring_gear: {region: {centre: [10.0e-6, 0], outer_radius: 15.9e-6}}
"""


@pytest.mark.parametrize("arrangement", ["processes", "pipeline"])
def test_two_bodies(tmp_path: Path, calibration: str, arrangement: str) -> None:
    bodies = tmp_path / "bodies.yaml"
    bodies.write_text(BODIES)
    nodes = chain(
        simulated(CYCLES, **TWO_GEARS),
        calibration=calibration,
        bodies=str(bodies),
        output=str(tmp_path / "bag"),
        recorded=("frame_info", "truth", "localizations", "pose_6dof", "pose", "pose_with_covariance"),
        arrangement=arrangement,
    )
    lines: list[str] = []
    with run_system(nodes, on_line=lines.append) as system:
        system.wait(nodes[0].executable, timeout=PATIENCE)
        codes = system.stop()
    assert not any(codes.values()), "\n".join(lines)
    assert check_bag(tmp_path / "bag").problems == []

    with BagReader(tmp_path / "bag") as bag:
        names = {f"/{topic}" for topic in pose_topics(["load_gear", "ring_gear"])}
        assert names <= bag.topics.keys()
        assert {bag.counts[topic] for topic in names} == {CYCLES}
        relative = [recorded.message for recorded in bag.messages(["/ring_gear/relative_pose"])]
    recording = load_recording(tmp_path / "bag")
    pairs = list(zip(recording.poses["ring_gear"], recording.poses["load_gear"], strict=True))
    for message, (ring, load) in zip(relative, pairs, strict=True):
        pose, covariance = relative_pose(ring, load)
        point = message.pose.pose.position
        assert message.header.frame_id == "load_gear"
        np.testing.assert_allclose([point.x, point.y, point.z], pose.translation, rtol=0, atol=1e-15)
        np.testing.assert_allclose(message.pose.covariance, covariance.ravel(), rtol=1e-9)

    # The same localizations give the same poses offline, and both are as good as they claim.
    again = load_bodies(bodies)
    for stamp, found in sorted(recording.localizations.items()):
        for pose in again.update(found):
            live = next(p for p in recording.poses[pose.body] if p.stamp_ns == stamp)
            np.testing.assert_allclose(live.displacement, pose.displacement, rtol=0, atol=1e-12)
    for poses in recording.poses.values():
        truths = [truth for truth in recording.truth_of(poses) if truth is not None]
        assert 0.4 < compare(poses, truths).nees_per_dof < 2


def test_a_field_correction_is_saved_for_the_next_session(
    tmp_path: Path, calibration: str, peer: Peer, start: Callable[..., NodeProcess]
) -> None:
    """What the node has learnt becomes a calibration; localizations by another one are refused."""
    corrected = tmp_path / "corrected.yaml"
    parameters = {"calibration": calibration, "field_correction": corrected}
    arguments = [part for item in parameters.items() for part in ("-p", "{}:={}".format(*item))]
    node = start("pose_estimator", *arguments)
    publisher = peer.publisher(LocalizationsMessage, "localizations")
    peer.listen(Pose6DOF, "pose_6dof")
    answer = peer.call(Trigger, "pose_estimator/save_field_correction")
    assert (answer.success, "no cycle yet" in answer.message) == (False, True)

    optics = load_calibration(calibration)
    gear = SyntheticGear(Scene(field=(65e-6, 65e-6), radius=30e-6, particles=40, field_error_xy=3e-9), 1)
    for count in range(1, 25):
        found = replace(gear.observe()[0], calibration_id=optics.calibration_id)
        publisher.publish(messages.to_rclpy(messages.localizations(found)))
        peer.wait(lambda count=count: len(peer.received["pose_6dof"]) == count)
        gear.advance()
    answer = peer.call(Trigger, "pose_estimator/save_field_correction")
    assert answer.success, answer.message
    written = load_calibration(corrected)
    assert written.calibration_id in answer.message
    learnt = written.correction.provenance["recordings"][0]
    assert (learnt["recording"], learnt["cycles"]) == ("live, /pose_estimator", 24)
    assert np.trace(written.correction.covariance) < 0.9 * np.trace(
        FieldError.assumed(PoseSettings(), np.array([32.5e-6, 32.5e-6])).prior
    )

    other = replace(gear.observe()[0], calibration_id="another")
    publisher.publish(messages.to_rclpy(messages.localizations(other)))
    node.wait_for_line("by calibration another")
