"""The chain of four processes, as the tables describe it."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import rclpy
import tifffile
import yaml
from peers import PATIENCE, SMALL_GEAR, alive, own_domain, wait_until
from rclpy.context import Context
from rclpy.node import Node

from mems6dof_ros.calibration.file import load_calibration
from mems6dof_ros.errors import InputError
from mems6dof_ros.localization.localizer import Localizer
from mems6dof_ros.nodes.recorder import DEFAULT_TOPICS
from mems6dof_ros.nodes.runner import RunningSystem, command, run_system
from mems6dof_ros.nodes.system import SYSTEMS, NodeSpec, chain, expected, simulated
from mems6dof_ros.pose.cycle_pose import Status
from mems6dof_ros.pose.estimator import PoseEstimator
from mems6dof_ros.recording import messages
from mems6dof_ros.recording.bag import BagReader
from mems6dof_ros.sources.source import frames, open_source

CYCLES = 24


def run_to_the_end(system: RunningSystem) -> dict[str, int]:
    system.wait("frame_source", timeout=PATIENCE)
    return system.stop()


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory, calibration: str) -> tuple[Path, dict[str, int], str]:
    """A recorded run with its images: directory, exit codes, output."""
    path = tmp_path_factory.mktemp("system") / "bag"
    lines: list[str] = []
    with pytest.MonkeyPatch.context() as patch, own_domain() as domain:
        patch.setenv("ROS_DOMAIN_ID", str(domain))
        nodes = chain(
            simulated(CYCLES, **SMALL_GEAR),
            calibration=calibration,
            output=str(path),
            recorded=(*DEFAULT_TOPICS, "image_raw"),
        )
        with run_system(nodes, on_line=lines.append) as system:
            codes = run_to_the_end(system)
    return path, codes, "\n".join(lines)


def test_every_frame_becomes_a_recorded_pose(recording: tuple[Path, dict[str, int], str]) -> None:
    path, codes, output = recording
    assert codes == dict.fromkeys(("frame_source", "localizer", "pose_estimator", "recorder"), 0), output
    assert "Traceback" not in output
    with BagReader(path) as bag:
        counts = {topic: number for topic, number in bag.counts.items() if topic != "/diagnostics"}
        poses = [recorded.message for recorded in bag.messages(["/pose_6dof"])]
    assert counts == dict.fromkeys(
        (
            "/image_raw",
            "/camera_info",
            "/frame_info",
            "/truth",
            "/localizations",
            "/pose_6dof",
            "/pose",
            "/pose_with_covariance",
        ),
        CYCLES,
    )
    assert [pose.cycle for pose in poses] == list(range(1, CYCLES + 1))
    assert {pose.status for pose in poses} == {Status.TRACKING}


def test_headers_are_the_frames_own(recording: tuple[Path, dict[str, int], str]) -> None:
    headers: dict[str, set[tuple[int, str]]] = {}
    with BagReader(recording[0]) as bag:
        for recorded in bag.messages():
            if recorded.topic != "/diagnostics":
                header = recorded.message.header
                stamp = messages.nanoseconds(header.stamp)
                headers.setdefault(recorded.topic, set()).add((stamp, header.frame_id))
    of_images = headers.pop("/image_raw")
    assert len(of_images) == CYCLES
    assert all(others == of_images for others in headers.values())


def test_poses_follow_the_truth(recording: tuple[Path, dict[str, int], str]) -> None:
    with BagReader(recording[0]) as bag:
        poses = {r.message.cycle: r.message for r in bag.messages(["/pose_6dof"])}
        truth = {r.message.cycle: r.message for r in bag.messages(["/truth"])}
    error = np.array([poses[k].psi - (truth[k].psi - truth[1].psi) for k in sorted(poses)])
    # 17 particles of 2 nm at 20 um: 25 urad each, and the first frame, the reference, as much again.
    assert np.sqrt(np.mean(error**2)) < 100e-6


def test_latency_is_stated_per_stage(recording: tuple[Path, dict[str, int], str]) -> None:
    stages = ("frame_transport", "queue", "localization", "localization_transport", "pose")
    with BagReader(recording[0]) as bag:
        for pose in (recorded.message for recorded in bag.messages(["/pose_6dof"])):
            parts = [getattr(pose, f"latency_{stage}") for stage in stages]
            assert all(part >= 0 for part in parts)
            assert sum(parts) == pytest.approx(pose.latency_total, abs=1e-6)
            assert np.isnan(pose.latency_capture)  # simulated ahead of time


def test_nodes_give_what_the_core_gives(
    recording: tuple[Path, dict[str, int], str], calibration: str
) -> None:
    """Offline, over the recorded images: the same numbers, a picometre and a picoradian at most apart.

    Not the same bits: threads of the linear algebra sum in another order.
    """
    optics = load_calibration(calibration)
    localizer, estimator = Localizer(optics.camera, optics), PoseEstimator()
    offline = {}
    for frame in frames(open_source("bag", path=recording[0])):
        pose = estimator.update(localizer.localize(frame))
        offline[pose.stamp_ns] = pose
    with BagReader(recording[0]) as bag:
        live = [messages.to_cycle_pose(recorded.message) for recorded in bag.messages(["/pose_6dof"])]
    assert len(live) == len(offline) == CYCLES
    for pose in live:
        same = offline[pose.stamp_ns]
        np.testing.assert_allclose(pose.displacement, same.displacement, rtol=0, atol=1e-12)
        np.testing.assert_allclose(
            pose.displacement_covariance, same.displacement_covariance, rtol=1e-6, atol=0
        )
        assert (pose.particle_id == same.particle_id).all()


def test_calibration_and_parameters_travel_with_the_record(
    recording: tuple[Path, dict[str, int], str], calibration: str
) -> None:
    with BagReader(recording[0]) as bag:
        assert bag.attachments()["optics.yaml"] == Path(calibration).read_bytes()
        assert "image_raw" in bag.provenance()["topics"]


def test_two_instances_in_one_domain(calibration: str, tmp_path: Path) -> None:
    names, cycles = ("left", "right"), 8
    lines: list[str] = []

    def nodes(k: int) -> list:
        source = simulated(cycles, seed=1 + k, **SMALL_GEAR)
        return chain(source, calibration=calibration, output=str(tmp_path / names[k]))

    with (
        run_system(nodes(0), namespace=names[0], on_line=lines.append) as left,
        run_system(nodes(1), namespace=names[1], on_line=lines.append) as right,
    ):
        codes = [*run_to_the_end(left).values(), *run_to_the_end(right).values()]
    assert codes == [0] * 8, lines
    turned = []
    for name in names:
        with BagReader(tmp_path / name) as bag:
            assert {topic for topic in bag.counts if not topic.startswith(f"/{name}/")} <= {"/diagnostics"}
            poses = [recorded.message for recorded in bag.messages([f"/{name}/pose_6dof"])]
        assert [pose.cycle for pose in poses] == list(range(1, cycles + 1))
        assert {pose.status for pose in poses} == {Status.TRACKING}
        turned.append(poses[-1].psi)
    assert turned[0] != turned[1]  # two gears, not one heard twice


def test_a_failing_node_ends_the_wait_and_the_others(tmp_path: Path) -> None:
    lines: list[str] = []
    nodes = chain(simulated(3, **SMALL_GEAR), calibration=str(tmp_path / "absent.yaml"))
    with run_system(nodes, on_line=lines.append) as system:
        ended = system.wait("frame_source", timeout=PATIENCE)
        pids = [process.pid for process in system.processes.values()]
    # Both read the calibration, and whichever is first ends the others.
    assert set(ended) <= {"localizer", "pose_estimator"}
    assert set(ended.values()) == {1}
    assert any("absent.yaml" in line and "] error:" in line for line in lines)
    assert not any(map(alive, pids))


def test_nodes_do_not_survive_a_killed_runner(tmp_path: Path) -> None:
    script = tmp_path / "runner.py"
    script.write_text(
        "import json, time\n"
        "from mems6dof_ros.nodes.runner import run_system\n"
        "from mems6dof_ros.nodes.system import NodeSpec\n"
        "nodes = [NodeSpec('pose_estimator'), NodeSpec('recorder', {'start_paused': True})]\n"
        "with run_system(nodes) as system:\n"
        "    print(json.dumps([p.pid for p in system.processes.values()]), flush=True)\n"
        "    time.sleep(600)\n"
    )
    runner = subprocess.Popen(
        [sys.executable, str(script)], stdout=subprocess.PIPE, text=True, env=_with_path()
    )
    assert runner.stdout is not None
    pids = json.loads(runner.stdout.readline())
    seen: list[str] = []
    while not {"[pose_estimator] INFO ready", "[recorder] INFO stopped"} <= set(seen):
        seen.append(runner.stdout.readline().rstrip())
    assert all(map(alive, pids))
    runner.send_signal(signal.SIGKILL)
    runner.wait()
    runner.stdout.close()
    wait_until(lambda: not any(map(alive, pids)))


def _with_path() -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": os.pathsep.join(p or os.getcwd() for p in sys.path)}


@pytest.mark.parametrize("name", [name for name in SYSTEMS if name != "calibrate"])
def test_tables_are_complete(name: str) -> None:
    """Every argument is used, and every node waits for exactly those who listen to it."""
    system = SYSTEMS[name]
    table = system.table({"calibration": "c.yaml", "output": "out"})
    by_name = {node.executable: node.parameters for node in table}
    controlled = ["controller"] if name == "closed_loop" else []
    assert list(by_name) == ["frame_source", "localizer", "pose_estimator", *controlled, "recorder"]
    waits = {name: set(values.get("wait_for_subscribers", ())) for name, values in by_name.items()}
    assert waits["localizer"] == {"localizations:pose_estimator", "localizations:recorder"}
    poses = {"pose_6dof:recorder", "pose:recorder", "pose_with_covariance:recorder"}
    if "acknowledged_by" in by_name["frame_source"]:
        poses.add("pose_6dof:frame_source")
    assert waits["pose_estimator"] == poses | {f"pose_6dof:{name}" for name in controlled}
    assert {"image_raw:localizer", "frame_info:localizer", "frame_info:recorder"} < waits["frame_source"]
    with pytest.raises(InputError, match="'bagg'"):
        system.table({"bagg": "x"})


def test_a_replay_is_told_how(tmp_path: Path) -> None:
    (tmp_path / "a.mcap").touch()
    values = {"recording": str(tmp_path / "a.mcap"), "speed": "2", "begin": "1.5", "loop": "true"}
    source = SYSTEMS["replay"].table({**values, "publish_clock": "true"})[0].parameters
    assert {"speed": 2.0, "begin": 1.5, "loop": True, "publish_clock": True}.items() <= source.items()
    assert "start_paused" not in source  # left to a parameter file
    assert source["pacing"] == "consumer"  # nothing is lost, however fast


def _stack(path: Path, images: list[np.ndarray]) -> Path:
    tifffile.imwrite(path / "stack.ome.tif", np.array(images), metadata={"axes": "TYX"})
    return path / "stack.ome.tif"


def _folder(path: Path, images: list[np.ndarray]) -> Path:
    (path / "folder").mkdir()
    for k, image in enumerate(images):
        cv2.imwrite(str(path / "folder" / f"{k}.png"), image)
    return path / "folder"


def _video(path: Path, images: list[np.ndarray]) -> Path:
    height, width = images[0].shape
    grey = [cv2.VIDEOWRITER_PROP_DEPTH, cv2.CV_16U, cv2.VIDEOWRITER_PROP_IS_COLOR, 0]
    codec = int.from_bytes(b"FFV1", "little")
    writer = cv2.VideoWriter(str(path / "a.mkv"), cv2.CAP_FFMPEG, codec, 25.0, (width, height), grey)
    for image in images:
        writer.write(image)
    writer.release()
    return path / "a.mkv"


@pytest.mark.parametrize(
    ("write", "arrangement"),
    [(_stack, "processes"), (_folder, "pipeline"), (_video, "pipeline"), (None, "pipeline")],
)
def test_any_recording_is_replayed_by_its_path(
    recording: tuple[Path, dict[str, int], str],
    calibration: str,
    tmp_path: Path,
    write: Callable[[Path, list[np.ndarray]], Path] | None,
    arrangement: str,
) -> None:
    """By the command: the same pixels in other files (None: the bag) give the poses recorded live."""
    images = [frame.image for frame in frames(open_source("bag", path=recording[0]))]
    values = {
        "recording": write(tmp_path, images) if write else recording[0],
        "calibration": calibration,
        "output": tmp_path / "bag",
        "arrangement": arrangement,
    }
    words = [f"{name}:={value}" for name, value in values.items()]
    command = [sys.executable, "-m", "mems6dof_ros.nodes.runner", "replay", *words]
    done = subprocess.run(command, capture_output=True, text=True, env=_with_path(), timeout=PATIENCE)
    assert done.returncode == 0, done.stdout + done.stderr
    with BagReader(recording[0]) as bag:
        live = [messages.to_cycle_pose(recorded.message) for recorded in bag.messages(["/pose_6dof"])]
    with BagReader(tmp_path / "bag") as bag:
        replayed = [messages.to_cycle_pose(recorded.message) for recorded in bag.messages(["/pose_6dof"])]
    assert len(replayed) == CYCLES
    for pose, same in zip(replayed, live, strict=True):
        np.testing.assert_allclose(pose.displacement, same.displacement, rtol=0, atol=1e-12)


def test_a_recording_that_cannot_be_is_one_clear_error(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"absent: found nothing there; expected a bag, TIFF stack, folder"):
        SYSTEMS["replay"].table({"recording": str(tmp_path / "absent")})
    with pytest.raises(InputError, match=r"argument topic: found '/image' of .*; expected none"):
        SYSTEMS["replay"].table({"recording": str(tmp_path), "topic": "/image"})


@pytest.mark.parametrize(
    ("system", "argument", "value", "expected"),
    [
        ("replay", "speed", "fast", "a number"),
        ("replay", "loop", "yes", "true or false"),
        ("demo", "size", "2048.0", "a whole number"),
        ("live", "rate", "fast", "a number"),
        ("calibrate", "seed", "x", "a whole number"),
    ],
)
def test_a_wrong_argument_is_one_clear_error(system: str, argument: str, value: str, expected: str) -> None:
    with pytest.raises(InputError, match=rf"argument {argument}: found '{value}'; expected {expected}"):
        SYSTEMS[system].table({argument: value})


def test_a_camera_driver_of_somebody_else() -> None:
    table = SYSTEMS["live"].table({"source": "none", "image_topic": "/camera/image", "calibration": "c.yaml"})
    assert [node.executable for node in table] == ["localizer", "pose_estimator"]
    assert command(table[0])[4:6] == ["-r", "image_raw:=/camera/image"]


def test_live_one_body_is_tracked() -> None:
    def tracking(**values: str) -> list[bool]:
        table = SYSTEMS["live"].table({"calibration": "c.yaml", **values})
        chosen = [node for node in table if node.executable in ("localizer", "pipeline")]
        return [expected(node, "tracking.enabled", "") or False for node in chosen]

    assert tracking() == tracking(arrangement="pipeline") == [True]
    assert tracking(tracking="false") == [False]
    with pytest.raises(InputError, match="argument tracking"):
        tracking(tracking="perhaps")


def taken(table: list[NodeSpec], config: Path) -> dict[str, dict[str, Any]]:
    """What nodes take from their command lines, by executable."""
    found = {}
    for spec in table:
        context = Context()
        rclpy.init(args=command(spec, config=str(config))[3:], context=context)
        node = Node(spec.executable, context=context, automatically_declare_parameters_from_overrides=True)
        found[spec.executable] = {name: node.get_parameter(name).value for name in node._parameters}
        node.destroy_node()
        rclpy.shutdown(context=context)
    return found


def test_a_parameter_file_wins_over_defaults_and_an_argument_over_both(tmp_path: Path) -> None:
    def write(name: str, **values: Any) -> None:
        text = yaml.safe_dump({"/**": {"ros__parameters": values}})
        (tmp_path / f"{name}.yaml").write_text(text)

    def live(**arguments: str) -> dict[str, dict[str, Any]]:
        given = {"calibration": "c.yaml", "output": "out", "config": str(tmp_path), **arguments}
        return taken(SYSTEMS["live"].table(given), tmp_path)

    for name in ("frame_source", "localizer", "pose_estimator", "recorder"):
        write(name, autostart=True)
    by_default = live()
    assert (
        by_default["frame_source"].items() >= {"source": "simulator", "rate": 10.0, "pacing": "rate"}.items()
    )
    assert (
        by_default["localizer"].items() >= {"queue_policy": "drop_oldest", "tracking.enabled": True}.items()
    )
    assert by_default["recorder"]["topics"] == list(DEFAULT_TOPICS)

    write("frame_source", source="basler", rate=90.0)
    write("localizer", queue_policy="block", tracking={"enabled": False})
    write("recorder", topics=["pose_6dof", "image_raw"], compression="zstd")
    by_file = live()
    assert by_file["frame_source"].items() >= {"source": "basler", "rate": 90.0}.items()
    assert by_file["localizer"].items() >= {"queue_policy": "block", "tracking.enabled": False}.items()
    assert by_file["pose_estimator"]["queue_policy"] == "drop_oldest"
    assert (
        by_file["recorder"].items() >= {"topics": ["pose_6dof", "image_raw"], "compression": "zstd"}.items()
    )
    # Nobody waits for what is not recorded.
    assert by_file["pose_estimator"]["wait_for_subscribers"] == ["pose_6dof:recorder"]
    assert "image_raw:recorder" in by_file["frame_source"]["wait_for_subscribers"]

    told = live(source="images", rate="10.0", tracking="true")
    assert told["frame_source"].items() >= {"source": "images", "rate": 10.0}.items()
    assert told["localizer"]["tracking.enabled"]

    calibrating = SYSTEMS["calibrate"].table({"config": str(tmp_path)})
    write("calibrator", autostart=True)
    assert taken(calibrating, tmp_path)["frame_source"].items() >= {"source": "basler", "rate": 90.0}.items()
    assert not calibrating[1].parameters  # the noise of another camera


def test_images_are_recorded_where_it_is_told(tmp_path: Path) -> None:
    def topics(**arguments: str) -> list[str]:
        table = SYSTEMS["demo"].table({"calibration": "c.yaml", "output": "out", **arguments})
        assert ("image_raw:recorder" in table[0].parameters["wait_for_subscribers"]) == bool(arguments)
        return expected(table[-1], "topics", arguments.get("config", ""))

    assert topics() == list(DEFAULT_TOPICS)
    assert topics(record_images="true") == [*DEFAULT_TOPICS, "image_raw"]
    (tmp_path / "recorder.yaml").write_text("recorder: {ros__parameters: {topics: [image_raw, pose]}}")
    assert topics(record_images="true", config=str(tmp_path)) == ["image_raw", "pose"]
    for nonsense in (
        "topics",
        "recorder: 1",
        "recorder: {topics: [pose]}",
        "- pose",
        "{",
    ):  # the recorder refuses it
        (tmp_path / "recorder.yaml").write_text(nonsense)
        assert topics(record_images="true", config=str(tmp_path)) == [*DEFAULT_TOPICS, "image_raw"]


def test_calibrating_needs_no_localizer() -> None:
    system = SYSTEMS["calibrate"]
    assert [node.executable for node in system.table({})] == ["frame_source", "calibrator"]
    driver = {"source": "none", "image_topic": "/camera/image"}
    (calibrator,) = system.table(driver)
    assert calibrator.remappings == {"image_raw": "/camera/image"}
