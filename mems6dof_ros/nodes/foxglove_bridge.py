"""``foxglove_bridge``: the topics for Foxglove and Lichtblick, where ROS has no bridge of its own.

Serves the Foxglove WebSocket protocol with the messages as they come over the wire and their definitions
with comments. A topic is subscribed to while somebody looks at it; images only now and then, see
``snapshots``. It only reads: the protocol knows no origin and no token, so that any web site could
otherwise steer the instrument.
"""

from __future__ import annotations

import importlib
import sys
import time
from collections.abc import Callable
from typing import Any

from rclpy.clock import Clock, ClockType

from mems6dof_ros.errors import InputError, Mems6dofError
from mems6dof_ros.monitor.access import is_loopback
from mems6dof_ros.nodes import transport
from mems6dof_ros.nodes.common import InstrumentNode, run
from mems6dof_ros.nodes.onlooker import give_way
from mems6dof_ros.nodes.parameters import Parameter
from mems6dof_ros.nodes.recorder import KNOWN_TYPES
from mems6dof_ros.nodes.snapshots import Snapshots
from mems6dof_ros.recording import topics
from mems6dof_ros.recording.definitions import definition

PARAMETERS = (
    Parameter("address", "127.0.0.1", "Address to listen on; whoever reaches another one sees everything."),
    Parameter("port", 8765, "TCP port to listen on; 0: any free one.", span=(0, 65535)),
    Parameter("image_rate", 2.0, "Images passed on per second while somebody looks.", "Hz", (0.1, 30.0)),
)
_PERIOD = 0.2  # s; how soon a topic is subscribed to when somebody looks at it


class FoxgloveBridgeNode(InstrumentNode):
    """Passes messages on, undecoded."""

    def __init__(self) -> None:
        super().__init__("foxglove_bridge", PARAMETERS)

    def configure(self) -> None:
        try:
            import foxglove
        except ModuleNotFoundError as error:
            raise Mems6dofError("foxglove_bridge needs foxglove-sdk: pip install foxglove-sdk") from error
        address, port = self.values["address"], self.values["port"]
        # Kept: channels vanish with the context.
        self._foxglove = context = foxglove.Context()
        self._channels: dict[str, Any] = {
            topic: foxglove.Channel(
                self.resolve_topic_name(topic),
                message_encoding="cdr",
                schema=foxglove.Schema(name=kind, encoding="ros2msg", data=definition(kind).schema.encode()),
                context=context,
            )
            for topic, kind in KNOWN_TYPES.items()
        }
        try:
            self._server = foxglove.start_server(name="mems6dof", host=address, port=port, context=context)
        except (OSError, RuntimeError, ValueError) as error:
            raise InputError(f"address {address}, port {port}", str(error), "both free here") from error

    def activate(self) -> None:
        address = self.values["address"]
        self._taken: dict[str, Any] = {}
        self.create_timer(_PERIOD, self._follow_viewers, clock=Clock(clock_type=ClockType.STEADY_TIME))
        Snapshots(
            self,
            topics.IMAGE,
            self.values["image_rate"],
            self._channels[topics.IMAGE].has_sinks,
            self._passing_on(topics.IMAGE),
        )
        self.tell(f"Foxglove WebSocket: ws://{address}:{self._server.port}")
        if not is_loopback(address):
            self.get_logger().warning("everybody who reaches this address can see everything")

    def cleanup(self) -> None:
        self._server.stop()

    def _follow_viewers(self) -> None:
        """Subscribe to what somebody looks at, and to nothing else."""
        for topic, channel in self._channels.items():
            if topic == topics.IMAGE or channel.has_sinks() == (topic in self._taken):
                continue
            if topic in self._taken:
                self.destroy_subscription(self._taken.pop(topic))
                continue
            package, name = KNOWN_TYPES[topic].split("/msg/")
            kind = getattr(importlib.import_module(f"{package}.msg"), name)
            self._taken[topic] = self.create_subscription(
                kind, topic, self._passing_on(topic), transport.MESSAGES, raw=True
            )

    def _passing_on(self, topic: str) -> Callable[[bytes], None]:
        channel = self._channels[topic]

        def pass_on(data: bytes) -> None:
            channel.log(data, log_time=time.time_ns())
            self.health.count("messages")

        return pass_on


def main(args: list[str] | None = None) -> int:
    """Run the node; returns the exit status."""
    give_way()
    return run(FoxgloveBridgeNode, args)


if __name__ == "__main__":
    sys.exit(main())
