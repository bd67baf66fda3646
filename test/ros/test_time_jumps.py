"""Simulated time, jumps of it, and sources that begin anew: what the chain makes of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from peers import SMALL_GEAR, NodeProcess, Peer
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Image
from std_srvs.srv import Trigger

from mems6dof_msgs.msg import FrameInfo, Pose6DOF
from mems6dof_ros.frame import Frame
from mems6dof_ros.recording import messages
from mems6dof_ros.simulation.experiment import motion_frames
from mems6dof_ros.simulation.settings import SimulationSettings

Start = Callable[..., NodeProcess]
VALID = (Pose6DOF.STATUS_TRACKING, Pose6DOF.STATUS_DEGRADED)


@pytest.fixture(scope="module")
def micrographs() -> list[Frame]:
    return list(motion_frames(SimulationSettings(**SMALL_GEAR), 7))


class Chain:
    """localizer and pose_estimator, and a source of theirs that is us."""

    def __init__(self, start: Start, peer: Peer, calibration: str, *arguments: str) -> None:
        self._peer = peer
        peer.listen(Pose6DOF, "pose_6dof")
        waits = {"localizer": "localizations:pose_estimator", "pose_estimator": "pose_6dof:peer"}
        arguments = (*arguments, "-p", f"calibration:={calibration}")
        self.nodes = {
            name: start(name, "-p", f"wait_for_subscribers:=['{wait}']", *arguments)
            for name, wait in waits.items()
        }
        self._infos = peer.publisher(FrameInfo, "frame_info")
        self._images = peer.publisher(Image, "image_raw")

    @property
    def poses(self) -> list[Pose6DOF]:
        return self._peer.received["pose_6dof"]

    def measure(self, frames: list[Frame]) -> list[Pose6DOF]:
        """Their poses, one after another."""
        before = len(self.poses)
        for k, frame in enumerate(frames, 1):
            self._infos.publish(messages.to_rclpy(messages.frame_info(frame)))
            self._images.publish(messages.to_rclpy(messages.image(frame)))
            self._peer.wait(lambda k=k: len(self.poses) == before + k)
        return self.poses[before:]


def test_time_that_jumps_back_makes_everything_new(
    start: Start, peer: Peer, calibration: str, micrographs: list[Frame]
) -> None:
    clock = peer.publisher(Clock, "/clock", subscribers=0)
    chain = Chain(start, peer, calibration, "-p", "use_sim_time:=true")  # now() is 0 until the first /clock
    first = chain.measure(micrographs[:2])
    clock.publish(Clock(clock=messages.to_rclpy(messages.time(micrographs[4].stamp_ns))))
    first += chain.measure(micrographs[2:4])
    clock.publish(Clock(clock=messages.to_rclpy(messages.time(micrographs[0].stamp_ns))))
    for node in chain.nodes.values():
        node.wait_for_line("time jumped back by 0.044 s")
    # What was under way when time jumped still belongs to the old one.
    first += chain.measure(micrographs[4:5])
    again = chain.measure(micrographs[:5])
    assert all(pose.status in VALID for pose in first + again)
    assert [pose.cycle for pose in again] == [pose.cycle for pose in first]
    for one, other in zip(first, again, strict=True):
        assert (one.psi, one.dx) == (other.psi, other.dx)
        assert other.reference_version == one.reference_version + 1  # another reference


def test_a_source_that_is_started_again_finds_its_reference(
    start: Start, peer: Peer, calibration: str, micrographs: list[Frame]
) -> None:
    """A camera counts from 0 again: the gear is the same, how far it has turned meanwhile is not known."""
    chain = Chain(start, peer, calibration)
    before = chain.measure(micrographs[:4])
    restarted = [replace(frame, frame_counter=k, cycle=k) for k, frame in enumerate(micrographs[4:])]
    after = chain.measure(restarted)
    assert all(pose.status in VALID for pose in before + after)
    assert [pose.cycle for pose in after] == [0, 1, 2]
    assert {pose.reference_version for pose in before + after} == {1}
    truth = [frame.truth[0].psi - micrographs[0].truth[0].psi for frame in micrographs]
    np.testing.assert_allclose([pose.psi for pose in before + after], truth, atol=3e-4)  # 9 nm at the rim
    assert [pose.increment_cycles for pose in after] == [0, 1, 1]
    assert np.isnan(after[0].increment).all()
    chain.nodes["localizer"].wait_for_line("the source has begun anew")


def test_what_comes_again_or_late_is_refused_and_changes_nothing(
    start: Start, peer: Peer, calibration: str, micrographs: list[Frame]
) -> None:
    chain = Chain(start, peer, calibration)
    poses = chain.measure([micrographs[0], micrographs[2]])
    for frame in (micrographs[2], micrographs[1]):
        chain._infos.publish(messages.to_rclpy(messages.frame_info(frame)))
        chain._images.publish(messages.to_rclpy(messages.image(frame)))
    poses += chain.measure(micrographs[3:5])
    assert [pose.cycle for pose in poses] == [micrographs[k].cycle for k in (0, 2, 3, 4)]
    assert len(chain.poses) == 4
    chain.nodes["localizer"].wait_for_line("arrived again")
    chain.nodes["localizer"].wait_for_line("arrived late")


def test_frame_source_publishes_the_clock_and_loops_onward(start: Start, peer: Peer) -> None:
    peer.listen(Clock, "/clock")
    peer.listen(FrameInfo, "frame_info")
    peer.listen(Image, "image_raw")
    small = [word for name, value in SMALL_GEAR.items() for word in ("-p", f"simulator.{name}:={value}")]
    options = ("simulator.cycles:=3", "loop:=true", "speed:=0.5", "publish_clock:=true", "start_paused:=true")
    node = start("frame_source", *small, *(word for option in options for word in ("-p", option)))
    node.wait_for_line("stopped")
    assert peer.call(Trigger, "frame_source/step").success
    peer.wait(lambda: len(peer.received["frame_info"]) == 1)
    assert peer.call(Trigger, "frame_source/start").success
    peer.wait(lambda: len(peer.received["frame_info"]) >= 8)
    infos, clocks = peer.received["frame_info"][:8], peer.received["/clock"][:8]
    stamps = [messages.nanoseconds(info.header.stamp) for info in infos]
    assert [messages.nanoseconds(clock.clock) for clock in clocks] == stamps
    np.testing.assert_allclose(np.diff(stamps), 1e9 / 90, atol=2)
    assert np.diff([info.cycle for info in infos]).tolist() == [1] * 7
    published = [messages.nanoseconds(info.publication_time) * 1e-9 for info in infos[1:]]
    assert np.diff(published).min() > 0  # the rounds are rendered anew, each in its own time
    assert published[-1] - published[0] > 0.9 * 6 / 90 / 0.5
