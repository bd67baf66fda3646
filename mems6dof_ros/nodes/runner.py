"""Starts systems of nodes as processes, where `launch` is missing.

From a shell, with the arguments of ``ros2 launch``::

    python -m mems6dof_ros.nodes.runner replay recording:=bag calibration:=optics.yaml
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import threading
import time
import uuid
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from mems6dof_ros.errors import InputError, Mems6dofError
from mems6dof_ros.nodes import shared_memory, transport
from mems6dof_ros.nodes.common import PARENT_VARIABLE
from mems6dof_ros.nodes.recorder import RUN_VARIABLE
from mems6dof_ros.nodes.system import SYSTEMS, NodeSpec, System, arguments, parameter_file


class RunningSystem:
    """The processes of a system, by executable, and how often each was ``respawned``."""

    #: Seconds that a process is given after SIGINT, enough for a recorder to write what waits for its disk,
    #: and after SIGTERM.
    GRACE = (60.0, 3.0)
    #: Seconds until a process that failed or was killed is started again.
    RESPAWN_DELAY = 1.0

    def __init__(self, start: Callable[[NodeSpec], subprocess.Popen[str]]) -> None:
        self.processes: dict[str, subprocess.Popen[str]] = {}
        self.respawned: Counter[str] = Counter()
        self._start = start
        self._kept: dict[str, NodeSpec] = {}
        self._starting = threading.Lock()
        self._stopping, self._stopped = threading.Event(), threading.Event()
        self._keeper: threading.Thread | None = None

    def add(self, node: NodeSpec) -> None:
        """Start a node."""
        self.processes[node.executable] = self._start(node)
        if node.respawn:
            self._kept[node.executable] = node
            if self._keeper is None:
                self._keeper = threading.Thread(target=self._keep, name="keeper", daemon=True)
                self._keeper.start()

    def _keep(self) -> None:
        """Start again what has failed; ends last, because the kernel takes the thread that started a process
        for its parent."""
        while not self._stopping.wait(0.05):
            for name, node in list(self._kept.items()):
                if not self.processes[name].poll() or self._stopping.wait(self.RESPAWN_DELAY):
                    continue
                shared_memory.remove_abandoned()
                with self._starting:
                    if not self._stopping.is_set():
                        self.processes[name] = self._start(node)
                        self.respawned[name] += 1
        self._stopped.wait()

    def poll(self) -> dict[str, int]:
        """Exit codes of the processes that have ended and are not started again."""
        codes = {name: process.poll() for name, process in self.processes.items()}
        kept = set() if self._stopping.is_set() else set(self._kept)
        return {name: code for name, code in codes.items() if code == 0 or (code and name not in kept)}

    def wait(self, *names: str, timeout: float | None = None) -> dict[str, int]:
        """Wait until one of ``names``, default all, has ended or any process has failed; returns ``poll()``.

        Raises TimeoutError after ``timeout`` s.
        """
        deadline = None if timeout is None else time.monotonic() + timeout
        while True:
            ended = self.poll()
            if any(ended.values()) or any(name in ended for name in names or self.processes):
                return ended
            if deadline is not None and time.monotonic() > deadline:
                raise TimeoutError(f"still running after {timeout:g} s: {', '.join(self.processes)}")
            time.sleep(0.02)

    def stop(self) -> dict[str, int]:
        """Stop what still runs, in the order of the flow, so that each finishes what it was sent.

        SIGINT, then SIGTERM, then SIGKILL; returns all exit codes, negative ones by a signal.
        """
        with self._starting:
            self._stopping.set()
        for process in self.processes.values():
            for number, grace in zip((signal.SIGINT, signal.SIGTERM), self.GRACE, strict=True):
                if process.poll() is None:
                    process.send_signal(number)
                    with contextlib.suppress(subprocess.TimeoutExpired):
                        process.wait(grace)
            if process.poll() is None:
                process.kill()
                process.wait()
        self._stopped.set()
        return self.poll()


@contextlib.contextmanager
def run_system(
    nodes: Sequence[NodeSpec],
    *,
    namespace: str = "",
    config: str = "",
    environment: Mapping[str, str] = transport.LOCALHOST_ONLY,
    prefix: Sequence[str] = (),
    on_line: Callable[[str], None] = print,
) -> Iterator[RunningSystem]:
    """Start the nodes as processes, and stop them all at the end of the context, however it ends.

    ``config``: directory of parameter files; ``environment``: for variables that ours does not set, by
    default discovery limited to this machine; ``prefix``: put before the command of each;
    ``on_line`` gets every line they print, with the node's name.
    """
    readers = []
    ours = {PARENT_VARIABLE: str(os.getpid()), RUN_VARIABLE: uuid.uuid4().hex}

    def start(node: NodeSpec) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            [*prefix, *command(node, namespace, config)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            env={**_PLAIN_LINES, **environment, **os.environ, **ours},
            start_new_session=True,  # Ctrl-C reaches us alone, and we stop them in order
        )
        reader = threading.Thread(target=_forward, args=(node.executable, process, on_line), daemon=True)
        reader.start()
        readers.append(reader)
        return process

    shared_memory.remove_abandoned()
    system = RunningSystem(start)
    try:
        for node in nodes:
            system.add(node)
        yield system
    finally:
        system.stop()
        for reader in readers:
            reader.join(timeout=1.0)


_PLAIN_LINES = {"RCUTILS_CONSOLE_OUTPUT_FORMAT": "{severity} {message}"}


def command(node: NodeSpec, namespace: str = "", config: str = "") -> list[str]:
    """The command line of a node."""
    words = [sys.executable, "-m", f"mems6dof_ros.nodes.{node.executable}", "--ros-args"]
    if namespace:
        words += ["-r", f"__ns:=/{namespace.strip('/')}"]
    for before, after in node.remappings.items():
        words += ["-r", f"{before}:={after}"]
    words += arguments(node.defaults)
    if config:
        words += ["--params-file", str(parameter_file(node, config))]
    return words + arguments(node.parameters)


def _forward(name: str, process: subprocess.Popen[str], on_line: Callable[[str], None]) -> None:
    assert process.stdout is not None
    for line in process.stdout:
        on_line(f"[{name}] {line.rstrip()}")


def main(words: Sequence[str] | None = None) -> int:
    """Run a system until its source ends or a signal comes; returns 0, or 1 where a node failed."""
    words = sys.argv[1:] if words is None else words
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _interrupt)
    try:
        system, values = _parse(words)
        nodes = system.table(values)
        last = [node.executable for node in nodes if node.ends_system]
        with run_system(
            nodes, namespace=values.get("namespace", ""), config=values.get("config", "")
        ) as running:
            running.wait(*last)
            codes = running.stop()
    except Mems6dofError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 0
    return int(any(codes.values()))


def _interrupt(*_: Any) -> None:
    raise KeyboardInterrupt


def _parse(words: Sequence[str]) -> tuple[System, dict[str, str]]:
    if not words or words[0] not in SYSTEMS:
        raise InputError("arguments", " ".join(words) or "nothing", f"one of {', '.join(SYSTEMS)}")
    values = {}
    for argument in words[1:]:
        name, separator, value = argument.partition(":=")
        if not separator:
            raise InputError("arguments", f"'{argument}'", "name:=value")
        values[name] = value
    return SYSTEMS[words[0]], values


if __name__ == "__main__":
    sys.exit(main())
