"""Images to be recorded, whichever way they come: each once, as it is published on the topic."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any

from mems6dof_ros.errors import InputError
from mems6dof_ros.nodes import transport
from mems6dof_ros.nodes.common import InstrumentNode
from mems6dof_ros.nodes.image_route import ImageRoute
from mems6dof_ros.recording import messages

_INFO = "mems6dof_msgs/msg/FrameInfo"

#: Calls with a serialized message and rclpy's dict about it.
Record = Callable[[bytes | memoryview, dict[str, Any]], None]


class RecordedImages:
    """Hands each image to ``record``, and how many were missed to ``lost`` with the reason."""

    def __init__(
        self,
        node: InstrumentNode,
        subscribe: Callable[[], None],
        unsubscribe: Callable[[], None],
        record: Record,
        lost: Callable[[int, str], None],
    ) -> None:
        messages.prepare(_INFO, "sensor_msgs/msg/Image")  # else images are lost meanwhile
        self._route = ImageRoute(node, subscribe, unsubscribe, acknowledging=True)
        self._record, self._lost = record, lost
        # Stamps of what came by the topic before its info; of what infos told that is to come by the topic;
        # and of what came out of memory and may come by the topic too. Recordings repeat their stamps, so
        # none stays when both have come.
        self._by_topic: deque[int] = deque(maxlen=64)
        self._awaited: deque[int] = deque(maxlen=64)
        self._from_memory: deque[int] = deque(maxlen=64)
        self.tick = self._route.tick
        node.health.gauge("images by", lambda: self._route.way)

    def on_info(self, data: bytes, about: dict[str, Any]) -> None:
        """A serialized frame_info has come, and with it perhaps its image in memory."""
        try:
            info = messages.deserialize(data, _INFO)
            stamp_ns = messages.nanoseconds(info.header.stamp)
        except Exception:  # whatever a reader of nonsense stumbles over: it tells of no image
            return
        shared = self._route.find(info.header, stamp_ns)
        if stamp_ns in self._by_topic:
            self._by_topic.remove(stamp_ns)
        elif shared:
            image = messages.serialize(messages.image(messages.to_frame(shared)))
            if shared.intact():
                self._record(image, about)
                self._from_memory.append(stamp_ns)
            else:
                self._miss(info.frame_counter)
        elif self._route.overtaken(stamp_ns):
            self._miss(info.frame_counter)
        else:
            self._awaited.append(stamp_ns)
        self._route.choose(stamp_ns, shared is not None)
        if not self._route.by_topic:
            self._from_memory.clear()

    def _miss(self, frame_counter: int) -> None:
        self._lost(1, f"frame {frame_counter} was overwritten before it was recorded")

    def on_image(self, data: bytes, about: dict[str, Any]) -> None:
        """A serialized image has come by the topic."""
        try:
            stamp_ns = transport.stamp_of(data)
        except InputError:
            stamp_ns = 0
        if stamp_ns in self._from_memory:
            self._from_memory.remove(stamp_ns)
            return
        if stamp_ns in self._awaited:
            self._awaited.remove(stamp_ns)
        else:
            self._by_topic.append(stamp_ns)
        self._record(data, about)
