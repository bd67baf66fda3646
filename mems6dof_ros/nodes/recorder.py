"""``recorder``: topics to a bag (rosbag2, MCAP) as they come over the wire, without decoding them.

Services (std_srvs/Trigger): ``~/start`` begins a new bag, and brings the node up if need be, ``~/stop``
completes it, as deactivation does, ``~/split`` goes on in a new file of it. What a publisher had sent before
the node was told to end is still written. Attached to the bag are the files that the parameters name, and the
parameters of the nodes that publish what is recorded.
"""

from __future__ import annotations

import contextlib
import datetime
import functools
import importlib
import math
import os
import shutil
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.task import Future
from std_srvs.srv import Trigger

from mems6dof_msgs.msg import FrameInfo
from mems6dof_ros.errors import InputError, Mems6dofError
from mems6dof_ros.nodes import transport
from mems6dof_ros.nodes.common import InstrumentNode, run
from mems6dof_ros.nodes.parameter_files import ParameterReader, parameter_file
from mems6dof_ros.nodes.parameters import START_PAUSED, Parameter
from mems6dof_ros.nodes.recorded_images import RecordedImages
from mems6dof_ros.nodes.worker import DRAIN_TIMEOUT
from mems6dof_ros.recording import topics
from mems6dof_ros.recording.bag import COMPRESSIONS, BagWriter, Channel, Qos
from mems6dof_ros.recording.definitions import definition
from mems6dof_ros.recording.metadata import read_custom
from mems6dof_ros.recording.recover import interrupted

#: Environment variable by which the runner, or `launch`, names one run of a system, however often it starts
#: this node again in it.
RUN_VARIABLE = "MEMS6DOF_RUN"

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
#: Recorded unless asked otherwise: everything but the images, at full field a gigabyte in 1.3 s.
DEFAULT_TOPICS = tuple(name for name in KNOWN_TYPES if name != topics.IMAGE)

#: More than their publisher keeps: what it takes for acknowledged waits here until it is taken.
_IMAGES_KEPT, _IMAGE = 3 * transport.FRAMES.depth, KNOWN_TYPES[topics.IMAGE]

#: Of the queue, that images may fill: where the disk does not keep up with them, nothing else is lost.
_IMAGES_SHARE = 0.9

#: A message of one of these types completes a motion cycle, upon which what has been recorded so far is
#: flushed: of those that come, the first in this order.
_CYCLE_TYPES = ("mems6dof_msgs/msg/Pose6DOF", "mems6dof_msgs/msg/Localizations", "sensor_msgs/msg/Image")
_FLUSH_PERIOD = 1.0  # s after which it is flushed without one
_RATE_OVER = 30  # s over which the rate of the record is taken
_WARN_BEFORE = 30.0  # min until the disk is full
_QUIET = 0.1  # s without a message after which nothing is expected any more
_LATCHED = 10  # messages of a transient-local topic that stand at the beginning of every file
_NICE = 5  # of the thread that writes, or of a session of its own
_MEBIBYTE = 2**20

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
    Parameter(
        "split_mebibytes",
        0,
        "Size after which a new file is begun, between two motion cycles; 0: never.",
        "MiB",
        (0, 1_000_000_000),
    ),
    Parameter(
        "split_duration",
        600.0,
        "Time after which a new file is begun; 0.0: never. The index of a file is kept in memory.",
        "s",
        (0.0, 1e9),
    ),
    Parameter(
        "minimum_free_mebibytes",
        256,
        "The bag is completed and ended before less is left on the disk.",
        "MiB",
        (0, 1_000_000_000),
    ),
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
    data: bytes | memoryview
    log_ns: int
    publish_ns: int
    sequence: int


