"""``monitor``: the live page, in any browser on this machine.

Subscribes to everything that the instrument says, serves the page and calls the services that the page
asks for. With nobody looking it only keeps numbers; docs/monitor.md has the rest.
"""

from __future__ import annotations

import math
import os
import sys
import threading
import time
from collections import Counter, OrderedDict
from concurrent.futures import Future
from queue import Empty, Queue
from typing import Any, TypeVar

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from numpy.typing import NDArray
from rcl_interfaces.srv import GetParameters
from rclpy.clock import Clock, ClockType
from rclpy.parameter import parameter_value_to_python
from sensor_msgs.msg import Image
from std_msgs.msg import Float64
from std_srvs.srv import Trigger

from mems6dof_msgs.msg import ControllerState, FrameInfo, GroundTruth, Localizations, Pose6DOF
from mems6dof_ros.errors import InputError
from mems6dof_ros.frame import GroundTruth as Truth
from mems6dof_ros.monitor.feed import MAX_BODIES, Feed
from mems6dof_ros.monitor.picture import make_picture
from mems6dof_ros.monitor.server import MonitorServer
from mems6dof_ros.monitor.truth import TruthAlignment
from mems6dof_ros.nodes import transport
from mems6dof_ros.nodes.actuation import ANSWERS
from mems6dof_ros.nodes.common import InstrumentNode, run
from mems6dof_ros.nodes.onlooker import PolledSubscriptions, give_way
from mems6dof_ros.nodes.parameters import Parameter
from mems6dof_ros.nodes.scaled import ScaledCopies
from mems6dof_ros.nodes.snapshots import Snapshots
from mems6dof_ros.pose.cycle_pose import CyclePose
from mems6dof_ros.recording import messages, topics

PARAMETERS = (
    Parameter("address", "127.0.0.1", "Address to listen on; other than localhost, a token is asked for."),
    Parameter("port", 8606, "TCP port to listen on; 0: any free one.", span=(0, 65535)),
    Parameter("history", 30000, "Motion cycles that the page can show.", "cycles", (100, 1_000_000)),
    Parameter("tls_certificate", "", "PEM file; with it and tls_key, the page is served by https."),
    Parameter("tls_key", "", "PEM file of its private key, without a password."),
    Parameter(
        "picture_rate", 2.0, "Micrographs shown per second while a page is open; 0: none.", "Hz", (0.0, 30.0)
    ),
    Parameter(
        "viz_scale",
        0.0,
        "Publish viz/pose and viz/points, lengths times this, for tools that cannot show micrometres; 1000"
        " makes the gear 0.328 m wide; 0: do not.",
        "1",
        (0.0, 1e9),
    ),
)
#: Services that the page may call, relative names; all std_srvs/Trigger.
SERVICES = (
    "frame_source/start",
    "frame_source/stop",
    "frame_source/step",
    "pose_estimator/set_reference",
    "pose_estimator/reset",
    "recorder/start",
    "recorder/stop",
    "controller/stop",
)
#: What the page may send the controller: a target, with its angle psi in rad.
GO = "controller/go"
#: Environment variable with the token to ask for; a parameter could be read by everybody on the network.
TOKEN_VARIABLE = "MEMS6DOF_MONITOR_TOKEN"

#: Parameters of the controller that the page shows.
_LIMITS = ("body", "max_play", "max_tilt", "max_sd_psi", "max_pose_age", "move_timeout")
_STATES = {
    ControllerState.STATE_IDLE: "idle",
    ControllerState.STATE_MOVING: "moving",
    ControllerState.STATE_ARRIVED: "arrived",
    ControllerState.STATE_STOPPED: "stopped",
}
_RATES = (topics.FRAME_INFO, topics.LOCALIZATIONS, topics.POSE_6DOF)
_MEMORY_FRAMES = 256  # frames whose messages are kept until the picture of one of them is made
_TAKE_PERIOD = 0.04  # s; as often as a page is sent anything
_STATE_PERIOD = 0.5  # s
_BODIES_PERIOD = 2.0  # s
_PICTURE_PATIENCE = 0.5  # s that a picture waits for its pose
_STANDSTILL = 10.0  # s without a frame after which none are expected
_NO_IMAGES = 3.0  # s without an image after which there are none
_MAX_DIAGNOSTICS = 32

