"""Fixtures of the tests of the live page."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

# Helpers beside this file, and those of test/ros that keep ROS domains apart.
sys.path[:0] = [str(Path(__file__).parent), str(Path(__file__).parents[1] / "ros")]

from monitor_helpers import Instrument, Served  # noqa: E402

from mems6dof_ros.monitor.synthetic import Machine  # noqa: E402


@pytest.fixture
def serve() -> Iterator[Callable[..., Served]]:
    """Start servers with the options of MonitorServer; they are stopped at the end."""
    running: list[Served] = []

    def start(**options: object) -> Served:
        running.append(Served(**options))
        return running[-1]

    yield start
    for served in running:
        served.server.stop()


@pytest.fixture(scope="module")
def instrument() -> Iterator[Instrument]:
    running = Instrument("-p", "port:=0", machine_args=("rate:=60.0", "size:=512", "image_every:=6"))
    yield running
    running.stop()


@pytest.fixture
def machine() -> Machine:
    return Machine(seed=3, size=256)
