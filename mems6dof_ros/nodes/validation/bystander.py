"""A system of nodes and somebody beside it who hears, publishes and calls: for validations."""

from __future__ import annotations

import contextlib
import os
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import Image

from mems6dof_ros.errors import Mems6dofError
from mems6dof_ros.nodes import transport
from mems6dof_ros.nodes.actuation import ANSWERS
from mems6dof_ros.nodes.runner import RunningSystem, run_system
from mems6dof_ros.nodes.system import NodeSpec

_PATIENCE = 300.0  # s


@contextlib.contextmanager
def running(nodes: Sequence[NodeSpec], log: Path) -> Iterator[tuple[RunningSystem, Bystander]]:
    """``nodes`` in a namespace of their own, what they print in ``log``, and a bystander among them."""
    namespace = f"validation_{os.getpid()}"
    with (
        log.open("w", encoding="utf-8") as lines,
        Bystander(namespace) as bystander,
        run_system(nodes, namespace=namespace, on_line=lambda line: print(line, file=lines)) as system,
    ):
        bystander.check = lambda: _check(system, log)
        yield system, bystander


def _check(system: RunningSystem, log: Path) -> None:
    if ended := system.poll():
        raise Mems6dofError(f"{', '.join(ended)} ended, see {log}")


class Bystander:
    """A node of an ordinary program: hears, publishes and calls; its callbacks run in a thread of their own.

    ``diagnostics``: the latest of each node of its namespace; ``reports``: how many there were.
    """

    def __init__(self, namespace: str) -> None:
        for name, value in transport.LOCALHOST_ONLY.items():
            os.environ.setdefault(name, value)
        transport.use_profile(frames=True)
        self.namespace = namespace
        self.check: Callable[[], None] = lambda: None
        self.diagnostics: dict[str, dict[str, str]] = {}
        self.reports: dict[str, int] = defaultdict(int)
        self._context = Context()
        rclpy.init(args=[], context=self._context, signal_handler_options=SignalHandlerOptions.NO)
        self.node = Node("bystander", context=self._context, namespace=namespace)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._changed, self._closing = threading.Condition(), False
        self._thread = threading.Thread(target=self._spin, name="bystander", daemon=True)
        self.listen(DiagnosticArray, "/diagnostics", self._on_diagnostics)
        self._thread.start()

    def __enter__(self) -> Bystander:
        return self

    def __exit__(self, *_: object) -> None:
        self._closing = True
        self._thread.join()
        self._executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self._context)

    def _spin(self) -> None:
        while not self._closing:
            self._executor.spin_once(timeout_sec=0.05)
            with self._changed:
                self._changed.notify_all()

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            namespace, _, name = status.name.rpartition("/")
            if namespace == self.namespace:
                self.diagnostics[name] = {pair.key: pair.value for pair in status.values}
                self.reports[name] += 1

    def listen(
        self,
        kind: type,
        topic: str,
        act: Callable[[Any], None],
        quality: QoSProfile = transport.MESSAGES,
        raw: bool = False,
    ) -> None:
        """Call ``act`` with each message, ``raw``: serialized."""
        self.node.create_subscription(kind, topic, act, quality, raw=raw)

    def call(self, kind: type, service: str) -> None:
        """Call a service and wait for its answer."""
        client = self.node.create_client(kind, service)
        self.until(client.service_is_ready, f"service {service}")
        answer = client.call_async(kind.Request())  # type: ignore[attr-defined]
        self.until(answer.done, f"answer of {service}")

    def subscriptions(self, name: str) -> list[tuple[str, list[str]]]:
        """Topics, and their types, that the node of this ``name`` in the namespace listens to."""
        self.until(lambda: name in self.node.get_node_names(), f"node {name}")
        return self.node.get_subscriber_names_and_types_by_node(name, f"/{self.namespace}")

    def publisher(self, kind: type, topic: str, listeners: int = 1) -> Any:
        """A publisher that so many listen to."""
        wanted = self.node.get_subscriptions_info_by_topic(topic)
        lasting = any(end.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL for end in wanted)
        quality = ANSWERS if lasting else transport.FRAMES if kind is Image else transport.MESSAGES
        publisher = self.node.create_publisher(kind, topic, quality)
        self.until(lambda: publisher.get_subscription_count() >= listeners, f"subscriber of {topic}")
        return publisher

    def until(self, condition: Callable[[], Any], what: str, timeout: float = _PATIENCE) -> None:
        """Wait for ``condition``; Mems6dofError says that ``what`` did not come within ``timeout`` s."""
        deadline = time.monotonic() + timeout
        with self._changed:
            while not condition():
                self.check()
                if time.monotonic() > deadline:
                    raise Mems6dofError(f"no {what} within {timeout:g} s")
                self._changed.wait(0.1)

    def counts_settled(self, *names: str) -> dict[str, dict[str, int]]:
        """The totals of these nodes, reported after everything that was sent has been dealt with."""
        before = dict(self.reports)
        self.until(
            lambda: all(self.reports[name] >= before.get(name, 0) + 3 for name in names), "diagnostics"
        )
        return {
            name: {key: int(value) for key, value in self.diagnostics[name].items() if value.isdecimal()}
            for name in names
        }