_Key = TypeVar("_Key")
_Value = TypeVar("_Value")


class _Recent(OrderedDict[_Key, _Value]):
    """The last few values by key."""

    def __setitem__(self, key: _Key, value: _Value) -> None:
        super().__setitem__(key, value)
        while len(self) > _MEMORY_FRAMES:
            self.popitem(last=False)


class MonitorNode(InstrumentNode):
    """Feeds and serves the live page."""

    def __init__(self) -> None:
        super().__init__("monitor", PARAMETERS)

    def configure(self) -> None:
        self._feed = Feed(self.values["history"], log=lambda text: self._warn(f"alarm: {text}"))
        self._server = MonitorServer(
            self._feed,
            self._call,
            address=self.values["address"],
            port=self.values["port"],
            token=os.environ.get(TOKEN_VARIABLE, ""),
            certificate=self.values["tls_certificate"],
            key=self.values["tls_key"],
            log=self._warn,
        )
        self._counts: Counter[str] = Counter()
        self._counted_at = time.monotonic()
        self._frames_dropped = 0
        self._heard_at = -_STANDSTILL  # of a frame, monotonic s
        self._newest: CyclePose | None = None
        self._newest_at = 0.0  # monotonic s
        self._diagnostics: OrderedDict[str, dict[str, Any]] = OrderedDict()
        self._truths: _Recent[tuple[int, str], Truth] = _Recent()
        self._alignments: dict[str, TruthAlignment] = {}
        self._poses: _Recent[int, list[CyclePose]] = _Recent()
        self._found: _Recent[int, bytes] = _Recent()
        self._infos: _Recent[int, FrameInfo] = _Recent()
        self._images: Queue[bytes | None] = Queue(maxsize=1)
        self._triggers = {name: self.create_client(Trigger, name) for name in SERVICES}
        self._limits = self.create_client(GetParameters, "controller/get_parameters")
        self._targets = self.create_publisher(Float64, topics.PSI_TARGET, transport.MESSAGES)
        self._controller: dict[str, Any] | None = None  # what is known of it, None: nobody has seen one
        self._controller_known = False
        self._painter = threading.Thread(target=self._paint, name="painter", daemon=True)
        # Printed, not logged: the address may hold a token, and logs and diagnostics are published.
        print(f"live page: {self._server.start()}", flush=True)
        self._painter.start()
        self.health.gauge("pages with pictures", lambda: self._feed.watchers)

    def activate(self) -> None:
        self._polled = polled = PolledSubscriptions(self, _TAKE_PERIOD)
        self._bodies: set[str] = set()  # with topics of their own
        # In the order in which a cycle comes about, so that everything is there when its pose comes.
        polled.subscribe(FrameInfo, topics.FRAME_INFO, self._on_frame_info)
        polled.subscribe(GroundTruth, topics.TRUTH, self._on_truth)
        polled.subscribe(Localizations, topics.LOCALIZATIONS, self._on_localizations)
        polled.subscribe(Pose6DOF, topics.POSE_6DOF, self._on_pose)
        polled.subscribe(ControllerState, topics.CONTROLLER_STATE, self._on_controller, ANSWERS)
        polled.subscribe(DiagnosticArray, "/diagnostics", self._on_diagnostics)
        # Wall time: the page lives also while simulated time stands still.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(_STATE_PERIOD, self._tell_state, clock=steady)
        self.create_timer(_BODIES_PERIOD, self._look_for_bodies, clock=steady)
        if rate := self.values["picture_rate"]:
            Snapshots(self, topics.IMAGE, rate, self._wants_image, self._images.put)
        if scale := self.values["viz_scale"]:
            ScaledCopies(self, scale)
        self.tell("serving")

    def cleanup(self) -> None:
        self._server.stop()
        self._images.put(None)
        self._painter.join(timeout=2)

    def _warn(self, text: str) -> None:
        self.get_logger().warning(text)

    # What is heard ------------------------------------------------------------------------------

    def _on_pose(self, data: bytes) -> None:
        self._counts[topics.POSE_6DOF] += 1
        if pose := self._add_pose(transport.deserialize(data, Pose6DOF)):
            self._newest, self._newest_at = pose, time.monotonic()

    def _add_pose(self, message: Pose6DOF) -> CyclePose | None:
        try:
            pose = messages.to_cycle_pose(message)
        except InputError as error:
            self._feed.tell("warning", str(error))
            return None
        self._feed.add_pose(pose, self._true_displacement(pose))
        self._poses.setdefault(pose.stamp_ns, []).append(pose)
        return pose

    def _look_for_bodies(self) -> None:
        """Subscribe to what further bodies publish below their own names."""
        first = self.resolve_topic_name(topics.POSE_6DOF)
        base = first.removesuffix(topics.POSE_6DOF)
        for name, _ in self.get_topic_names_and_types():
            body, _, topic = name.removeprefix(base).partition("/")
            further = name.startswith(base) and topic == topics.POSE_6DOF and body not in self._bodies
            if further and len(self._bodies) < MAX_BODIES:
                self._bodies.add(body)
                self._follow_body(body)

    def _follow_body(self, body: str) -> None:
        def on_pose(data: bytes) -> None:
            message = transport.deserialize(data, Pose6DOF)
            if message.body == body:
                self._add_pose(message)
            else:  # not a body of ours, but another instrument in a namespace below
                end()

        end = self._polled.subscribe(Pose6DOF, topics.of_body(body, topics.POSE_6DOF), on_pose)

    def _on_localizations(self, data: bytes) -> None:
        self._counts[topics.LOCALIZATIONS] += 1
        self._heard_at = time.monotonic()
        self._found[transport.stamp_of(data)] = data  # only the few that are drawn are ever decoded

    def _on_frame_info(self, data: bytes) -> None:
        message = transport.deserialize(data, FrameInfo)
        self._counts[topics.FRAME_INFO] += 1
        self._heard_at = time.monotonic()
        self._frames_dropped += message.frames_dropped
        self._infos[messages.nanoseconds(message.header.stamp)] = message

    def _on_truth(self, data: bytes) -> None:
        message = transport.deserialize(data, GroundTruth)
        self._truths[messages.nanoseconds(message.header.stamp), message.body] = messages.to_ground_truth(
            message
        )

    def _on_controller(self, data: bytes) -> None:
        message = transport.deserialize(data, ControllerState)
        self._tell_controller(
            state=_STATES.get(message.state, "unknown"),
            reason=message.reason,
            target=_finite(message.target),
            error=_finite(message.error),
            cycles=message.cycles,
        )

    def _tell_controller(self, **news: Any) -> None:
        unknown = {"body": "", "state": "idle", "reason": "", "target": None, "error": None, "cycles": None}
        self._controller = {**(self._controller or {**unknown, "limits": {}}), **news}
        self._feed.set_instrument({"controller": self._controller})

    def _on_diagnostics(self, data: bytes) -> None:
        for status in transport.deserialize(data, DiagnosticArray).status:
            self._diagnostics[status.name] = {
                "name": status.name,
                "level": int.from_bytes(status.level, "little"),
                "message": status.message,
                "values": {pair.key: pair.value for pair in status.values[:32]},
            }
            while len(self._diagnostics) > _MAX_DIAGNOSTICS:
                self._diagnostics.popitem(last=False)

    def _true_displacement(self, pose: CyclePose) -> NDArray[np.float64] | None:
        truth = self._truths.get((pose.stamp_ns, pose.body))
        if truth is None or not pose.valid:
            return None
        alignment = self._alignments.get(pose.body)
        if alignment is None or alignment.reference_version != pose.reference_version:
            alignment = self._alignments[pose.body] = TruthAlignment(pose.reference_version)
        return alignment.add(pose, truth)

    def _tell_state(self) -> None:
        now = time.monotonic()
        elapsed, self._counted_at = now - self._counted_at, now
        rates = {name: self._counts[name] / elapsed for name in _RATES}
        self._counts.clear()
        services = {name: client.service_is_ready() for name, client in self._triggers.items()}
        services[GO] = services["controller/stop"]
        self._look_for_controller(services[GO])
        self._feed.set_instrument(
            {
                "rates": {name: round(rate, 1) for name, rate in rates.items()},
                "stale": round(now - self._newest_at, 1) if self._newest else None,
                "frames_dropped": self._frames_dropped,
                "aligned": {
                    body: [alignment.cycles[0], alignment.cycles[-1]]
                    for body, alignment in self._alignments.items()
                },
                "services": services,
                "diagnostics": list(self._diagnostics.values()),
            }
        )

    def _look_for_controller(self, here: bool) -> None:
        """Ask one that has come within which limits it moves."""
        known, self._controller_known = self._controller_known, here and self._limits.service_is_ready()
        if known or not self._controller_known:
            return

        def on_limits(done: Any) -> None:
            values = dict(zip(_LIMITS, map(parameter_value_to_python, done.result().values), strict=True))
            self._tell_controller(body=values.pop("body"), limits=values)

        self._limits.call_async(GetParameters.Request(names=list(_LIMITS))).add_done_callback(on_limits)

    # Pictures -----------------------------------------------------------------------------------

    def _wants_image(self) -> bool:
        """Only while frames flow: a source must not take the monitor for the localizer that it waits for."""
        flowing = time.monotonic() - self._heard_at < _STANDSTILL
        return flowing and self._feed.watchers > 0 and self._images.empty()

    def _paint(self) -> None:
        """Make pictures, in a thread of its own, until None comes; without images, of points only."""
        last_image_at = time.monotonic()
        try:
            while True:
                try:
                    data = self._images.get(timeout=_STATE_PERIOD)
                except Empty:
                    data = b""
                if data is None:
                    return
                now = time.monotonic()
                if data or not self._feed.watchers:
                    last_image_at = now
                if self._feed.watchers and (data or now - last_image_at > _NO_IMAGES):
                    try:
                        self._paint_one(data)
                    except InputError as error:
                        self._feed.tell("warning", str(error))
        except Exception as error:  # handed to the main thread, which ends the node
            self.failure = error

    def _paint_one(self, data: bytes) -> None:
        if data:
            stamp = transport.stamp_of(data)
        elif self._newest:
            stamp = self._newest.stamp_ns
        else:
            return
        deadline = time.monotonic() + _PICTURE_PATIENCE
        while time.monotonic() < deadline and not (stamp in self._found and stamp in self._poses):
            time.sleep(0.02)
        info, found = self._infos.get(stamp), self._found.get(stamp)
        picture = make_picture(
            messages.to_frame(transport.deserialize(data, Image), info) if data else None,
            messages.to_localizations(transport.deserialize(found, Localizations)) if found else None,
            self._poses.get(stamp, []),
            self._feed.bodies,
        )
        self._feed.add_picture(picture)

    # What the page asks for ---------------------------------------------------------------------

    def _call(self, service: str, value: float | None) -> Future[tuple[bool, str]]:
        """Call a service from the server's thread."""
        answer: Future[tuple[bool, str]] = Future()
        client = self._triggers["controller/stop" if service == GO else service]
        if not client.service_is_ready():
            answer.set_result((False, "nobody offers this service now"))
            return answer
        if (value is None) is (service == GO):
            answer.set_result((False, "a target needs an angle, everything else none"))
            return answer
        if service == GO:
            self._targets.publish(Float64(data=value))
            answer.set_result((True, f"target {value:.6g} rad sent"))
            return answer
        pending = client.call_async(Trigger.Request())

        def on_response(done: Any) -> None:
            response = done.result()
            if answer.set_running_or_notify_cancel():
                answer.set_result((response.success, response.message))

        pending.add_done_callback(on_response)
        answer.add_done_callback(lambda _: client.remove_pending_request(pending))
        return answer


def _finite(value: float) -> float | None:
    """JSON knows no NaN."""
    return value if math.isfinite(value) else None


def main(args: list[str] | None = None) -> int:
    """Run the node; returns the exit status."""
    give_way()
    return run(MonitorNode, args)


if __name__ == "__main__":
    sys.exit(main())
