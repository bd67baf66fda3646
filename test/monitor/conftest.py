"""Shared by the tests of the live page: the synthetic gear, and a server that tells what it logged."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from pathlib import Path

import pytest

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
sys.path.insert(0, str(HERE))

from synthetic import Machine  # noqa: E402

from mems6dof_ros.monitor.feed import Feed  # noqa: E402
from mems6dof_ros.monitor.server import MonitorServer  # noqa: E402


class Served:
    """A running server, what it logged and which services it was asked to call."""

    def __init__(self, **options: object) -> None:
        self.log: list[str] = []
        self.called: list[str] = []
        self.feed = Feed(1000)
        self.feed.set_instrument({"services": {"frame_source/stop": True}})
        self.server = MonitorServer(self.feed, self._call, log=self.log.append, **options)
        self.url = self.server.start()

    def _call(self, service: str) -> Future[tuple[bool, str]]:
        self.called.append(service)
        answer: Future[tuple[bool, str]] = Future()
        answer.set_result((True, "stopped"))
        return answer


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


class Instrument:
    """A node that watches, by default the monitor, and the synthetic gear; in a ROS domain of their own."""

    def __init__(
        self,
        *monitor_args: str,
        machine_args: tuple[str, ...] = (),
        module: str = "mems6dof_ros.nodes.monitor",
        says: str = "live page: ",
    ) -> None:
        domain = 10 + os.getpid() % 90
        self._environment = os.environ | {
            "PYTHONPATH": str(ROOT),
            "ROS_DOMAIN_ID": str(domain),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
            "OPENBLAS_NUM_THREADS": "1",
            "PYTHONUNBUFFERED": "1",
        }
        self.lines: list[str] = []
        self._says = says
        self.monitor = self._start("-m", module, "--ros-args", *monitor_args)
        self.machine = self._start(str(HERE / "synthetic.py"), *machine_args)
        threading.Thread(target=self._read, daemon=True).start()

    def _start(self, *arguments: str) -> subprocess.Popen[str]:
        return subprocess.Popen(
            [sys.executable, *arguments],
            env=self._environment,
            cwd=ROOT,
            text=True,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
        )

    def _read(self) -> None:
        assert self.monitor.stdout
        for line in self.monitor.stdout:
            self.lines.append(line.rstrip())

    @property
    def url(self) -> str:
        """Address of the page, once the node has told it."""
        deadline = time.monotonic() + 20
        while time.monotonic() < deadline and self.monitor.poll() is None:
            for line in list(self.lines):
                if self._says in line:
                    return line.partition(self._says)[2]
            time.sleep(0.02)
        raise AssertionError("\n".join(self.lines))

    def stop(self) -> int:
        """End both; returns the exit status of the monitor."""
        if self.machine.poll() is None:
            self.machine.terminate()
        self.machine.wait(10)
        if self.monitor.poll() is None:
            self.monitor.send_signal(signal.SIGINT)
        return self.monitor.wait(10)


@pytest.fixture(scope="module")
def instrument() -> Iterator[Instrument]:
    running = Instrument(
        "-p", "port:=0", machine_args=("--rate", "60", "--size", "512", "--image-every", "6")
    )
    yield running
    running.stop()


@pytest.fixture
def machine() -> Machine:
    return Machine(seed=3, size=256)
