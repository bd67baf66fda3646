"""Nodes that are killed, and what they leave."""

from __future__ import annotations

import fcntl
import os
import time
from pathlib import Path

from diagnostic_msgs.msg import DiagnosticArray
from peers import PATIENCE, Peer, alive, wait_until
from std_srvs.srv import Trigger

from mems6dof_ros.nodes.runner import run_system
from mems6dof_ros.nodes.shared_memory import remove_abandoned
from mems6dof_ros.nodes.system import SYSTEMS, NodeSpec
from mems6dof_ros.recording.bag import BagReader


def test_only_segments_of_dead_processes_are_removed(tmp_path: Path) -> None:
    def make(name: str, age: float = 60.0) -> Path:
        path = tmp_path / name
        path.write_bytes(b"\0" * 1000)
        os.utime(path, (time.time() - age,) * 2)
        return path

    dead = [make("fastrtps_00000000000000aa"), make("fastrtps_00000000000000aa_el")]
    kept = [make("fastrtps_00000000000000bb"), make("fastrtps_00000000000000bb_el")]
    kept += [make("fastrtps_00000000000000cc", 0.0), make("fastrtps_00000000000000cc_el", 0.0)]
    kept += [make("fastrtps_port7412"), make("fastrtps_port7412_el"), make("something_else")]
    with kept[1].open() as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        assert remove_abandoned(tmp_path) == 1000
        assert sorted(tmp_path.iterdir()) == sorted(kept)
    assert not any(path.exists() for path in dead)
    assert remove_abandoned(tmp_path) == 1000  # the lock of its owner is gone
    assert remove_abandoned(tmp_path / "absent") == 0


def test_what_is_killed_is_started_again_and_leaves_no_memory_behind() -> None:
    nodes = [NodeSpec("pose_estimator", respawn=True), NodeSpec("recorder", {"start_paused": True})]
    lines: list[str] = []

    def ready() -> int:
        return lines.count("[pose_estimator] INFO ready")

    with run_system(nodes, on_line=lines.append) as system:
        first = system.processes["pose_estimator"]
        wait_until(lambda: ready() == 1)
        segments = {path.name for path in Path("/dev/shm").glob("fastrtps_????????????????")}
        time.sleep(5)  # until a segment counts as grown up
        first.kill()
        wait_until(lambda: ready() == 2)
        assert system.respawned == {"pose_estimator": 1}
        assert system.poll() == {}
        assert len(segments - {path.name for path in Path("/dev/shm").glob("fastrtps_????????????????")}) > 0
        second = system.processes["pose_estimator"].pid
        assert system.stop() == {"pose_estimator": 0, "recorder": 0}
    assert not alive(second)


def test_a_recorder_that_is_started_again_goes_on_beside_a_complete_bag(peer: Peer, tmp_path: Path) -> None:
    """But nobody else records where there is a bag already."""
    output = tmp_path / "bag"
    recorder = NodeSpec("recorder", {"output": str(output), "topics": ["pose_6dof"]}, respawn=True)
    lines: list[str] = []

    def recording() -> int:
        return lines.count("[recorder] INFO recording")

    peer.listen(DiagnosticArray, "/diagnostics")
    with run_system([recorder], on_line=lines.append) as system:
        for number in (1, 2):
            wait_until(lambda number=number: recording() == number)
            seen = len(peer.received["/diagnostics"])
            peer.wait(lambda seen=seen: len(peer.received["/diagnostics"]) > seen)  # this one is discovered
            peer.call(
                Trigger, "recorder/stop"
            )  # a second call, where the answer to the first got lost, is refused
            wait_until(lambda number=number: lines.count("[recorder] INFO stopped") == number)
            system.processes["recorder"].kill()
        wait_until(lambda: recording() == 3)
        assert system.respawned == {"recorder": 2}
        assert system.stop() == {"recorder": 0}
    for suffix in ("", "_1", "_2"):
        BagReader(f"{output}{suffix}")
    with run_system([NodeSpec(recorder.executable, recorder.parameters)], on_line=lines.append) as system:
        assert system.wait("recorder", timeout=PATIENCE) == {"recorder": 1}
    assert "something there already" in lines[-1]


def test_respawn_is_an_argument() -> None:
    for name in ("live", "closed_loop"):
        for value in ("true", "false"):
            table = SYSTEMS[name].table({"calibration": "c.yaml", "respawn": value})
            assert {node.respawn for node in table} == {value == "true"}
