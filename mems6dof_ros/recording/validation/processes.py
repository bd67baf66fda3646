"""Traffic and recorders in processes of their own."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from mems6dof_ros.errors import Mems6dofError
from mems6dof_ros.nodes import transport
from mems6dof_ros.nodes.common import PARENT_VARIABLE
from mems6dof_ros.nodes.parameters import to_yaml
from mems6dof_ros.nodes.shared_memory import remove_abandoned
from mems6dof_ros.recording.validation.traffic import CYCLE, Journal

TOPICS = [topic for _, topic in CYCLE]


@contextmanager
def traffic(namespace: str, rate: float, size: int) -> Iterator[subprocess.Popen[str]]:
    """``rate`` cycles per second with frames of ``size`` px, as long as the context lasts."""
    with _module("traffic", [f"{rate}", f"{size}"], namespace, {}) as process:
        yield process


@contextmanager
def witnessed_recorder(
    namespace: str, output: Path, journal: Path, rate: float = 0.0, **parameters: Any
) -> Iterator[tuple[subprocess.Popen[str], Journal]]:
    """A recorder of the traffic, and what it has written; ``rate``: no faster, bytes/s. Ended by SIGINT."""
    noted = Journal(journal, "w+")
    parameters = {"output": str(output), "topics": TOPICS, **parameters}
    with _module("recorder", [str(journal), f"{rate}"], namespace, parameters) as process:
        yield process, noted


@contextmanager
def _module(
    what: str, arguments: Sequence[str], namespace: str, parameters: dict[str, Any]
) -> Iterator[subprocess.Popen[str]]:
    command = [sys.executable, "-m", "mems6dof_ros.recording.validation.traffic", what, *arguments]
    command += ["--ros-args", "-r", f"__ns:=/{namespace}", "--log-level", "error"]
    for name, value in parameters.items():
        command += ["-p", f"{name}:={to_yaml(value)}"]
    environment = {**transport.LOCALHOST_ONLY, **os.environ, PARENT_VARIABLE: str(os.getpid())}
    process = subprocess.Popen(command, env=environment, text=True, stderr=subprocess.PIPE)
    try:
        yield process
    finally:
        process.terminate()
        _, said = process.communicate(timeout=60)
        if process.returncode > 0:
            raise Mems6dofError(f"{what} ended with {process.returncode}: {said.strip()[-300:]}")


def until(condition: Callable[[], Any], what: str, *processes: subprocess.Popen[str]) -> None:
    """Poll; Mems6dofError after a minute, or when one of ``processes`` has ended."""
    deadline = time.monotonic() + 60.0
    while not condition():
        if any(process.poll() is not None for process in processes):
            raise Mems6dofError(f"no {what}: a process has ended")
        if time.monotonic() > deadline:
            raise Mems6dofError(f"no {what} within a minute")
        time.sleep(0.01)


def kill(process: subprocess.Popen[str]) -> int:
    """By SIGKILL; returns the monotonic time, ns, just before."""
    now = time.monotonic_ns()
    process.kill()
    process.wait()
    remove_abandoned()
    return now
