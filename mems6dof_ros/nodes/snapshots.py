"""Now and then one image of a topic, for those who only look at them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from sensor_msgs.msg import Image

from mems6dof_ros.nodes import transport


class Snapshots:
    """At most ``rate`` serialized images per second of ``topic``, handed to ``take`` while ``wanted()``.

    A standing subscription would carry every frame across DDS once more, 8.4 MB at 90 Hz, and the
    measurement would feel it. So a subscription lives only from one request until the next image.
    """

    def __init__(
        self, node: Node, topic: str, rate: float, wanted: Callable[[], bool], take: Callable[[bytes], None]
    ) -> None:
        self._node, self._topic = node, topic
        self._wanted, self._take = wanted, take
        self._subscription: Any = None
        # Wall time: a page is looked at also while simulated time stands still.
        node.create_timer(1 / rate, self._ask, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def _ask(self) -> None:
        wanted = self._wanted()
        if wanted and self._subscription is None:
            self._subscription = self._node.create_subscription(
                Image, self._topic, self._on_image, transport.for_images(self._node, self._topic), raw=True
            )
        elif not wanted:
            self._cancel()

    def _on_image(self, data: bytes) -> None:
        if self._subscription is not None:
            self._cancel()
            self._take(data)

    def _cancel(self) -> None:
        if self._subscription is not None:
            self._node.destroy_subscription(self._subscription)
            self._subscription = None
