"""``synthetic_gear``: the traffic of an instrument without its computations, to measure those who watch it.

Publishes what the nodes do, from ``monitor.synthetic``, and has some of their services.
"""

from __future__ import annotations

import sys
from collections.abc import Callable

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock, ClockType
from sensor_msgs.msg import Image
from std_srvs.srv import Trigger

from mems6dof_msgs.msg import FrameInfo, GroundTruth, Localizations, Pose6DOF
from mems6dof_ros.monitor.synthetic import Machine
from mems6dof_ros.nodes import transport
from mems6dof_ros.nodes.common import InstrumentNode, run
from mems6dof_ros.nodes.parameters import Parameter
from mems6dof_ros.recording import messages, topics

PARAMETERS = (
    Parameter("rate", 90.0, "Motion cycles per second.", "Hz", (0.1, 1000.0)),
    Parameter("size", 1024, "Width and height of the images.", "px", (64, 8192)),
    Parameter("image_every", 9, "Cycles from one image to the next; 0: no images.", "cycles", (0, 1000)),
)


class SyntheticGearNode(InstrumentNode):
    """The machine behind its topics."""

    def __init__(self) -> None:
        super().__init__("synthetic_gear", PARAMETERS)

    def configure(self) -> None:
        self._machine = Machine(size=self.values["size"])
        self._number = 0
        self._running = True

    def activate(self) -> None:
        self._image = self.create_publisher(Image, topics.IMAGE, transport.FRAMES)
        self._info, self._truth, self._found, self._pose, self._diagnostics = (
            self.create_publisher(kind, topic, transport.MESSAGES)
            for topic, kind in (
                (topics.FRAME_INFO, FrameInfo),
                (topics.TRUTH, GroundTruth),
                (topics.LOCALIZATIONS, Localizations),
                (topics.POSE_6DOF, Pose6DOF),
                ("/diagnostics", DiagnosticArray),
            )
        )
        self._serve("frame_source/start", lambda: setattr(self, "_running", True))
        self._serve("frame_source/stop", lambda: setattr(self, "_running", False))
        self._serve("pose_estimator/set_reference")
        self._serve("recorder/start")
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(1 / self.values["rate"], self._turn, clock=steady)
        self.create_timer(1.0, self._diagnose, clock=steady)

    def _serve(self, name: str, effect: Callable[[], None] = lambda: None) -> None:
        def answer(_: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
            effect()
            response.success, response.message = True, f"{name} done"
            return response

        self.create_service(Trigger, name, answer)

    def _diagnose(self) -> None:
        frames = DiagnosticStatus(level=b"\x00", name="localizer: frames", message="90.0 frames/s")
        frames.values = [KeyValue(key="queue", value="0"), KeyValue(key="fits_per_second", value="8600")]
        disk = DiagnosticStatus(level=b"\x01", name="recorder: disk", message="12 GB left, 9 minutes")
        self._diagnostics.publish(DiagnosticArray(status=[frames, disk]))

    def _turn(self) -> None:
        """One motion cycle."""
        if not self._running:
            return
        every = self.values["image_every"]
        with_image = every > 0 and self._number % every == 0
        frame, found, pose = self._machine.cycle(self._number, image=with_image)
        transport.publish(self._info, messages.frame_info(frame))
        if with_image:
            transport.publish(self._image, messages.image(frame))
        for truth in messages.ground_truths(frame):
            transport.publish(self._truth, truth)
        transport.publish(self._found, messages.localizations(found))
        transport.publish(self._pose, messages.pose6dof(pose))
        self._number += 1


def main(args: list[str] | None = None) -> int:
    """Run the node; returns the exit status."""
    return run(SyntheticGearNode, args, frames=True)


if __name__ == "__main__":
    sys.exit(main())
