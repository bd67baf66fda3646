"""Subscriptions with a thread of their own, for what arrives with every motion cycle."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any, NamedTuple

from rclpy.callback_groups import CallbackGroup
from rclpy.guard_condition import GuardCondition
from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy
from rclpy.node import Node
from rclpy.qos import QoSProfile

from mems6dof_ros.nodes import transport


class OutOfExecutor(CallbackGroup):
    """Keeps what is in it out of what an executor waits for."""

    def can_execute(self, entity: Any) -> bool:
        return False

    def beginning_execution(self, entity: Any) -> bool:
        return False

    def ending_execution(self, entity: Any) -> None:
        pass


class _Subscribed(NamedTuple):
    subscription: Any
    act: Callable[..., None]
    informed: bool


class Stream:
    """Waits for a few topics only and calls back in its own thread; ``subscribe``, ``begin``, ``end``. What
    is called back may ``subscribe`` and ``unsubscribe`` too.

    An executor of rclpy builds its list of all that a node has (parameter and lifecycle services, timers)
    anew each time it waits, which takes half a millisecond of Python. A callback may block, as Worker.put
    does: what arrives meanwhile stays in the middleware, and the executor goes on. ``tick`` is called every
    ``period`` s, later after a callback that was blocked. An exception ends the thread and is given to
    ``failed``.
    """

    def __init__(
        self,
        node: Node,
        failed: Callable[[BaseException], None],
        tick: Callable[[], None] = lambda: None,
        period: float = 0.1,
    ) -> None:
        self._node, self._failed, self._tick, self._period = node, failed, tick, period
        self._group = OutOfExecutor()
        self._subscriptions: list[_Subscribed] = []
        self._changed = False
        self._wake = GuardCondition(None, None, context=node.context)
        self._ending = False
        self._thread = threading.Thread(target=self._run, name="stream", daemon=True)

    def subscribe(
        self,
        kind: type,
        topic: str,
        act: Callable[..., None],
        quality: QoSProfile = transport.MESSAGES,
        raw: bool = False,
        informed: bool = False,
    ) -> None:
        """Call ``act`` with each message, ``raw``: serialized, ``informed``: and with rclpy's dict about it.
        Of what has arrived together, topics take turns, in the order of their subscriptions. The node
        destroys the subscription."""
        subscription = self._node.create_subscription(
            kind, topic, act, quality, callback_group=self._group, raw=raw
        )
        # The subscription's own callback refuses what act refuses.
        self._subscriptions.append(_Subscribed(subscription, subscription.callback, informed))
        self._changed = True

    def unsubscribe(self, topic: str) -> None:
        """Take no more messages of ``topic``."""
        name = self._node.resolve_topic_name(topic)
        for each in [each for each in self._subscriptions if each.subscription.topic_name == name]:
            self._subscriptions.remove(each)
            self._node.destroy_subscription(each.subscription)
        self._changed = True

    def begin(self) -> None:
        """Take messages from now on."""
        self._thread.start()

    def ask_to_end(self) -> None:
        """Take no more messages."""
        self._ending = True
        self._wake.trigger()

    def end(self) -> None:
        """Take no more messages, and wait for the callback that runs."""
        self.ask_to_end()
        if self._thread.is_alive():
            self._thread.join()

    def _run(self) -> None:
        self._ticked = time.monotonic()
        try:
            while not self._ending and self._node.context.ok():
                self._wait_for(self._subscriptions)
        except BaseException as error:  # handed to the main thread, which ends the node
            self._failed(error)

    def _wait_for(self, subscriptions: list[_Subscribed]) -> None:
        """Take what comes, until there is something else to wait for."""
        self._changed = False
        with ExitStack() as held:
            handles = [each.subscription.handle for each in subscriptions]
            guard, context = self._wake.handle, self._node.context.handle
            for handle in (*handles, guard, context):
                held.enter_context(handle)
            waiting = _rclpy.WaitSet(len(handles), 1, 0, 0, 0, 0, context)
            while not self._changed and not self._ending and self._node.context.ok():
                waiting.clear_entities()
                for handle in handles:
                    waiting.add_subscription(handle)
                waiting.add_guard_condition(guard)
                waiting.wait(max(int((self._ticked + self._period - time.monotonic()) * 1e9), 0))
                self._take(subscriptions)
                if time.monotonic() - self._ticked >= self._period:
                    self._tick()
                    self._ticked = time.monotonic()

    def _take(self, subscriptions: list[_Subscribed]) -> None:
        """One message of each topic in turn, until there is none or the tick is due."""
        while time.monotonic() - self._ticked < self._period:
            taken = False
            for subscription, act, informed in subscriptions:
                found = subscription.handle.take_message(subscription.msg_type, subscription.raw)
                if found is not None:
                    taken = True
                    act(*found) if informed else act(found[0])
                if self._ending or self._changed:
                    return
            if not taken:
                return
