"""``recorder``: topics to a bag (rosbag2, MCAP) as they come over the wire, without decoding them.

Services (std_srvs/Trigger): ``~/start`` begins a new bag, and brings the node up if need be, ``~/stop``
completes it, as deactivation does. What a publisher had sent before the node was told to end is still
written.
"""

from __future__ import annotations

import datetime
import functools
import importlib
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.task import Future
from std_srvs.srv import Trigger

from mems6dof_ros.errors import InputError, Mems6dofError
from mems6dof_ros.nodes import transport
from mems6dof_ros.nodes.common import InstrumentNode, WhileRoom, run
from mems6dof_ros.nodes.parameters import START_PAUSED, Parameter
from mems6dof_ros.nodes.worker import DRAIN_TIMEOUT
from mems6dof_ros.recording import topics
from mems6dof_ros.recording.bag import COMPRESSIONS, BagWriter, Channel, Qos

#: Types of the topics that we know before anybody publishes them.
KNOWN_TYPES = {
    topics.IMAGE: "sensor_msgs/msg/Image",
    topics.CAMERA_INFO: "sensor_msgs/msg/CameraInfo",
    topics.FRAME_INFO: "mems6dof_msgs/msg/FrameInfo",
    topics.TRUTH: "mems6dof_msgs/msg/GroundTruth",
    topics.LOCALIZATIONS: "mems6dof_msgs/msg/Localizations",
    topics.POSE_6DOF: "mems6dof_msgs/msg/Pose6DOF",
    topics.POSE: "geometry_msgs/msg/PoseStamped",
    topics.POSE_WITH_COVARIANCE: "geometry_msgs/msg/PoseWithCovarianceStamped",
    topics.PSI_TARGET: "std_msgs/msg/Float64",
    topics.ACTUATION_COMMAND: "mems6dof_msgs/msg/ActuationCommand",
    topics.ACTUATION_ACKNOWLEDGEMENT: "mems6dof_msgs/msg/ActuationAcknowledgement",
    topics.CONTROLLER_STATE: "mems6dof_msgs/msg/ControllerState",
    "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
}
#: Recorded unless asked otherwise: everything but the images, which need the disk's own rate.
DEFAULT_TOPICS = tuple(name for name in KNOWN_TYPES if name != topics.IMAGE)

#: A message on one of these completes a motion cycle: what has been recorded so far is flushed.
_CYCLE_TYPES = ("mems6dof_msgs/msg/Pose6DOF",)
_QUIET = 0.1  # s without a message after which nothing is expected any more

PARAMETERS = (
    Parameter("topics", DEFAULT_TOPICS, "Topics to record; a type that is unknown here is waited for."),
    Parameter("output", "", "Directory of the bag, new or empty; empty: recording_<date>_<time> here."),
    Parameter(
        "compression",
        "none",
        "Of the chunks: none keeps up with full frames, zstd makes the smallest files.",
        choices=tuple(COMPRESSIONS),
    ),
    Parameter("sync_period", 1.0, "What is older survives a loss of power.", "s", (0.01, 3600.0)),
    Parameter("attachments", (), "Files to attach to the bag, for instance the calibration."),
    START_PAUSED,
    Parameter("queue_mebibytes", 512, "Messages that wait for the disk.", "MiB", (1, 1_000_000)),
    Parameter(
        "queue_policy",
        "drop_oldest",
        "What to do when the queue is full: drop_oldest never slows down the measurement, block loses nothing"
        " that the publishers keep.",
        choices=("block", "drop_oldest"),
    ),
)


class _Received(NamedTuple):
    channel: Channel
    data: bytes
    log_ns: int
    publish_ns: int
    sequence: int


