"""Which way images come: out of the memory that ``frame_source`` shares, or by their topic."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

from rclpy.node import Node

from mems6dof_ros.nodes.shared_frames import SharedFrames, SharedImage, ring_path
from mems6dof_ros.recording import topics

#: Shared frames in a row, each within so many seconds of the one before, upon which the topic is left; and
#: without an info for that time it is subscribed to again, since somebody else may publish there.
_SHARED_IN_A_ROW, _SOON = 3, 1.0


class ImageRoute:
    """For a node that takes ``frame_info``: finds the images that they tell of in shared memory, and
    ``subscribe``s to the topic of images, or ``unsubscribe``s, accordingly. It is subscribed to at first.

    ``acknowledging``: the node must not miss a frame, though the source does not hear from it but by the
    topic: while the source waits for its readers, memory is left alone.
    """

    def __init__(
        self,
        node: Node,
        subscribe: Callable[[], None],
        unsubscribe: Callable[[], None],
        acknowledging: bool = False,
    ) -> None:
        info_topic = node.resolve_topic_name(topics.FRAME_INFO)
        self._shared = SharedFrames(ring_path(info_topic, node.context.get_domain_id()))
        self._subscribe, self._unsubscribe, self._acknowledging = subscribe, unsubscribe, acknowledging
        self._in_a_row, self._informed_at = 0, -math.inf
        self.by_topic = True
        self._attend()

    @property
    def way(self) -> str:
        """By which images come, in words."""
        return "topic" if self.by_topic else "shared memory"

    def find(self, header: Any, stamp_ns: int) -> SharedImage | None:
        """The image with ``header`` of an info that has just come, None where it comes by the topic."""
        self._attend()
        if self._acknowledging and self._shared.waits_for_readers:
            return None
        return self._shared.find(header, stamp_ns)

    def overtaken(self, stamp_ns: int) -> bool:
        """It does not come at all: in memory are later ones, and the topic has been left."""
        return not self.by_topic and self._shared.overtaken(stamp_ns)

    def choose(self, stamp_ns: int, shared: bool, settled: bool = True) -> None:
        """Go on by the topic, or no more, after an info whose image is ``shared`` or not; one that came too
        late for its image says nothing. ``settled``: nothing is awaited by the topic."""
        soon = time.monotonic() - self._informed_at < _SOON
        self._informed_at = time.monotonic()
        self._in_a_row = self._in_a_row + 1 if shared and soon else 0
        if self.by_topic and self._in_a_row >= _SHARED_IN_A_ROW and settled:
            self.by_topic = False
            self._unsubscribe()
        elif not (self.by_topic or shared or self._shared.overtaken(stamp_ns)):
            self._return_to_topic()

    def tick(self) -> None:
        """To be called several times a second."""
        self._attend()
        if not self.by_topic and time.monotonic() - self._informed_at > _SOON:
            self._return_to_topic()

    def _return_to_topic(self) -> None:
        self.by_topic = True
        self._subscribe()

    def _attend(self) -> None:
        """Ask for frames in memory, unless they are of no use."""
        self._shared.attend(wanted=not (self._acknowledging and self._shared.waits_for_readers))
