"""Topics and messages of several bodies."""

from __future__ import annotations

import numpy as np

from mems6dof_ros.analysis.check import check_bag
from mems6dof_ros.analysis.recording import load_recording
from mems6dof_ros.pose.bodies import Bodies, relative_pose
from mems6dof_ros.pose.estimator import PoseEstimator, Region
from mems6dof_ros.pose.synthetic import GearMotion, Scene, SyntheticGear, merged
from mems6dof_ros.recording import messages
from mems6dof_ros.recording.bag import BagReader, BagWriter
from mems6dof_ros.recording.poses import pose_messages, pose_topics

NAMES = ("gear", "coupler")
PLACES = ((-62e-6, 0.0), (62e-6, 0.0))


def gears_and_bodies() -> tuple[list[SyntheticGear], Bodies]:
    scenes = [Scene(particles=30, radius=55e-6, motion=GearMotion(centre=place)) for place in PLACES]
    gears = [
        SyntheticGear(scene, 5 + i, name) for i, (scene, name) in enumerate(zip(scenes, NAMES, strict=True))
    ]
    regions = [Region(place, 61e-6) for place in PLACES]
    return gears, Bodies([PoseEstimator(None, n, r) for n, r in zip(NAMES, regions, strict=True)])


def test_the_first_body_has_the_usual_topics_and_further_ones_their_own():
    assert list(pose_topics(NAMES[:1])) == ["pose_6dof", "pose", "pose_with_covariance"]
    further = ["coupler/pose_6dof", "coupler/pose", "coupler/pose_with_covariance", "coupler/relative_pose"]
    assert list(pose_topics(NAMES)) == [*pose_topics(NAMES[:1]), *further]
    gears, bodies = gears_and_bodies()
    poses = bodies.update(merged([gear.observe()[0] for gear in gears], 1)[0])
    said = dict(pose_messages(poses))
    assert list(said) == list(pose_topics(NAMES))
    assert {topic: message.type for topic, message in said.items()} == pose_topics(NAMES)
    relative = messages.to_rosbags(said["coupler/relative_pose"])
    pose, covariance = relative_pose(poses[1], poses[0])
    assert relative.header.frame_id == "gear"
    assert messages.nanoseconds(relative.header.stamp) == poses[1].stamp_ns
    assert relative.pose.pose.position.x == pose.translation[0]
    np.testing.assert_array_equal(relative.pose.covariance.reshape(6, 6), covariance)


def test_a_body_that_is_lost_says_so_and_nothing_else():
    gears, bodies = gears_and_bodies()
    bodies.update(merged([gear.observe()[0] for gear in gears], 1)[0])
    gears[0].advance()
    poses = bodies.update(gears[0].observe()[0])  # the coupler has gone
    assert [pose.valid for pose in poses] == [True, False]
    assert [topic for topic, _ in pose_messages(poses)] == [*pose_topics(NAMES[:1]), "coupler/pose_6dof"]


def test_a_recording_of_both_is_whole_unless_one_is_missing(tmp_path):
    gears, bodies = gears_and_bodies()
    frame_info = {
        "frames_dropped": 0,
        "device_time_ns": 0,
        "publication_time": messages.time(0),
        "exposure": 0.0,
    }
    frame_info |= {"stage_z": 0.0, "pixel_size": 1e-7, "saturation_adu": 0, "source": "test", "live": False}
    for name, silent in (("whole", None), ("missing", 3)):
        with BagWriter(tmp_path / name) as bag:
            for count in range(1, 6):
                for gear in gears:
                    gear.advance()
                found = merged([gear.observe()[0] for gear in gears], count)[0]
                header = messages.header(found.stamp_ns, found.frame_id)
                counters = {"header": header, "frame_counter": found.frame_counter, "cycle": found.cycle}
                info = messages.Message("mems6dof_msgs/msg/FrameInfo", counters | frame_info)
                bag.write_message("/frame_info", info, found.stamp_ns)
                for topic, message in pose_messages(bodies.update(found)):
                    if count != silent or topic != "coupler/pose_6dof":
                        bag.write_message(f"/{topic}", message, found.stamp_ns)
        problems = check_bag(tmp_path / name).problems
        assert problems == ([] if silent is None else ["/coupler/pose_6dof: missing for 1 of 5 frames"])
    assert {body: len(poses) for body, poses in load_recording(tmp_path / "whole").poses.items()} == {
        "gear": 5,
        "coupler": 5,
    }
    with BagReader(tmp_path / "whole") as bag:
        assert bag.counts["/coupler/relative_pose"] == 5
