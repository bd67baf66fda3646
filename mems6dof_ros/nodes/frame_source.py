"""``frame_source``: publishes the frames of a camera, a simulator, images, a video or a bag.

::

    WAITING ──▶ RUNNING ◀──▶ STOPPED      ~/start, ~/stop; ~/step: one frame, then STOPPED
                   │
                   ▼
                 ENDED ──▶ exit, or ~/start to begin again

while the node is active, and nothing is published while it is not; ``~/start`` and ``~/step`` bring it up.
Deactivated it keeps its place among the frames, cleaned up it closes the source.

Topics (relative): ``frame_info``, ``truth`` where the source knows it, ``camera_info``, and then
``image_raw``, all with one header; before them, with ``publish_clock``, ``/clock``. A camera adds the service
of ``nodes.camera``. With ``simulator.commanded`` also those of ``nodes.actuation``;
a source that is a Stage (``simulator.substrate``) adds the service of ``nodes.stage``.
"""

from __future__ import annotations

import enum
import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from rcl_interfaces.msg import SetParametersResult
from rclpy.duration import Duration
from rclpy.parameter import Parameter as RosParameter
from rclpy.publisher import Publisher
from rosgraph_msgs.msg import Clock
from std_srvs.srv import Trigger

from mems6dof_msgs.msg import Localizations, Pose6DOF
from mems6dof_ros.errors import InputError, Mems6dofError
from mems6dof_ros.frame import NAN, Frame
from mems6dof_ros.nodes import transport
from mems6dof_ros.nodes.actuation import serve_commanded_simulator
from mems6dof_ros.nodes.camera import adjust_camera, camera_parameters, serve_camera
from mems6dof_ros.nodes.common import WAIT_PARAMETER, InstrumentNode, run
from mems6dof_ros.nodes.parameters import START_PAUSED, Parameter, of_settings
from mems6dof_ros.nodes.schedule import Schedule
from mems6dof_ros.nodes.shared_frames import FrameRing, ring_path
from mems6dof_ros.nodes.stage import serve_stage
from mems6dof_ros.recording import messages, topics
from mems6dof_ros.simulation.settings import SimulationSettings
from mems6dof_ros.sources.cameras.camera import CameraSource
from mems6dof_ros.sources.replay import Replay
from mems6dof_ros.sources.simulator import CommandedSimulator
from mems6dof_ros.sources.source import SOURCES, FrameSource, open_source
from mems6dof_ros.sources.stage import Stage

#: What tells that a frame has been dealt with, and its type.
ACKNOWLEDGING = {topics.LOCALIZATIONS: Localizations, topics.POSE_6DOF: Pose6DOF}

