"""What the tests of the live page run: a server by itself, and a node with a synthetic gear to watch."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import Future
from pathlib import Path

from peers import own_domain

from mems6dof_ros.monitor.feed import Feed
from mems6dof_ros.monitor.server import MonitorServer

ROOT = Path(__file__).parents[2]


class Served:
    """A running server, what it logged and which services it was asked to call."""

    def __init__(self, **options: object) -> None:
        self.log: list[str] = []
        self.called: list[str] = []
        self.feed = Feed(1000)
        self.feed.set_instrument({"services": {"frame_source/stop": True}})
        self.server = MonitorServer(self.feed, self._call, log=self.log.append, **options)
        self.url = self.server.start()

    def _call(self, service: str, value: float | None) -> Future[tuple[bool, str]]:
        self.called.append(service if value is None else f"{service} {value}")
        answer: Future[tuple[bool, str]] = Future()
        answer.set_result((True, "stopped"))
        return answer


class Instrument:
    """A node that watches, by default the monitor, and the synthetic gear, with the
    parameters ``machine_args``, if any; in a ROS domain of their own."""

    def __init__(
        self,
        *monitor_args: str,
        machine_args: tuple[str, ...] | None = (),
        module: str = "mems6dof_ros.nodes.monitor",
        says: str = "live page: ",
    ) -> None:
        self._resources = contextlib.ExitStack()
        self.domain = self._resources.enter_context(own_domain())
        self._environment = os.environ | {
            "PYTHONPATH": str(ROOT),
            "ROS_DOMAIN_ID": str(self.domain),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
            "OPENBLAS_NUM_THREADS": "1",
            "PYTHONUNBUFFERED": "1",
        }
        self.lines: list[str] = []
        self._says = says
        self.monitor = self._start("-m", module, "--ros-args", *monitor_args)
        self.machine: subprocess.Popen[str] | None = None
        if machine_args is not None:
            arguments = [word for option in machine_args for word in ("-p", option)]
            self.machine = self._start("-m", "mems6dof_ros.nodes.synthetic_gear", "--ros-args", *arguments)
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
        deadline = time.monotonic() + 60
        while time.monotonic() < deadline and self.monitor.poll() is None:
            for line in list(self.lines):
                if self._says in line:
                    return line.partition(self._says)[2]
            time.sleep(0.02)
        raise AssertionError("\n".join(self.lines))

    def stop(self) -> int:
        """End both; returns the exit status of the monitor."""
        if self.machine:
            self.machine.terminate()
            self.machine.wait(60)
        if self.monitor.poll() is None:
            # Where every test was skipped it may still be importing, and there a callback of C may swallow
            # the KeyboardInterrupt: our handlers come afterwards.
            with contextlib.suppress(AssertionError):
                _ = self.url
            self.monitor.send_signal(signal.SIGINT)
        status = self.monitor.wait(60)
        self._resources.close()
        return status
