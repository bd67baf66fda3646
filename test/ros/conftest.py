"""Real DDS between real processes: a domain per test, and listening on events instead of sleeping."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from peers import NodeProcess, Peer, own_domain

from mems6dof_ros.calibration.calibrate import calibrate
from mems6dof_ros.calibration.file import save_calibration
from mems6dof_ros.calibration.focus_stack import measure_stack
from mems6dof_ros.nodes import transport
from mems6dof_ros.simulation.experiment import focus_stack
from mems6dof_ros.simulation.settings import SimulationSettings
from mems6dof_ros.sources.simulator import camera_noise


@pytest.fixture(autouse=True)
def domain(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[int]:
    """A ROS domain of this test's own, on this machine only, for this process and its children."""
    monkeypatch.setenv("ROS_LOG_DIR", str(tmp_path / "ros_log"))
    for name, value in transport.LOCALHOST_ONLY.items():
        monkeypatch.setenv(name, value)
    with own_domain() as number:
        monkeypatch.setenv("ROS_DOMAIN_ID", str(number))
        yield number


@pytest.fixture(scope="session")
def calibration(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A calibration of the default simulated optics at 512 px."""
    settings = SimulationSettings(width_px=512, height_px=512)
    frames = focus_stack(settings, -3e-6, 3e-6, 0.25e-6, beads=30, seed=3)
    stack = measure_stack(frames, camera_noise(settings), "relative_light_weighting", 31)
    path = tmp_path_factory.mktemp("calibration") / "optics.yaml"
    save_calibration(calibrate([stack]).calibration, path)
    return str(path)


@pytest.fixture
def peer(domain: int) -> Iterator[Peer]:
    """A node of ours."""
    it = Peer(domain)
    yield it
    it.close()


@pytest.fixture
def start() -> Iterator[Callable[..., NodeProcess]]:
    """Starts nodes by executable and arguments; none survives the test."""
    started: list[NodeProcess] = []

    def start_one(executable: str, *arguments: str) -> NodeProcess:
        started.append(NodeProcess(executable, *arguments))
        return started[-1]

    yield start_one
    for node in started:
        if node.process.poll() is None:
            node.process.kill()
            node.process.wait()