PARAMETERS = (
    Parameter("source", "simulator", "Where frames come from.", choices=tuple(SOURCES)),
    Parameter(
        "pacing",
        "rate",
        "When the next frame is published: rate: so many a second; consumer: as soon as fewer frames are in"
        " flight than window, so that nothing is lost; step: at each call of ~/step.",
        choices=("rate", "consumer", "step"),
    ),
    Parameter(
        "rate",
        10.0,
        "Frames per second with pacing rate; 0: as the source delivers them. A camera sets its own pace.",
        "Hz",
        (0.0, 10_000.0),
        changeable=True,
    ),
    Parameter(
        "speed",
        0.0,
        "No frame is published earlier than its stamp says at so many times the recorded pace, with pacing"
        " consumer, or with pacing rate in place of a rate; 0: stamps do not matter.",
        "1",
        (0.0, 1000.0),
        changeable=True,
    ),
    Parameter(
        "begin",
        0.0,
        "What comes earlier after the first stamp of a recording is left out.",
        "s",
        (0.0, 1e9),
    ),
    Parameter(
        "loop",
        False,
        "Begin again after the last frame, with stamps, frame counters and cycles that follow the last ones.",
    ),
    Parameter(
        "publish_clock",
        False,
        "Publish /clock, the stamp of each frame before the frame, for nodes with use_sim_time.",
    ),
    Parameter(
        "window",
        4,
        "Frames in flight with pacing consumer.",
        "frames",
        (1, transport.FRAMES.depth),
        changeable=True,
    ),
    Parameter(
        "acknowledged_by",
        topics.LOCALIZATIONS,
        "Topic that tells that a frame has been dealt with, with pacing consumer.",
        choices=tuple(ACKNOWLEDGING),
    ),
    Parameter(
        "acknowledge_timeout",
        30.0,
        "Time after which a frame that nobody acknowledged counts as lost and the next one is published.",
        "s",
        (0.1, 3600.0),
    ),
    Parameter(
        "share_frames",
        True,
        "Frames also go by memory that is shared with a localizer or recorder on this host, which then leaves"
        " the topic.",
    ),
    START_PAUSED,
    Parameter(
        "at_end", "exit", "What to do after the last frame of a finite source.", choices=("exit", "idle")
    ),
    replace(WAIT_PARAMETER, default=(f"{topics.IMAGE}:1",)),
    Parameter(
        "simulator.commanded",
        False,
        "The gear turns only as actuation_command asks, a frame for each motion cycle; use with rate 0.0.",
    ),
    Parameter(
        "simulator.substrate",
        False,
        "Beads on a plane substrate in place of the gear, and the stage that the calibrator moves.",
    ),
    Parameter("simulator.substrate_beads", 200, "Beads in the disc about the image.", "1", (1, 10_000)),
    Parameter(
        "simulator.substrate_rotation",
        0.0,
        "Orientation of the substrate about the optical axis.",
        "rad",
        (-7.0, 7.0),
    ),
    Parameter("simulator.cycles", 0, "Motion cycles to simulate; 0: no end.", "cycles", (0, 2**31 - 1)),
    Parameter(
        "simulator.loop",
        0,
        "Motion cycles to render at the start and then repeat, which delivers full frames at any rate; 0:"
        " render each frame when it is due.",
        "cycles",
        (0, 10_000),
    ),
    *of_settings(SimulationSettings, "simulator."),
    Parameter("images.path", "", "TIFF stack, or folder of images."),
    Parameter(
        "images.pixel_size",
        NAN,
        "Image pixel size in object space, where the files do not tell.",
        "m",
        optional=True,
    ),
    Parameter(
        "images.step",
        NAN,
        "Axial distance from image to image, where the files do not tell.",
        "m",
        optional=True,
    ),
    Parameter("images.start", 0.0, "Position of the focal plane of the first image.", "m", (-1.0, 1.0)),
    Parameter("images.period", 0.1, "Time between images, for their stamps.", "s", (1e-6, 1e6)),
    Parameter("images.saturation_adu", 0, "Largest pixel value; 0: unknown.", "ADU", (0, 65535)),
    Parameter("bag.path", "", "Directory of a rosbag2 bag, or an .mcap file."),
    Parameter("bag.topic", "", "Topic of the images; empty: the only one, or the only one named image_raw."),
    Parameter("video.path", "", "Video file; exact where it is grey and lossless, such as FFV1."),
    Parameter("video.pixel_size", NAN, "Image pixel size in object space.", "m", optional=True),
    Parameter("video.saturation_adu", 0, "Largest pixel value; 0: unknown.", "ADU", (0, 65535)),
    *camera_parameters(),
)

#: What is published.
_TYPES = {
    topics.IMAGE: "sensor_msgs/msg/Image",
    topics.FRAME_INFO: "mems6dof_msgs/msg/FrameInfo",
    topics.CAMERA_INFO: "sensor_msgs/msg/CameraInfo",
    topics.TRUTH: "mems6dof_msgs/msg/GroundTruth",
}
_READERS_PATIENCE = 1.0  # s; longer than a loaded host takes to hand over a few frames
_LONGEST_READ = 30.0  # s; a simulator renders a full frame in much less, a device answers within 1 s


class State(enum.Enum):
    """See the module."""

    WAITING = enum.auto()
    RUNNING = enum.auto()
    STOPPED = enum.auto()
    ENDED = enum.auto()