class RecorderNode(InstrumentNode):
    """BagWriter behind a queue."""

    def __init__(self) -> None:
        super().__init__("recorder", PARAMETERS)
        self._bag: BagWriter | None = None
        self._bags = 0
        self._flushed = 0.0
        self._sequences: dict[str, int] = {}
        self.create_service(Trigger, "~/start", self._on_start)
        # In a group of its own: it waits for messages that come meanwhile.
        self.create_service(Trigger, "~/stop", self._on_stop, callback_group=MutuallyExclusiveCallbackGroup())

    def configure(self) -> None:
        for path in self.values["attachments"]:
            if not Path(path).is_file():
                raise InputError("parameter attachments", f"no file '{path}'", "existing files")

    def activate(self) -> None:
        if not self.values["start_paused"]:
            self._open()
        self._dropped = 0
        capacity = self.values["queue_mebibytes"] * 2**20
        self.start_worker(lambda act: act(), capacity)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._unknown = [name for name in self.values["topics"] if not self._subscribe_known(name)]
        if self._unknown:
            self._looking = self.create_timer(0.2, self._look_for_types, clock=steady)
        self.create_timer(1.0, self._on_second, clock=steady)
        self.tell("recording" if self._bag else "stopped")

    def deactivate(self) -> None:
        assert self.worker is not None
        self.worker.end(timeout=None)  # a slow disk is no reason to lose a record; a second signal is
        super().deactivate()
        self._close()

    def end(self, spin: Callable[[float], None]) -> None:
        deadline = time.monotonic() + DRAIN_TIMEOUT
        before = -1
        while before != self.health.total("messages") and time.monotonic() < deadline:
            before = self.health.total("messages")
            spin(_QUIET)
        super().end(spin)

    # Topics -------------------------------------------------------------------------------------

    def _subscribe_known(self, name: str) -> bool:
        if name not in KNOWN_TYPES:
            return False
        qos = transport.FRAMES if KNOWN_TYPES[name].endswith("/Image") else transport.MESSAGES
        self._subscribe(name, KNOWN_TYPES[name], qos)
        return True

    def _look_for_types(self) -> None:
        """Subscribe to what has appeared, in the way it is published."""
        types = dict(self.get_topic_names_and_types())
        for name in list(self._unknown):
            resolved = self.resolve_topic_name(name)
            if resolved not in types:
                continue
            self._unknown.remove(name)
            offered = [info.qos_profile for info in self.get_publishers_info_by_topic(resolved)]
            qos = QoSProfile(depth=transport.MESSAGES.depth)
            if any(profile.reliability == ReliabilityPolicy.BEST_EFFORT for profile in offered):
                qos.reliability = ReliabilityPolicy.BEST_EFFORT
            if offered and all(profile.durability == DurabilityPolicy.TRANSIENT_LOCAL for profile in offered):
                qos.durability = DurabilityPolicy.TRANSIENT_LOCAL
            try:
                self._subscribe(name, types[resolved][0], qos)
            except (InputError, ImportError, AttributeError) as error:
                self.health.refused(f"topic {resolved} cannot be recorded: {error}")
        if not self._unknown:
            self._looking.cancel()

    def _subscribe(self, name: str, typename: str, qos: QoSProfile) -> None:
        module, _, kind = typename.rpartition("/")
        message_type = getattr(importlib.import_module(module.replace("/", ".")), kind)
        offered = Qos(
            depth=qos.depth,
            reliability="best_effort" if qos.reliability == ReliabilityPolicy.BEST_EFFORT else "reliable",
            durability="transient_local"
            if qos.durability == DurabilityPolicy.TRANSIENT_LOCAL
            else "volatile",
        )
        channel = Channel(self.resolve_topic_name(name), typename, (offered,))
        receive = functools.partial(self._on_message, channel)
        assert self.worker is not None
        group = WhileRoom(self.worker)
        self.create_subscription(message_type, name, receive, qos, raw=True, callback_group=group)

    def _on_message(self, channel: Channel, data: bytes, info: dict[str, Any]) -> None:
        assert self.worker is not None
        if self._bag is None:
            return
        received = _Received(
            channel,
            data,
            time.time_ns(),
            info["source_timestamp"],
            info.get("publication_sequence_number") or 0,
        )
        self.health.count("messages")
        self._account(received)
        self.worker.put(functools.partial(self._write, received), len(data))

    def _account(self, received: _Received) -> None:
        """Count what the wire lost; with several publishers on a topic the numbers do not tell."""
        topic, sequence = received.channel.topic, received.sequence
        last = self._sequences.get(topic)
        self._sequences[topic] = sequence
        if last is not None and sequence > last + 1 and self.count_publishers(topic) == 1:
            self.health.lost(sequence - last - 1, f"{sequence - last - 1} messages lost on {topic}")

    # The worker ---------------------------------------------------------------------------------

    def _write(self, received: _Received) -> None:
        if self._bag is None:
            return
        try:
            self._bag.add_channel(*received.channel)
            self._bag.write(*received)
            self.health.count("bytes", len(received.data))
            if received.channel.type in _CYCLE_TYPES:
                self._bag.flush()
        except OSError as error:
            self._fail(error)

    def _flush(self) -> None:
        """What comes without a motion cycle, once per second."""
        try:
            if self._bag:
                self._bag.flush()
        except OSError as error:
            self._fail(error)

    def _fail(self, error: OSError) -> None:
        """The measurement goes on without its record, and says so."""
        assert self._bag is not None
        self.health.refused(f"recording stopped: {self._bag.path}: {error.strerror}")
        self.health.state = "stopped by an error"
        self._bag = None

    # Begin and end ------------------------------------------------------------------------------

    def _on_second(self) -> None:
        assert self.worker is not None
        if len(self.worker) == 0:
            self.worker.put(self._flush)
        dropped, self._dropped = self.worker.dropped - self._dropped, self.worker.dropped
        if dropped:
            self.health.lost(dropped, f"{dropped} messages lost: the disk does not keep up")

    def _open(self) -> None:
        path = self.values["output"] or f"recording_{datetime.datetime.now():%Y%m%d_%H%M%S}"
        if self._bags and self.values["output"]:
            path += f"_{self._bags}"
        self._bags += 1
        provenance = {name: str(self.values[name]) for name in ("topics", "compression", "sync_period")}
        bag = BagWriter(
            path,
            compression=self.values["compression"],
            provenance=provenance,
            sync_period=self.values["sync_period"],
        )
        for attachment in map(Path, self.values["attachments"]):
            bag.attach(attachment.name, attachment.read_bytes())
        self._sequences.clear()
        self._bag = bag

    def _close(self) -> None:
        bag, self._bag = self._bag, None
        if bag:
            bag.close()
            self.get_logger().info(f"{bag.message_count} messages in {bag.path}")

    def _on_start(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if self._bag:
            response.success, response.message = False, f"already recording to {self._bag.path}"
            return response
        try:
            self.bring_up()
            if self._bag is None:
                self._open()
        except (Mems6dofError, OSError) as error:
            response.success, response.message = False, str(error)
            return response
        assert self._bag is not None
        self.tell("recording")
        response.success, response.message = True, str(self._bag.path)
        return response

    async def _on_stop(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if not self._bag:
            response.success, response.message = False, "not recording"
            return response
        path = self._bag.path
        await self._quiet()  # what was sent before this call may still be on its way through our callbacks
        closed = threading.Event()

        def close() -> None:
            self._close()
            closed.set()

        if self.worker is None:  # deactivated meanwhile, which has closed it
            response.success, response.message = True, str(path)
            return response
        self.worker.put(close)  # behind what is queued
        response.success = closed.wait(DRAIN_TIMEOUT)
        response.message = str(path) if response.success else f"{path}: the disk is behind, still writing"
        self.tell("stopped")
        return response

    def _quiet(self) -> Future:
        """Done when no message has come for a moment, or after a second."""
        quiet = Future()
        before = [-1]

        def look() -> None:
            now = self.health.total("messages")
            if now == before[-1] or len(before) > 1.0 / _QUIET:
                timer.cancel()
                quiet.set_result(None)
            before.append(now)

        timer = self.create_timer(_QUIET, look, clock=Clock(clock_type=ClockType.STEADY_TIME))
        return quiet


def main(args: list[str] | None = None) -> int:
    """Run the node; returns the exit status."""
    return run(RecorderNode, args)


if __name__ == "__main__":
    sys.exit(main())