class RecorderNode(InstrumentNode):
    """BagWriter behind a queue."""

    def __init__(self) -> None:
        super().__init__("recorder", PARAMETERS)
        self._bag: BagWriter | None = None
        self._handing_over = threading.Lock()  # held to put messages, and to put what ends their bag
        self._failed: BagWriter | None = None
        self._bags = 0
        self._run = os.environ.get(RUN_VARIABLE, "")
        self._closing: Future | None = None  # of the last bag
        #: What is to be done after a flush, and told when done with the file that was the last before.
        self._between: deque[tuple[Callable[[BagWriter], None], Future]] = deque()
        self._cycle_types: tuple[str, ...] = _CYCLE_TYPES  # that still count
        self._flushed = 0.0
        self._sequences: dict[str, int] = {}
        self._written: deque[int] = deque(maxlen=_RATE_OVER + 1)  # bytes, second by second
        self._minutes_left = math.inf  # until the disk is full
        self.health.watch("disk", self._disk_concern)
        self.create_service(Trigger, "~/start", self._on_start)
        # In groups of their own: they wait for messages that come meanwhile.
        for name, act in (("stop", self._on_stop), ("split", self._on_split)):
            group = MutuallyExclusiveCallbackGroup()
            self.create_service(Trigger, f"~/{name}", act, callback_group=group)

    def configure(self) -> None:
        for path in self.values["attachments"]:
            if not Path(path).is_file():
                raise InputError("parameter attachments", f"no file '{path}'", "existing files")

    def activate(self) -> None:
        self._reader = ParameterReader(self)
        if not self.values["start_paused"]:
            self._open()
        self._dropped = 0
        capacity = self.values["queue_mebibytes"] * _MEBIBYTE
        self.start_worker(lambda act: act(), capacity).put(_step_back, 0)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._channels: list[Channel] = []
        self._images: RecordedImages | None = None  # of the topic that may be left for shared memory
        self._stream = self.make_stream(tick=self._on_tick)
        self._unknown = [name for name in self.values["topics"] if not self._subscribe_known(name)]
        self._stream.begin()
        self.create_timer(1.0, self._on_second, clock=steady)
        self.tell("recording" if self._bag else "stopped")

    def deactivate(self) -> None:
        assert self.worker is not None
        self._stream.end()
        self.worker.end(timeout=None)  # a slow disk is no reason to lose a record; a second signal is
        super().deactivate()
        bag, self._bag = self._bag, None
        if bag:
            self._close(bag)
        self.health.failure = ""

    def end(self, spin: Callable[[float], None]) -> None:
        deadline = time.monotonic() + DRAIN_TIMEOUT
        before = -1
        while before != self.health.total("messages") and time.monotonic() < deadline:
            before = self.health.total("messages")
            spin(_QUIET)
        super().end(spin)

    # Topics -------------------------------------------------------------------------------------

    def _subscribe_known(self, name: str) -> bool:
        if name not in KNOWN_TYPES or KNOWN_TYPES[name] == _IMAGE:  # which cameras publish in their own ways
            return False
        self._subscribe(name, KNOWN_TYPES[name], transport.MESSAGES)
        return True

    def _on_tick(self) -> None:
        if self._images:
            self._images.tick()
        if self._unknown:
            self._look_for_types()

    def _look_for_types(self) -> None:
        """Subscribe to what has appeared, in the way it is published."""
        types = dict(self.get_topic_names_and_types())
        for name in list(self._unknown):
            resolved = self.resolve_topic_name(name)
            if resolved not in types:
                continue
            offered = [info.qos_profile for info in self.get_publishers_info_by_topic(resolved)]
            if not offered:
                continue
            self._unknown.remove(name)
            depth = _IMAGES_KEPT if types[resolved][0] == _IMAGE else transport.MESSAGES.depth
            qos = QoSProfile(depth=depth)  # by the wire nobody learns the publishers'
            if any(profile.reliability == ReliabilityPolicy.BEST_EFFORT for profile in offered):
                qos.reliability = ReliabilityPolicy.BEST_EFFORT
            if all(profile.durability == DurabilityPolicy.TRANSIENT_LOCAL for profile in offered):
                qos.durability, qos.depth = DurabilityPolicy.TRANSIENT_LOCAL, _LATCHED
            try:
                self._subscribe(name, types[resolved][0], qos)
            except (InputError, ImportError, AttributeError) as error:
                self.health.refused(f"topic {resolved} cannot be recorded: {error}")

    def _subscribe(self, name: str, typename: str, qos: QoSProfile) -> None:
        definition(typename)  # fails here rather than with the first message
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
        self._channels.append(channel)
        receive = functools.partial(self._on_message, channel)
        if name == topics.FRAME_INFO:
            receive = functools.partial(self._on_info, channel)
        if name == topics.IMAGE and typename == _IMAGE:
            self._subscribe_to_images(channel, message_type, qos)
        else:
            self._stream.subscribe(message_type, name, receive, qos, raw=True, informed=True)

    def _subscribe_to_images(self, channel: Channel, message_type: type, qos: QoSProfile) -> None:
        """... which may come by shared memory, as the infos tell."""

        def subscribe() -> None:
            self._sequences.pop(channel.topic, None)
            self._stream.subscribe(message_type, topics.IMAGE, images.on_image, qos, raw=True, informed=True)

        images = self._images = RecordedImages(
            self,
            subscribe,
            functools.partial(self._stream.unsubscribe, topics.IMAGE),
            functools.partial(self._on_message, channel),
            self.health.lost,
        )
        subscribe()
        if topics.FRAME_INFO not in self.values["topics"]:
            self._stream.subscribe(FrameInfo, topics.FRAME_INFO, images.on_info, raw=True, informed=True)

    def _on_info(self, channel: Channel, data: bytes, info: dict[str, Any]) -> None:
        self._on_message(channel, data, info)
        if self._images:
            self._images.on_info(data, info)

    def _on_message(self, channel: Channel, data: bytes | memoryview, info: dict[str, Any]) -> None:
        assert self.worker is not None
        with self._handing_over:
            bag = self._bag
            if bag is None:
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
            share = _IMAGES_SHARE if channel.type == _IMAGE else 1.0
            self.worker.put(functools.partial(self._write, bag, received), len(data), share)

    def _account(self, received: _Received) -> None:
        """Count what the wire lost; with several publishers on a topic the numbers do not tell."""
        topic, sequence = received.channel.topic, received.sequence
        last = self._sequences.get(topic)
        self._sequences[topic] = sequence
        if last is not None and sequence > last + 1 and self.count_publishers(topic) == 1:
            self.health.lost(sequence - last - 1, f"{sequence - last - 1} messages lost on {topic}")

    # The worker ---------------------------------------------------------------------------------

    def _write(self, bag: BagWriter, received: _Received) -> None:
        if bag is not self._failed:
            with self._failing(bag):
                bag.add_channel(*received.channel)
                bag.write(*received)
                self.health.count("bytes", len(received.data))
                if self._completes_cycle(received) or time.monotonic() - self._flushed > _FLUSH_PERIOD:
                    self._flush(bag)

    def _completes_cycle(self, received: _Received) -> bool:
        if received.channel.type not in self._cycle_types:
            return False
        self._cycle_types = self._cycle_types[: 1 + self._cycle_types.index(received.channel.type)]
        return received.channel.type == self._cycle_types[-1]

    def _flush(self, bag: BagWriter) -> None:
        if bag is self._failed:
            self._leave_undone()
            return
        with self._failing(bag):
            bag.flush()
            self._flushed = time.monotonic()
            self._do_between(bag)

    def _close(self, bag: BagWriter) -> None:
        if bag is not self._failed:
            with self._failing(bag):
                self._do_between(bag)
                bag.close()
        self.get_logger().info(f"{bag.message_count} messages in {bag.path}")

    def _do_between(self, bag: BagWriter) -> None:
        while self._between:
            act, done = self._between[0]
            path = bag.file
            act(bag)
            self._between.popleft()
            done.set_result(path)

    @contextlib.contextmanager
    def _failing(self, bag: BagWriter) -> Iterator[None]:
        """The measurement goes on without its record, and says so."""
        try:
            yield
        except OSError as error:
            self._bag, self._failed = None, bag
            self.health.failure = f"recording stopped: {bag.path}: {error.strerror or error}"
            self.health.refused(self.health.failure)
            self._leave_undone()

    def _leave_undone(self) -> None:
        while self._between:
            self._between.popleft()[1].set_result(None)

    # Begin and end ------------------------------------------------------------------------------

    def _on_second(self) -> None:
        assert self.worker is not None
        bag = self._bag
        if bag and len(self.worker) == 0:  # what comes without a motion cycle
            self.worker.put(functools.partial(self._flush, bag), 0)
        dropped, self._dropped = self.worker.dropped - self._dropped, self.worker.dropped
        if dropped:
            self.health.lost(dropped, f"{dropped} messages lost: the disk does not keep up")
        if bag:
            self._tell_of_disk(bag)
            for name, text in self._reader.look([channel.topic for channel in self._channels]):
                self._between.append((functools.partial(_attach, name=name, text=text), Future()))

    def _tell_of_disk(self, bag: BagWriter) -> None:
        with contextlib.suppress(OSError):  # it is gone, as the worker will find
            free = shutil.disk_usage(bag.path).free // _MEBIBYTE - self.values["minimum_free_mebibytes"]
            self.health.set("disk, MiB left to record", free)
            self._written.append(self.health.total("bytes"))
            if (grown := self._written[-1] - self._written[0]) > 0:
                rate = grown / (len(self._written) - 1)
                self._minutes_left = free * _MEBIBYTE / rate / 60.0
                self.health.set("disk, min until it is full", round(self._minutes_left))
            else:
                self._minutes_left = math.inf
        self.health.set("file", bag.file)

    def _disk_concern(self) -> str:
        if self._bag is None or self._minutes_left > _WARN_BEFORE:
            return ""
        return f"the disk will be full in {max(self._minutes_left, 0.0):.0f} min"

    def _next_path(self) -> str:
        """Where to record: ``output``, or beside it where this node has recorded there, one before it in the
        same run of a system, or one that was killed."""
        output = self.values["output"]
        if not output:
            return f"recording_{datetime.datetime.now():%Y%m%d_%H%M%S}"
        path = f"{output}_{self._bags}" if self._bags else output
        while (cut_off := interrupted(Path(path))) or self._is_of_this_run(Path(path)):
            if cut_off:
                self.get_logger().warning(f"{path} was interrupted: mems6dof recover {path}")
            self._bags += 1
            path = f"{output}_{self._bags}"
        return path

    def _is_of_this_run(self, path: Path) -> bool:
        return bool(self._run) and read_custom(path).get("run") == self._run

    def _open(self) -> None:
        path = self._next_path()
        needed = self.values["minimum_free_mebibytes"] * _MEBIBYTE
        try:
            Path(path).mkdir(parents=True, exist_ok=True)
            if (free := shutil.disk_usage(path).free) < needed:
                found = f"{free // _MEBIBYTE} MiB left on its disk"
                raise InputError(path, found, f"{needed // _MEBIBYTE} MiB (minimum_free_mebibytes)")
            bag = BagWriter(
                path,
                compression=self.values["compression"],
                provenance={"topics": " ".join(self.values["topics"]), "run": self._run},
                sync_period=self.values["sync_period"],
                split_size=self.values["split_mebibytes"] * _MEBIBYTE,
                split_duration=self.values["split_duration"],
                minimum_free=needed,
            )
            for attachment in map(Path, self.values["attachments"]):
                bag.attach(attachment.name, attachment.read_bytes())
            _attach(bag, *parameter_file(self.get_fully_qualified_name(), self.values))
        except OSError as error:
            raise InputError(path, error.strerror or str(error), "a directory to record to") from None
        self._bags += 1
        self._sequences.clear()
        self._written.clear()
        self._minutes_left = math.inf
        self._reader.forget()
        self._cycle_types = _CYCLE_TYPES
        self.health.failure = ""
        self._bag = bag

    def _on_start(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        bag = self._bag
        if bag or (self._closing and not self._closing.done()):
            path = bag.path if bag else "the last bag"
            response.success, response.message = False, f"already recording to {path}"
            return response
        try:
            self.bring_up()
            if self._bag is None:
                self._open()
        except Mems6dofError as error:
            response.success, response.message = False, str(error)
            return response
        if bag := self._bag:
            self.tell("recording")
        response.success, response.message = bag is not None, str(bag.path) if bag else self.health.failure
        return response

    async def _on_stop(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if (bag := self._bag) is None:
            response.success, response.message = False, self.health.failure or "not recording"
            return response
        path = bag.path
        await self._quiet()  # what was sent before this call may still be on its way through our callbacks
        closing = Future()

        def close(bag: BagWriter) -> None:
            self._close(bag)
            closing.set_result(None)

        with self._handing_over:  # behind what is queued, of which no more comes
            bag, self._bag = self._bag, None
            if bag and self.worker is not None:  # not failed or deactivated meanwhile
                self._closing = closing
                self.worker.put(functools.partial(close, bag), 0)
        if self._closing is closing:
            await closing
        response.success, response.message = not self.health.failure, self.health.failure or str(path)
        self.tell("stopped")
        return response

    async def _on_split(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        bag = self._bag
        if bag is None or self.worker is None:
            response.success, response.message = False, self.health.failure or "not recording"
            return response
        completed = Future()
        self._between.append((BagWriter.split, completed))
        self.worker.put(functools.partial(self._flush, bag), 0)
        path = await completed
        response.success, response.message = path is not None, str(path or self.health.failure)
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


def _step_back() -> None:
    """Let this thread yield to the measurement, where processors are short: it has a queue.

    Linux may first share processors among sessions (autogroups), of which the runner gives every node one.
    """
    with contextlib.suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICE)
        if os.getsid(0) == os.getpid():
            Path("/proc/self/autogroup").write_text(str(_NICE), encoding="ascii")


def _attach(bag: BagWriter, name: str, text: str) -> None:
    bag.attach(name, text.encode(), "application/yaml")


def main(args: list[str] | None = None) -> int:
    """Run the node; returns the exit status."""
    return run(RecorderNode, args)


if __name__ == "__main__":
    sys.exit(main())
