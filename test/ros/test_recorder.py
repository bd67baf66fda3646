"""The recorder: files that follow each other, what is attached to them, and the end of the disk."""

from __future__ import annotations

import itertools
import re
import shutil
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import rclpy
import yaml
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from peers import NodeProcess, Peer
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.signals import SignalHandlerOptions
from std_msgs.msg import String
from std_srvs.srv import Trigger

from mems6dof_msgs.msg import Pose6DOF
from mems6dof_ros.analysis.check import check_bag
from mems6dof_ros.nodes import transport
from mems6dof_ros.nodes.recorder import RecorderNode
from mems6dof_ros.recording.bag import BagReader
from mems6dof_ros.recording.validation import disk
from mems6dof_ros.recording.validation.crash import die
from mems6dof_ros.recording.validation.processes import traffic, witnessed_recorder

Start = Callable[..., NodeProcess]


def parameters(*assignments: str) -> list[str]:
    """As ROS arguments."""
    return [part for assignment in assignments for part in ("-p", assignment)]


def test_files_follow_each_other_at_a_call(start: Start, peer: Peer, tmp_path: Path) -> None:
    """With what was latched repeated, and the parameters of who publishes attached to each."""
    peer.node.declare_parameters("", [("exposure", 5e-3), ("lens.name", "20x 0.5"), ("list", [1, 2])])
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    names = [peer.node.create_publisher(String, f"name_{k}", latched) for k in range(2)]
    for k, name in enumerate(names):
        name.publish(String(data=f"before {k}"))
    output = tmp_path / "bag"
    node = start("recorder", *parameters(f"output:={output}", "topics:=[name_0, name_1, pose_6dof]"))
    poses = peer.publisher(Pose6DOF, "pose_6dof")
    peer.wait(lambda: all(name.get_subscription_count() for name in names))
    peer.listen(DiagnosticArray, "/diagnostics")
    peer.wait(lambda: any("disk, MiB left to record" in texts(m) for m in peer.received["/diagnostics"]))
    time.sleep(2.5)  # the recorder asks for parameters in three steps, one per second
    completed = []
    for number in range(3):
        for k in range(5):
            poses.publish(Pose6DOF(cycle=5 * number + k))
        if number == 1:
            names[0].publish(String(data="after"))
        time.sleep(0.5)  # a service does not wait for messages
        if number < 2:
            answer = peer.call(Trigger, "recorder/split")
            assert answer.success, answer.message
            completed.append(answer.message)
    assert node.stop() == 0, node.output
    assert completed == [str(output / f"bag_{k}.mcap") for k in range(2)]
    assert check_bag(output).topics["/pose_6dof"] == ("mems6dof_msgs/msg/Pose6DOF", 15)
    named = [{"before 0", "before 1"}, {"before 0", "after", "before 1"}, {"before 0", "after", "before 1"}]
    for k in range(3):
        with BagReader(output / f"bag_{k}.mcap") as bag:
            cycles = [r.message.cycle for r in bag.messages(["/pose_6dof"])]
            assert {r.message.data for r in bag.messages(["/name_0", "/name_1"])} == named[k]
            attached = bag.attachments()
        assert cycles == list(range(5 * k, 5 * k + 5))
        own = yaml.safe_load(attached["parameters/recorder.yaml"])["/recorder"]["ros__parameters"]
        assert own["output"] == str(output)
        theirs = yaml.safe_load(attached["parameters/peer.yaml"])["/peer"]["ros__parameters"]
        assert (theirs["exposure"], theirs["lens.name"], theirs["list"]) == (5e-3, "20x 0.5", [1, 2])


def texts(message: DiagnosticArray) -> dict[str, str]:
    """What the recorder says in it."""
    return {
        value.key: value.value
        for status in message.status
        if status.name == "recorder"
        for value in status.values
    }


def test_without_room_it_does_not_begin(start: Start, tmp_path: Path) -> None:
    node = start("recorder", *parameters(f"output:={tmp_path / 'bag'}", "minimum_free_mebibytes:=1000000000"))
    assert node.wait() == 1
    (line,) = [line for line in node.lines if "error" in line]
    assert re.search(r"bag: found \d+ MiB left on its disk; expected 1000000000 MiB", line)


