"""Subscriptions for those who look on: taken from now and then, instead of waking up for every message."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.qos import QoSProfile

from mems6dof_ros.nodes import transport


class _NeverWaitedFor(CallbackGroup):
    """Keeps what is in it out of what an executor waits for."""

    def can_execute(self, entity: Any) -> bool:
        return False

    def beginning_execution(self, entity: Any) -> bool:
        return False

    def ending_execution(self, entity: Any) -> None:
        pass


class PolledSubscriptions:
    """Serialized messages, topic after topic in the order of subscription, every ``period`` s; then ``then``.

    An executor of rclpy builds its list of what to wait for anew each time, 0.5 ms and more: four topics
    at 90 Hz would cost a quarter of a core, which the measurement may need. Messages wait in the middleware
    meanwhile; a queue of 100 holds a second of them.
    """

    def __init__(self, node: Node, period: float, then: Callable[[], None] = lambda: None) -> None:
        self._node = node
        self._group = _NeverWaitedFor()
        self._taken: list[tuple[Any, Callable[[bytes], None]]] = []
        self._then = then
        # Wall time: a page is looked at also while simulated time stands still.
        node.create_timer(period, self._take, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def subscribe(
        self,
        kind: type,
        topic: str,
        act: Callable[[bytes], None],
        quality: QoSProfile = transport.MESSAGES,
    ) -> None:
        """Call ``act`` with every message of ``topic``."""
        subscription = self._node.create_subscription(
            kind, topic, lambda _: None, quality, callback_group=self._group, raw=True
        )
        self._taken.append((subscription, act))

    def _take(self) -> None:
        for subscription, act in self._taken:
            with subscription.handle:
                while (found := subscription.handle.take_message(subscription.msg_type, True)) is not None:
                    act(found[0])
        self._then()
