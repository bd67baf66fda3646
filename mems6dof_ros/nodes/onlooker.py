"""What those who look on at a measurement do to cost it little."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.qos import QoSProfile

from mems6dof_ros.nodes import transport
from mems6dof_ros.nodes.stream import OutOfExecutor

_NICENESS = 10


def give_way() -> None:
    """Leave the processor to the measurement where both want it."""
    os.nice(_NICENESS)
    if os.getsid(0) == os.getpid():
        # Linux may share the processor among sessions first (autogroup, see sched(7)): nodes of the runner
        # have one each, and this one is nobody else's.
        with contextlib.suppress(OSError):
            Path("/proc/self/autogroup").write_text(str(_NICENESS), encoding="utf-8")


class PolledSubscriptions:
    """Serialized messages, acted on every ``period`` s, topic after topic in the order of subscription; after
    that, ``then`` is called. A message of a later topic finds those that were published before it.

    An executor of rclpy builds its list of what to wait for anew each time, 0.5 ms and more: four topics
    at 90 Hz would cost a quarter of a core, which the measurement may need. Messages wait in the middleware
    meanwhile; a queue of 100 holds a second of them.
    """

    def __init__(self, node: Node, period: float, then: Callable[[], None] = lambda: None) -> None:
        self._node = node
        self._group = OutOfExecutor()
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
    ) -> Callable[[], None]:
        """Call ``act`` with every message of ``topic``, until what is returned is called."""
        subscription = self._node.create_subscription(
            kind, topic, act, quality, callback_group=self._group, raw=True
        )
        taken = (subscription, subscription.callback)  # refuses what act refuses
        self._taken.append(taken)

        def end() -> None:
            if taken in self._taken:
                self._taken.remove(taken)
                self._node.destroy_subscription(subscription)

        return end

    def _take(self) -> None:
        # Backwards: what is taken last has had the longest time to come.
        batches = [(act, list(_pending(subscription))) for subscription, act in reversed(self._taken)]
        for act, batch in reversed(batches):
            for data in batch:
                act(data)
        self._then()


def _pending(subscription: Any) -> Iterator[bytes]:
    with subscription.handle:
        while (found := subscription.handle.take_message(subscription.msg_type, True)) is not None:
            yield found[0]
