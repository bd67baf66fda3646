"""Nodes of a validation, each a process of its own."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Iterator
from typing import Any

from mems6dof_ros.errors import Mems6dofError
from mems6dof_ros.nodes.runner import run_system
from mems6dof_ros.nodes.system import NodeSpec

#: Cycles per second of the drive.
DRIVE = 90.0
_START = 30.0  # s that a node may take to serve


def namespace() -> str:
    """One that no other validation uses."""
    return f"validate_{os.getpid()}"


@contextlib.contextmanager
def monitor(namespace: str) -> Iterator[tuple[str, int]]:
    """A monitor node: the address of its page, its process id."""
    with node(NodeSpec("monitor", {"port": 0}), namespace, "live page: ") as found:
        yield found


@contextlib.contextmanager
def node(spec: NodeSpec, namespace: str, says: str = "") -> Iterator[tuple[str, int]]:
    """A node as a process, once it has said so: what came after it on that line, and its process id."""
    said: list[str] = []
    lines: list[str] = []

    def on_line(line: str) -> None:
        lines.append(line)
        if says in line:
            said.append(line.partition(says)[2])

    with run_system([spec], namespace=namespace, on_line=on_line) as running:
        deadline = time.monotonic() + _START
        while says and not said:
            if running.poll() or time.monotonic() > deadline:
                raise Mems6dofError(f"{spec.executable} does not start: {'; '.join(lines[-3:])}")
            time.sleep(0.02)
        yield said[0] if says else "", running.processes[spec.executable].pid


def synthetic(namespace: str, **parameters: Any) -> contextlib.AbstractContextManager[tuple[str, int]]:
    """The traffic of an instrument, as a node."""
    return node(NodeSpec("synthetic_gear", parameters), namespace, "active")
