"""Each node alone: what it refuses, what it survives, how it ends."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import tifffile
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from peers import SMALL_GEAR, NodeProcess, Peer
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import DescribeParameters, SetParameters
from sensor_msgs.msg import Image, PointCloud2
from std_msgs.msg import String
from std_srvs.srv import Trigger

from mems6dof_msgs.msg import FrameInfo, Localizations, Pose6DOF
from mems6dof_ros.frame import Frame
from mems6dof_ros.recording import messages
from mems6dof_ros.recording.bag import BagReader
from mems6dof_ros.simulation.experiment import motion_frames
from mems6dof_ros.simulation.settings import SimulationSettings

Start = Callable[..., NodeProcess]

SMALL = [f"simulator.{name}:={value}" for name, value in SMALL_GEAR.items()]


def parameters(*assignments: str) -> list[str]:
    """For the command line of a node."""
    return [word for assignment in assignments for word in ("-p", assignment)]


def stamp(message: object) -> int:
    return messages.nanoseconds(message.header.stamp)


@pytest.fixture(scope="module")
def micrographs() -> list[Frame]:
    return list(motion_frames(SimulationSettings(**SMALL_GEAR), 4))


# What is refused at the start ----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("executable", "assignments", "reason"),
    [
        ("frame_source", ["rate:=.nan"], "parameter rate: found nan; expected 0 to 10000"),
        ("frame_source", ["rate:=10"], "parameter rate: found 10; expected a number with a decimal point"),
        ("frame_source", ["rat:=10.0"], "parameters: found unknown 'rat'; expected 'rate'"),
        ("frame_source", ["source:=tape"], "parameter source: found 'tape'; expected one of simulator"),
        ("frame_source", ["source:=bag"], "parameter bag.path: found no path"),
        ("frame_source", ["source:=images", "images.path:=absent.tif"], "absent.tif: found nothing there"),
        ("frame_source", ["simulator.clumps:=500"], "clumps: found 500; expected fewer"),
        (
            "frame_source",
            ["wait_for_subscribers:=[image_raw]"],
            "found 'image_raw'; expected topic:node or topic:number",
        ),
        ("localizer", ["calibration:=absent.yaml"], "absent.yaml: found"),
        ("localizer", [], "found neither a value nor a calibration"),
        ("localizer", ["detection.threshold:=.nan"], "detection.threshold: found nan; expected finite"),
        ("pose_estimator", ["gates:=[1.0e-6, 2.0e-6]"], "gates: found"),
        ("recorder", ["compression:=zip"], "parameter compression: found 'zip'; expected one of"),
        ("recorder", ["attachments:=[absent.yaml]"], "found no file 'absent.yaml'"),
    ],
)
def test_bad_parameters_are_refused_in_one_line(
    start: Start, tmp_path: Path, executable: str, assignments: list[str], reason: str
) -> None:
    if executable == "recorder":
        assignments = [*assignments, f"output:={tmp_path / 'bag'}"]
    node = start(executable, *parameters(*assignments))
    assert node.wait() == 1
    assert node.lines[-1].startswith("error: ")
    assert reason in node.lines[-1]
    assert "Traceback" not in node.output


def test_a_broken_parameter_file_is_refused(start: Start, tmp_path: Path) -> None:
    path = tmp_path / "broken.yaml"
    path.write_text("/**:\n  ros__parameters: {rate: [")
    node = start("frame_source", "--params-file", str(path))
    assert node.wait() == 1
    assert str(path) in node.lines[-1]
    assert "Traceback" not in node.output


def test_a_damaged_calibration_is_refused(start: Start, calibration: str, tmp_path: Path) -> None:
    path = tmp_path / "damaged.yaml"
    path.write_text(Path(calibration).read_text().replace("window_px: 31", "window_px: 33"))
    node = start("localizer", *parameters(f"calibration:={path}"))
    assert node.wait() == 1
    assert str(path) in node.lines[-1]
    assert "Traceback" not in node.output


# How it ends --------------------------------------------------------------------------------------


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_end_every_node_in_good_order(
    start: Start, calibration: str, tmp_path: Path, number: int
) -> None:
    nodes = {
        "active": start("frame_source"),
        "ready": start("pose_estimator"),
        "recording": start("recorder", *parameters(f"output:={tmp_path / 'bag'}")),
        "localizer]: ready": start("localizer", *parameters(f"calibration:={calibration}")),
    }
    for line, node in nodes.items():
        node.wait_for_line(line)
    begin = time.monotonic()
    assert [node.stop(number) for node in nodes.values()] == [0] * 4
    assert time.monotonic() - begin < 30
    assert not any("Traceback" in node.output for node in nodes.values())


# Parameters and diagnostics --------------------------------------------------------------------------


def test_parameters_are_described_and_checked_at_run_time(start: Start, peer: Peer) -> None:
    start("frame_source")
    answer = peer.call(
        DescribeParameters,
        "frame_source/describe_parameters",
        DescribeParameters.Request(names=["rate", "pacing"]),
    )
    rate, pacing = answer.descriptors
    assert rate.description.endswith("[Hz]")
    assert rate.floating_point_range[0].to_value == 10_000
    assert not rate.additional_constraints.endswith("unconfigured")
    assert pacing.additional_constraints == "one of rate, consumer, step; set while unconfigured"

    def set_rate(value: float) -> tuple[bool, str]:
        double = ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=value)
        request = SetParameters.Request(parameters=[Parameter(name="rate", value=double)])
        result = peer.call(SetParameters, "frame_source/set_parameters", request).results[0]
        return result.successful, result.reason

    assert set_rate(50.0) == (True, "")
    assert not set_rate(-1.0)[0]
    successful, reason = set_rate(float("nan"))
    assert not successful
    assert "nan" in reason


# Frames that cannot be measured -------------------------------------------------------------------------


def test_bad_frames_are_refused_and_the_next_one_is_measured(
    start: Start, peer: Peer, calibration: str, micrographs: list[Frame]
) -> None:
    """A camera that publishes images alone: each gives localizations, empty ones with a reason."""
    peer.listen(Localizations, "localizations")
    peer.listen(PointCloud2, "localizations/points")
    peer.listen(DiagnosticArray, "/diagnostics")
    node = start(
        "localizer", *parameters(f"calibration:={calibration}", "wait_for_subscribers:=['localizations:1']")
    )
    images = peer.publisher(Image, "image_raw")
    good = [messages.to_rclpy(messages.image(frame)) for frame in micrographs]
    bad = {}
    for k, (name, change) in enumerate(
        {
            "rgb8": {"encoding": "rgb8"},
            "empty image": {"height": 0, "width": 0, "step": 0, "data": []},
            "step": {"step": 10},
            "rows": {"data": bytes(100)},
            "512 x 256": {"height": 256, "data": bytes(512 * 256 * 2)},
        }.items()
    ):
        message = messages.to_rclpy(messages.image(micrographs[0]))
        message.header.stamp.nanosec += 1000 + k  # between two good ones
        for field, value in change.items():
            setattr(message, field, value)
        bad[name] = message
    saturated = messages.to_rclpy(messages.image(micrographs[0]))
    saturated.header.stamp.nanosec += 2000
    saturated.data = bytes([255]) * len(saturated.data)

    sent = [good[0], *bad.values(), saturated, good[1]]
    for message in sent:
        images.publish(message)
    peer.wait(lambda: len(peer.received["localizations"]) == len(sent))
    found = peer.received["localizations"]
    assert [stamp(message) for message in found] == [stamp(message) for message in sent]
    assert [message.cycle for message in found] == list(range(len(sent)))  # counted by the localizer
    numbers = [len(message.x) for message in found]
    assert numbers[0] > 10
    assert numbers[-1] > 10
    assert numbers[1 : 1 + len(bad)] == [0] * len(bad)
    usable = [flags for flags in found[-2].flags if flags == 0]
    assert usable == []  # all saturated: nothing to trust
    for name in bad:
        assert name in node.output, node.output
    assert "Traceback" not in node.output
    peer.wait(
        lambda: any(
            s.level == DiagnosticStatus.ERROR for m in peer.received["/diagnostics"] for s in m.status
        )
    )

    clouds = peer.received["localizations/points"]
    peer.wait(lambda: clouds and clouds[-1].header == found[-1].header)
    cloud = clouds[-1]
    points = np.frombuffer(
        cloud.data, dtype=[(f.name, "<u4" if f.name == "flags" else "<f4") for f in cloud.fields]
    )
    np.testing.assert_allclose(points["x"], found[-1].x, rtol=1e-6)
    assert cloud.width == len(found[-1].x)


def test_frames_lost_on_the_way_are_counted(
    start: Start, peer: Peer, calibration: str, micrographs: list[Frame]
) -> None:
    peer.listen(Localizations, "localizations")
    start(
        "localizer", *parameters(f"calibration:={calibration}", "wait_for_subscribers:=['localizations:1']")
    )
    infos, images = peer.publisher(FrameInfo, "frame_info"), peer.publisher(Image, "image_raw")
    for frame in (micrographs[0], micrographs[3]):
        images.publish(messages.to_rclpy(messages.image(frame)))  # the image may come first
        infos.publish(messages.to_rclpy(messages.frame_info(frame)))
    peer.wait(lambda: len(peer.received["localizations"]) == 2)
    first, second = peer.received["localizations"]
    assert (first.frame_counter, first.frames_dropped) == (micrographs[0].frame_counter, 0)
    assert (second.frame_counter, second.frames_dropped) == (micrographs[3].frame_counter, 2)
    assert second.cycle == micrographs[3].cycle


def test_a_lost_pose_says_so_and_publishes_no_pose(start: Start, peer: Peer) -> None:
    for kind, topic in ((Pose6DOF, "pose_6dof"), (PoseStamped, "pose")):
        peer.listen(kind, topic)
    start("pose_estimator", *parameters("wait_for_subscribers:=['pose_6dof:1', 'pose:1']"))
    localizations = peer.publisher(Localizations, "localizations")
    localizations.publish(Localizations(frame_counter=1, cycle=1))
    peer.wait(lambda: peer.received["pose_6dof"])
    pose = peer.received["pose_6dof"][0]
    assert pose.status in (Pose6DOF.STATUS_INITIALIZING, Pose6DOF.STATUS_LOST)
    assert pose.reason
    assert np.isnan([pose.dx, pose.psi, pose.pose.pose.position.x, pose.pose.pose.orientation.w]).all()
    answer = peer.call(Trigger, "pose_estimator/set_reference")
    assert not answer.success
    assert "no valid pose" in answer.message
    assert peer.call(Trigger, "pose_estimator/reset").success
    assert not peer.received["pose"]


# The source ----------------------------------------------------------------------------------------


def test_consumer_pacing_never_exceeds_its_window_and_loses_nothing(start: Start, peer: Peer) -> None:
    """A consumer slower than the source: it sees every frame, and never more than the window ahead."""
    frames, window = 30, 3
    acknowledged: list[int] = []
    ahead: list[int] = []
    peer.listen(
        Image, "image_raw", lambda _: ahead.append(len(peer.received["image_raw"]) + 1 - len(acknowledged))
    )
    node = start(
        "frame_source",
        *parameters(*SMALL, f"simulator.cycles:={frames}", "pacing:=consumer", f"window:={window}"),
    )
    localizations = peer.publisher(Localizations, "localizations")
    for k in range(frames):
        peer.wait(lambda k=k: len(peer.received["image_raw"]) > k)
        acknowledged.append(k)
        localizations.publish(Localizations(header=peer.received["image_raw"][k].header))
        time.sleep(0.01)
    assert node.wait() == 0
    assert len(peer.received["image_raw"]) == frames
    assert max(ahead) <= window
    assert f"{frames} frames published, 0 refused, 0 lost" in node.output


def test_a_frame_that_nobody_acknowledges_is_counted_and_left_behind(start: Start, peer: Peer) -> None:
    peer.listen(Image, "image_raw")
    node = start(
        "frame_source",
        *parameters(
            *SMALL, "simulator.cycles:=2", "pacing:=consumer", "window:=1", "acknowledge_timeout:=0.2"
        ),
    )
    assert node.wait() == 0
    assert len(peer.received["image_raw"]) == 2
    assert "2 frames published, 0 refused, 2 lost" in node.output


def test_start_stop_and_step(start: Start, peer: Peer) -> None:
    peer.listen(Image, "image_raw")
    node = start(
        "frame_source",
        *parameters(*SMALL, "simulator.cycles:=3", "start_paused:=true", "at_end:=idle", "rate:=1000.0"),
    )
    node.wait_for_line("stopped")
    images = peer.received["image_raw"]
    assert not images
    for number in (1, 2):
        assert peer.call(Trigger, "frame_source/step").success
        peer.wait(lambda number=number: len(images) == number)
    assert peer.call(Trigger, "frame_source/start").success
    node.wait_for_line("ended")
    peer.wait(lambda: len(images) == 3)
    assert not peer.call(Trigger, "frame_source/step").success
    assert peer.call(Trigger, "frame_source/start").success  # from the first frame again, but later
    peer.wait(lambda: len(images) == 6)
    first = stamp(images[0])
    assert [round((stamp(image) - first) * 1e-9 * 90) for image in images] == [0, 1, 2, 3, 4, 5]
    assert [image.data for image in images[3:]] == [image.data for image in images[:3]]
    assert node.stop() == 0


def test_rate_pacing_keeps_its_rate(start: Start, peer: Peer) -> None:
    arrivals: list[float] = []
    peer.listen(Image, "image_raw", lambda _: arrivals.append(time.monotonic()))
    node = start(
        "frame_source",
        *parameters(*SMALL, "simulator.cycles:=60", "simulator.loop:=4", "rate:=20.0"),
    )
    assert node.wait() == 0
    assert len(arrivals) == 60
    assert 0.98 / 20 < np.mean(np.diff(arrivals)) < 1.5 / 20  # never faster; slower where cores are few


def test_full_frames_arrive_complete(start: Start, peer: Peer, tmp_path: Path) -> None:
    """2048 x 2048 mono16 through the shared-memory profile: every frame, every bit."""
    frames = 30
    pixels = np.random.default_rng(1).integers(0, 2**16, (4, 2048, 2048)).astype(np.uint16)
    tifffile.imwrite(tmp_path / "stack.tif", pixels[np.arange(frames) % 4], photometric="minisblack")
    same: list[bool] = []

    def compare(message: Image) -> None:
        same.append(np.array_equal(messages.image_pixels(message), pixels[len(same) % 4]))
        message.data = b""
        localizations.publish(Localizations(header=message.header))

    node = start(
        "frame_source",
        *parameters("source:=images", f"images.path:={tmp_path / 'stack.tif'}", "pacing:=consumer"),
    )
    localizations = peer.publisher(Localizations, "localizations")
    segments = [path.stat().st_size for path in Path("/dev/shm").glob("fastrtps_*") if path.exists()]
    assert max(segments) >= 128 * 2**20
    peer.listen(Image, "image_raw", compare)
    assert node.wait() == 0
    assert same == [True] * frames
    assert f"{frames} frames published, 0 refused, 0 lost" in node.output


# The recorder ---------------------------------------------------------------------------------------


def test_recorder_starts_stops_and_learns_types(start: Start, peer: Peer, tmp_path: Path) -> None:
    output = tmp_path / "bag"
    node = start(
        "recorder",
        *parameters(f"output:={output}", "topics:=[notes, pose_6dof]", "start_paused:=true"),
    )
    node.wait_for_line("stopped")
    notes, poses = peer.publisher(String, "notes"), peer.publisher(Pose6DOF, "pose_6dof")
    notes.publish(String(data="before"))
    paths = []
    for k in range(2):
        answer = peer.call(Trigger, "recorder/start")
        assert answer.success, answer.message
        paths.append(answer.message)
        assert not peer.call(Trigger, "recorder/start").success
        for number in range(5):
            notes.publish(String(data=f"{k} {number}"))
            poses.publish(Pose6DOF(cycle=number))
        answer = peer.call(Trigger, "recorder/stop")
        assert answer.success, answer.message
    assert not peer.call(Trigger, "recorder/stop").success
    assert node.stop() == 0
    assert paths == [str(output), f"{output}_1"]
    for k, path in enumerate(paths):
        with BagReader(path) as bag:
            assert bag.topics == {"/notes": "std_msgs/msg/String", "/pose_6dof": "mems6dof_msgs/msg/Pose6DOF"}
            texts = [recorded.message.data for recorded in bag.messages(["/notes"])]
        assert texts == [f"{k} {number}" for number in range(5)]
