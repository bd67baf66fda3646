"""Nodes that are killed, and what they leave."""

from __future__ import annotations

import fcntl
import os
import time
from pathlib import Path

from peers import alive, wait_until

from mems6dof_ros.nodes.runner import run_system
from mems6dof_ros.nodes.shared_memory import remove_abandoned
from mems6dof_ros.nodes.system import SYSTEMS, NodeSpec


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


def test_respawn_is_an_argument() -> None:
    for name in ("live", "closed_loop"):
        for value in ("true", "false"):
            table = SYSTEMS[name].table({"calibration": "c.yaml", "respawn": value})
            assert {node.respawn for node in table} == {value == "true"}