def test_a_disk_that_fills_up_is_told_in_time(start: Start, peer: Peer, tmp_path: Path) -> None:
    """2 GiB are left, for years without traffic, for a quarter of an hour at 2 MB/s."""
    (tmp_path / "bag").mkdir()
    kept = (shutil.disk_usage(tmp_path).free >> 20) - 2048
    if kept < 0:
        pytest.skip("no disk with 2 GiB")
    arguments = [f"output:={tmp_path / 'bag'}", f"minimum_free_mebibytes:={kept}", "topics:=[pose_6dof]"]
    node = start("recorder", *parameters(*arguments))
    found: list[tuple[bytes, str]] = []

    def note(message: DiagnosticArray) -> None:
        found.extend((status.level, status.message) for status in message.status)

    peer.listen(DiagnosticArray, "/diagnostics", note)
    poses = peer.publisher(Pose6DOF, "pose_6dof")
    peer.wait(lambda: [level for level, text in found if "recording" in text][2:])
    assert {level for level, text in found if "recording" in text} == {DiagnosticStatus.OK}
    ending = threading.Event()

    def publish() -> None:
        while not ending.wait(0.01):
            poses.publish(Pose6DOF(reason="x" * 20_000))

    traffic = threading.Thread(target=publish)
    traffic.start()
    try:
        peer.wait(lambda: any("the disk will be full in" in text for _, text in found))
    finally:
        ending.set()
        traffic.join()
    levels = {level for level, text in found if "the disk will be full in" in text}
    assert levels == {DiagnosticStatus.WARN}
    assert node.stop() == 0


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of 3 MiB."""
    path = tmp_path / "disk"
    path.mkdir()
    mount = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=3m", "tmpfs", str(path)], capture_output=True, text=True
    )
    if mount.returncode:
        pytest.skip(f"no disk of one's own here: {mount.stderr.strip()}")
    yield path
    subprocess.run(["umount", "--lazy", str(path)], check=True)


def test_a_full_disk_ends_the_record_and_says_so(start: Start, peer: Peer, small_disk: Path) -> None:
    """What was written is a whole bag, nobody is held up, and with new room it records again."""
    arguments = [f"output:={small_disk / 'bag'}", "minimum_free_mebibytes:=1", "topics:=[pose_6dof]"]
    node = start("recorder", *parameters(*arguments))
    peer.listen(DiagnosticArray, "/diagnostics")
    poses = peer.publisher(Pose6DOF, "pose_6dof")
    reason = "x" * 10_000
    for cycle in itertools.count():
        poses.publish(Pose6DOF(cycle=cycle, reason=reason))
        if "recording stopped" in node.output:
            break
        time.sleep(0.002)

    def levels() -> list[bytes]:
        mine = [s for m in peer.received["/diagnostics"] for s in m.status if s.name == "recorder"]
        return [s.level for s in mine if "almost full" in s.message]

    peer.wait(lambda: levels().count(DiagnosticStatus.ERROR) >= 3)  # until somebody helps
    with BagReader(small_disk / "bag") as bag:
        found = [recorded.message.cycle for recorded in bag.messages()]
    assert len(found) > 150
    assert found == sorted(set(found))
    # This publisher waits for nobody: while the recorder begins, its history of 100 may run over.
    assert found[-150:] == list(range(found[-150], found[-150] + 150))
    assert not peer.call(Trigger, "recorder/split").success
    answer = peer.call(Trigger, "recorder/start")
    assert not answer.success
    assert "MiB left" in answer.message
    for file in (small_disk / "bag").iterdir():
        file.unlink()
    assert peer.call(Trigger, "recorder/start").success
    poses.publish(Pose6DOF(cycle=1))
    time.sleep(0.5)
    assert peer.call(Trigger, "recorder/stop").success
    assert check_bag(small_disk / "bag_1").topics["/pose_6dof"] == ("mems6dof_msgs/msg/Pose6DOF", 1)
    assert node.stop() == 0


def test_it_stops_and_starts_again_in_full_traffic(peer: Peer, tmp_path: Path) -> None:
    """Every message that it took is in one of the bags, each of which is complete."""
    own = [f"output:={tmp_path / 'bag'}", "topics:=[pose_6dof]"]
    rclpy.init(args=["--ros-args", *parameters(*own)], signal_handler_options=SignalHandlerOptions.NO)
    executor = SingleThreadedExecutor()
    ending = threading.Event()
    poses = peer.node.create_publisher(Pose6DOF, "pose_6dof", transport.MESSAGES)

    def publish() -> None:
        for cycle in itertools.count():
            if ending.wait(0.003):
                return
            poses.publish(Pose6DOF(cycle=cycle))

    def spin() -> None:
        while not ending.is_set():
            executor.spin_once(timeout_sec=0.05)

    threads = [threading.Thread(target=publish), threading.Thread(target=spin)]
    try:
        node = RecorderNode()
        # What happens between a look at the bag and a message for it, takes time.
        node._account = lambda received: time.sleep(0.002)  # type: ignore[method-assign]
        executor.add_node(node)
        node.bring_up()
        for thread in threads:
            thread.start()
        bags = [tmp_path / "bag", tmp_path / "bag_1", tmp_path / "bag_2"]
        for bag in bags:
            peer.wait(lambda: poses.get_subscription_count())
            time.sleep(0.3)
            peer.call(
                Trigger, "recorder/stop"
            )  # a second call, where the answer to the first got lost, is refused
            assert node._bag is None
            node.check()
            if bag != bags[-1]:
                peer.call(Trigger, "recorder/start")
                assert node._bag is not None
    finally:
        ending.set()
        for thread in threads:
            thread.join()
        executor.shutdown()
        rclpy.shutdown()
    node.check()
    counts = [check_bag(bag).topics["/pose_6dof"][1] for bag in bags]
    assert min(counts) > 50
    assert sum(counts) == node.health.total("messages")


def test_a_killed_recorder_loses_one_cycle_at_most(domain: int, tmp_path: Path) -> None:
    for death in die(tmp_path / "killed", seed=1, kills=3, size=64, rate=100.0):
        assert death, "a recorder that heard nothing within a minute"
        assert death.written > 20
        assert death.must >= death.written - 12  # of four messages a cycle, and a file may just have ended
        assert death.written >= death.after == death.indexed >= death.must
        assert death.before >= death.must


def test_a_slow_disk_loses_what_it_counts(peer: Peer, tmp_path: Path) -> None:
    """A frame of 131 kB takes the disk 0.13 s; 50 come in a second, of which 1 MiB waits."""
    peer.listen(DiagnosticArray, "/diagnostics")

    def latest(what: str) -> int:
        found = [s for m in peer.received["/diagnostics"] for s in m.status if s.name == "lab/recorder"]
        values = {v.key: v.value for v in found[-1].values} if found else {}
        return int(values.get(what, 0))

    output = tmp_path / "bag"
    with (
        traffic("lab", 50.0, 256),
        witnessed_recorder("lab", output, tmp_path / "journal", rate=1e6, queue_mebibytes=1),
    ):
        peer.wait(lambda: latest("lost") > 50)
        answer = peer.call(Trigger, "/lab/recorder/stop")
        assert answer.success
        seen = len(peer.received["/diagnostics"])
        peer.wait(lambda: len(peer.received["/diagnostics"]) > seen + 6)
        messages, lost = latest("messages"), latest("lost")
    warned = [
        s for m in peer.received["/diagnostics"] for s in m.status if "the disk does not keep up" in s.message
    ]
    assert warned
    assert all(status.level == DiagnosticStatus.WARN for status in warned)
    with BagReader(output) as bag:
        assert sum(bag.counts.values()) == messages - lost
        assert sum(1 for _ in bag.messages()) == messages - lost


def test_a_run_waits_for_who_records_its_images(domain: int, tmp_path: Path) -> None:
    """Though the localizer, and so the pose, has them by shared memory."""
    figures = list(disk.beside(tmp_path / "beside", seed=1, seconds=8.0))
    assert not [figure for figure in figures if figure["passed"] is False], figures