class FrameSourceNode(InstrumentNode):
    """Reads frames from a FrameSource and publishes them at the pace that is asked for."""

    def __init__(self, name: str = "frame_source", parameters: Sequence[Parameter] = PARAMETERS) -> None:
        super().__init__(name, parameters)
        self._changed = threading.Condition()
        self._state = State.WAITING
        self._in_flight: dict[int, float] = {}  # stamp in ns: when published, monotonic s
        self._schedule = Schedule()
        self._sent_images = 0  # since all readers of the topic had all
        self._readers_follow = True
        self._source: FrameSource | None = None
        self._ring: FrameRing | None = None
        self.create_service(Trigger, "~/start", self._on_start)
        self.create_service(Trigger, "~/stop", self._on_stop)
        self.create_service(Trigger, "~/step", self._on_step)
        self.health.gauge("frames in flight", lambda: len(self._in_flight))
        self.add_on_set_parameters_callback(self._on_parameters)
        self.add_post_set_parameters_callback(lambda _: self._wake())

    def configure(self) -> None:
        self._source = open_source(self.values["source"], **self._options())
        self._frames = Replay(self._source, begin=self.values["begin"], loop=self.values["loop"])
        info = self._frames.info
        self.get_logger().info(
            f"{info.kind}: {info.width} x {info.height} px {info.encoding},"
            f" {'no end' if info.frames is None else f'{info.frames} frames'}"
        )
        self._state = State.WAITING
        self._begin_as = State.STOPPED if self.values["start_paused"] else State.RUNNING
        self._steps = 0
        self._playing = False  # the source has been started and has not ended
        self._held: Frame | None = None  # read, but not yet published
        self._topics: dict[str, Publisher] = {}
        for topic, kind in _TYPES.items():
            quality = transport.FRAMES if topic == topics.IMAGE else transport.MESSAGES
            self._topics[topic] = self.create_publisher(messages.rclpy_type(kind), topic, quality)
        messages.prepare(*_TYPES.values())
        self._ring = self._make_ring() if self.values.get("share_frames") else None
        wanted = self.values["publish_clock"]
        self._clocks = self.create_publisher(Clock, "/clock", transport.MESSAGES) if wanted else None

    def _make_ring(self) -> FrameRing | None:
        """None where there is no room for it, which costs time but loses nothing."""
        info = self._frames.info
        size = info.width * info.height * np.dtype(messages.PIXEL_TYPES[info.encoding]).itemsize
        topic = self._topics[topics.FRAME_INFO].topic_name
        try:
            path = ring_path(topic, self.context.get_domain_id())
            return FrameRing(path, size, waits_for_readers=self.values["pacing"] == "consumer")
        except OSError as error:
            self.get_logger().info(f"frames go by the topic alone: {error}")
            return None

    def activate(self) -> None:
        if self.values["pacing"] == "consumer":
            topic = self.values["acknowledged_by"]
            kind = ACKNOWLEDGING[topic]
            self.create_subscription(kind, topic, self._on_acknowledged, transport.MESSAGES, raw=True)
        if isinstance(self._source, CommandedSimulator):
            serve_commanded_simulator(self, self._source)
        if isinstance(self._source, CameraSource):
            serve_camera(self, self._source)
        if isinstance(self._source, Stage):
            serve_stage(self, self._source)
        self._abandon = False
        self._in_flight.clear()
        self._thread = threading.Thread(target=self._run, name="frames", daemon=True)
        self._begin_when_ready()

    def _begin_when_ready(self) -> None:
        """Begin when everybody listens."""
        self.when_ready(self.missing_subscribers(self._topics), self._thread.start)

    def deactivate(self) -> None:
        with self._changed:
            self._abandon = True
            self._changed.notify_all()
        if self._thread.is_alive():
            self._thread.join(_LONGEST_READ)
        if self._thread.is_alive():
            raise Mems6dofError(
                f"the source {self.values['source']} is still busy with a frame after {_LONGEST_READ:g} s"
            )
        if self._state in (State.RUNNING, State.STOPPED):
            self._begin_as, self._state = self._state, State.WAITING
        super().deactivate()

    def cleanup(self) -> None:
        self._frames.stop()
        if self._ring:
            self._ring.close()
        self._ring = None
        self._source = None
        self.get_logger().info(
            f"{self.health.total('frames')} frames published, {self.health.total('refused')} refused,"
            f" {self.health.total('lost')} lost"
        )

    def _options(self) -> dict[str, Any]:
        """Options of the chosen source, from the parameters that begin with its name."""
        prefix = self.values["source"] + "."
        options = {
            name.removeprefix(prefix): value for name, value in self.values.items() if name.startswith(prefix)
        }
        if options.get("path") == "":
            raise InputError(
                f"parameter {prefix}path", "no path", f"what source '{self.values['source']}' reads"
            )
        return options

    # The thread of the frames -------------------------------------------------------------------

    def _run(self) -> None:
        try:
            if self._state is State.WAITING:
                self._set_state(self._begin_as)
            while self._wait_until_wanted():
                self._play()
                if self._state is State.ENDED and self.values["at_end"] == "exit":
                    self.finished.set()
                    return
        except BaseException as error:  # handed to the main thread, which ends the node
            self.failure = error

    def _play(self) -> None:
        """Publish the source from its first frame, or from where it was left, to its last."""
        if not self._playing:
            self._frames.start()
            self._playing = True
        while self._wait_until_wanted():
            try:
                frame = self._held or self._frames.read(timeout=1.0)
            except TimeoutError as error:
                self._tell_of_silence(error)
                continue
            except InputError as error:
                self.health.refused(str(error))
                continue
            if frame is None:
                break
            self._held = frame
            if not self._wait_for_turn(frame):
                continue
            self._held = None
            if self._clocks:
                self._clocks.publish(Clock(clock=messages.to_rclpy(messages.time(frame.stamp_ns))))
            self._deliver(frame)
            with self._changed:
                self._steps = max(self._steps - 1, 0)
        else:
            return
        self._playing = False
        self._wait_for_consumer(0)
        self._wait_for_readers(0)
        self._set_state(State.ENDED)

    def _tell_of_silence(self, error: TimeoutError) -> None:
        """Only a camera that is away is a problem; one that is not triggered is silent too."""
        if isinstance(self._source, CameraSource) and not self._source.status.connected:
            self.health.lost(0, f"camera {self._source.status.name} is away")
        self.health.state = str(error) or "the source delivers no frames"

    def _deliver(self, frame: Frame) -> None:
        """What is done with a frame whose turn has come."""
        with self._changed:
            self._in_flight[frame.stamp_ns] = time.monotonic()
        start = time.monotonic()
        self._publish(frame)
        self.health.time("publishing", time.monotonic() - start)

    def _publish(self, frame: Frame, published_ns: int | None = None) -> None:
        """Publish; ``published_ns``: when it was made known already, host clock."""
        # Messages are made only for somebody, and most of them before the clock of the latency runs.
        made = [
            (self._topics[topic], bytes(messages.serialize(message)))
            for topic, several in (
                (topics.TRUTH, messages.ground_truths),
                (topics.CAMERA_INFO, lambda frame: [messages.camera_info(frame)]),
                (topics.IMAGE, lambda frame: [messages.image(frame)]),
            )
            if self._topics[topic].get_subscription_count()
            for message in several(frame)
        ]
        frame = replace(frame, published_ns=published_ns or time.time_ns())
        if self._ring and self._ring.wanted:
            self._ring.write(frame)
        transport.publish(self._topics[topics.FRAME_INFO], messages.frame_info(frame))
        for publisher, message in made:
            publisher.publish(message)
            self._sent_images += publisher is self._topics[topics.IMAGE]
        self.health.count("frames")
        if frame.frames_dropped:
            self.health.lost(frame.frames_dropped, f"the source lost {frame.frames_dropped} frames")

    # Pacing -------------------------------------------------------------------------------------

    def _wanted(self) -> bool:
        """A frame is to be published as soon as it is due."""
        running = self._state is State.RUNNING and self.values["pacing"] != "step"
        return not self._abandon and (running or self._steps > 0)

    def _wait_until_wanted(self) -> bool:
        """Wait while stopped without a step to make; False: the node ends."""
        with self._changed:
            if not self._wanted():
                self._schedule.restart()
            self._changed.wait_for(lambda: self._abandon or self._wanted())
        return not self._abandon

    def _wait_for_turn(self, frame: Frame) -> bool:
        """Wait until ``frame`` may be published; False: it is not wanted any more."""
        if self.values["pacing"] == "consumer":
            self._wait_for_consumer(self.get_parameter("window").value - 1)
            self._wait_for_readers(transport.FRAMES.depth // 2)
        else:
            self._in_flight.clear()
        with self._changed:
            while self._wanted():
                pace = self._pace()
                left = self._schedule.due(frame.stamp_ns, *pace) - time.monotonic()
                if left <= 0 or self._steps > 0:
                    in_time = self._schedule.keep(frame.stamp_ns, time.monotonic(), *pace)
                    if not in_time and self.values["pacing"] == "rate":
                        self.health.count("frames late")
                    return True
                self._changed.wait(left)
        return False

    def _pace(self) -> tuple[float, float]:
        """Rate and speed for the schedule."""
        if isinstance(self._source, CameraSource):
            return 0.0, 0.0
        rate = self.get_parameter("rate").value if self.values["pacing"] == "rate" else 0.0
        return rate, self.get_parameter("speed").value

    def _wake(self) -> None:
        with self._changed:
            self._changed.notify_all()

    def _on_parameters(self, changes: list[RosParameter]) -> SetParametersResult:
        if isinstance(self._source, CameraSource):
            return adjust_camera(self._source, self.values["source"], changes)
        return SetParametersResult(successful=True)

    def _wait_for_consumer(self, in_flight: int) -> None:
        """Wait until at most ``in_flight`` frames are neither acknowledged nor given up."""
        if self.values["pacing"] != "consumer":
            return
        timeout = self.values["acknowledge_timeout"]
        with self._changed:
            while len(self._in_flight) > in_flight and not self._abandon:
                stamp, published = next(iter(self._in_flight.items()))
                if (left := published + timeout - time.monotonic()) > 0:
                    self._changed.wait(left)
                else:
                    del self._in_flight[stamp]
                    self.health.lost(1, f"nobody acknowledged the frame of {stamp} ns within {timeout:g} s")

    def _wait_for_readers(self, in_flight: int) -> None:
        """Wait until who reads the topic of images, as a recorder does, has got all but ``in_flight``.

        The consumer does not tell: it may have its frames by shared memory. A reader that hangs is waited for
        once.
        """
        if self._sent_images <= in_flight:
            return
        patience = Duration(seconds=_READERS_PATIENCE if self._readers_follow else 0.0)
        self._readers_follow = self._topics[topics.IMAGE].wait_for_all_acked(patience)
        if self._readers_follow:
            self._sent_images = 0

    def _on_acknowledged(self, data: bytes) -> None:
        with self._changed:
            self._in_flight.pop(transport.stamp_of(data), None)
            self._changed.notify_all()

    # Services -----------------------------------------------------------------------------------

    def _set_state(self, state: State) -> None:
        with self._changed:
            self._state = state
            self._changed.notify_all()
        self.tell(state.name.lower())

    def _on_start(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        return self._answer(response, State.RUNNING)

    def _on_stop(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if self.lifecycle != "active":
            response.success, response.message = False, self.lifecycle
            return response
        return self._answer(response, State.STOPPED)

    def _on_step(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        return self._answer(response, State.STOPPED, steps=1)

    def _answer(self, response: Trigger.Response, state: State, steps: int = 0) -> Trigger.Response:
        """Change to ``state`` where there is still something to publish."""
        try:
            self.bring_up()
        except Mems6dofError as error:
            response.success, response.message = False, str(error)
            return response
        if self._state is State.ENDED and state is State.STOPPED:
            response.success, response.message = False, "all frames have been published: start begins again"
            return response
        with self._changed:
            self._steps += steps
            self._begin_as = state
        if self._state is not State.WAITING:
            self._set_state(state)
        response.success, response.message = True, self.health.state
        return response


def main(args: list[str] | None = None) -> int:
    """Run the node; returns the exit status."""
    return run(FrameSourceNode, args, frames=True)


if __name__ == "__main__":
    sys.exit(main())
