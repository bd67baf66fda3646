"""Nodes of ours in this process and in others, and how to wait for them."""

from __future__ import annotations

import contextlib
import random
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from mems6dof_ros.nodes import transport

#: A gear that fits into 512 px.
SMALL_GEAR = {
    "width_px": 512,
    "height_px": 512,
    "gear_diameter": 60e-6,
    "hub_diameter": 8e-6,
    "particles": 30,
}
#: Seconds after which a wait has failed; a few are enough, but a fresh clone compiles its kernels first.
PATIENCE = 180.0


@contextlib.contextmanager
def own_domain() -> Iterator[int]:
    """A ROS domain that no other test on this machine uses: claimed by a socket of that name."""
    domains = list(range(1, 102))  # from 102 on, the ports are those of outgoing connections
    random.shuffle(domains)
    for number in domains:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as claim:
            try:
                claim.bind(f"\0mems6dof ROS domain {number}")
            except OSError:
                continue
            yield number
            return
    raise RuntimeError("no free ROS domain")


class Peer:
    """A node in this process: publishes, listens, calls services."""

    def __init__(self, domain: int, namespace: str = "") -> None:
        transport.use_profile(frames=True)
        self._context = Context()
        rclpy.init(context=self._context, domain_id=domain, signal_handler_options=SignalHandlerOptions.NO)
        self.node = Node("peer", context=self._context, namespace=namespace)
        self.received: dict[str, list[Any]] = defaultdict(list)
        self._changed = threading.Condition()
        self._closing = False
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._thread = threading.Thread(target=self._spin, daemon=True)
        self._thread.start()

    def _spin(self) -> None:
        while not self._closing:
            self._executor.spin_once(timeout_sec=0.1)
            with self._changed:
                self._changed.notify_all()

    def listen(self, kind: type, topic: str, act: Callable[[Any], None] | None = None) -> None:
        """Keep the messages of ``topic`` in ``received``, and ``act`` on each."""

        def receive(message: Any) -> None:
            if act:
                act(message)
            with self._changed:
                self.received[topic].append(message)
                self._changed.notify_all()

        qos = transport.FRAMES if topic.endswith("image_raw") else transport.MESSAGES
        self.node.create_subscription(kind, topic, receive, qos)

    def publisher(self, kind: type, topic: str, subscribers: int = 1) -> Any:
        """A publisher that ``subscribers`` listen to."""
        qos = transport.FRAMES if topic.endswith("image_raw") else transport.MESSAGES
        publisher = self.node.create_publisher(kind, topic, qos)
        self.wait(lambda: publisher.get_subscription_count() >= subscribers)
        return publisher

    def wait(self, condition: Callable[[], Any], timeout: float = PATIENCE) -> None:
        """Wait until ``condition``; fails the test after ``timeout`` s."""
        with self._changed:
            assert self._changed.wait_for(condition, timeout), {k: len(v) for k, v in self.received.items()}

    def call(self, kind: type, service: str, request: Any = None) -> Any:
        """The response of a service."""
        client = self.node.create_client(kind, service)
        assert client.wait_for_service(PATIENCE)
        # A server answers into the void where, on a busy machine, it has not yet discovered the client's
        # reader (rmw_fastrtps waits 0.1 s for it): ask once more.
        for patience in (PATIENCE / 6, PATIENCE):
            answer = client.call_async(request or kind.Request())
            with self._changed:
                if self._changed.wait_for(answer.done, patience):
                    return answer.result()
        raise AssertionError(f"{service} does not answer")

    def close(self) -> None:
        self._closing = True
        self._thread.join()
        self._executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self._context)


class NodeProcess:
    """A node in a process of its own; ``lines`` are what it has printed."""

    def __init__(self, executable: str, *arguments: str) -> None:
        command = [sys.executable, "-m", f"mems6dof_ros.nodes.{executable}", "--ros-args", *arguments]
        self.process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, stdin=subprocess.DEVNULL
        )
        self.lines: list[str] = []
        self._ended = False
        self._changed = threading.Condition()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            with self._changed:
                self.lines.append(line.rstrip())
                self._changed.notify_all()
        with self._changed:
            self._ended = True
            self._changed.notify_all()

    @property
    def output(self) -> str:
        return "\n".join(self.lines)

    def wait_for_line(self, text: str) -> None:
        """Wait until a line contains ``text``."""
        with self._changed:
            self._changed.wait_for(lambda: self._ended or text in self.output, PATIENCE)
            assert text in self.output, self.output

    def wait(self) -> int:
        """Exit code at its own end."""
        code = self.process.wait(PATIENCE)
        self._reader.join(5)
        return code

    def stop(self, number: int = signal.SIGINT) -> int:
        """Send a signal and return the exit code."""
        self.process.send_signal(number)
        return self.wait()


def alive(pid: int) -> bool:
    """True while a process runs, zombies excepted."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except FileNotFoundError:
        return False
    return state != "Z"


def wait_until(condition: Callable[[], Any], timeout: float = PATIENCE) -> None:
    """Poll what sends no event, such as the end of somebody else's process."""
    deadline = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)
