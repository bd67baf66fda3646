"""``listener``: takes frames and does nothing with them, the limit of every arrangement of nodes.

Answers each image with an empty ``localizations`` that tells when it arrived, so that a source can be paced
by it and latencies can be read from it.
"""

from __future__ import annotations

import sys
import time

from sensor_msgs.msg import Image

from mems6dof_msgs.msg import FrameInfo, Localizations
from mems6dof_ros.nodes import transport
from mems6dof_ros.nodes.common import InstrumentNode, run
from mems6dof_ros.recording import messages, topics


class ListenerNode(InstrumentNode):
    """Subscribes to what a localizer subscribes to."""

    def __init__(self) -> None:
        super().__init__("localizer", ())
        self._info: FrameInfo | None = None

    def activate(self) -> None:
        self._answers = self.create_publisher(Localizations, topics.LOCALIZATIONS, transport.MESSAGES)
        self.create_subscription(FrameInfo, topics.FRAME_INFO, self._on_info, transport.MESSAGES)
        self.create_subscription(Image, topics.IMAGE, self._on_image, transport.FRAMES)

    def _on_info(self, info: FrameInfo) -> None:
        self._info = info

    def _on_image(self, image: Image) -> None:
        arrival = messages.to_rclpy(messages.time(time.time_ns()))
        answer = Localizations(header=image.header, publication_time=arrival)
        if self._info is not None and self._info.header.stamp == image.header.stamp:
            answer.frame_counter = self._info.frame_counter
            answer.frame_publication_time = self._info.publication_time
        self._answers.publish(answer)


def main(args: list[str] | None = None) -> int:
    """Run the node; returns the exit status."""
    return run(ListenerNode, args)


if __name__ == "__main__":
    sys.exit(main())
