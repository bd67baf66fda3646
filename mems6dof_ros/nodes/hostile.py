"""What broken messages do to the nodes, as figures of `mems6dof validate lab`.

A good recording is measured while somebody else publishes nonsense on the same topics: what is refused must
be counted, and what is measured must not change.
"""

from __future__ import annotations

import contextlib
import importlib
import os
import random
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from mcap.reader import make_reader
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import Image
from std_msgs.msg import Float64
from std_srvs.srv import Trigger

from mems6dof_msgs.msg import ControllerState, FrameInfo, Localizations, Pose6DOF
from mems6dof_ros.calibration.calibrate import calibrate
from mems6dof_ros.calibration.file import load_calibration, save_calibration
from mems6dof_ros.calibration.focus_stack import DEFAULT_WINDOW_PX, measure_stack
from mems6dof_ros.errors import Mems6dofError
from mems6dof_ros.frame import Frame
from mems6dof_ros.localization.fitting import DEFAULT_WEIGHTING
from mems6dof_ros.localization.localizer import Localizer
from mems6dof_ros.nodes import broken, transport
from mems6dof_ros.nodes.actuation import ANSWERS
from mems6dof_ros.nodes.system import NodeSpec, RunningSystem, chain, commanded, run_system
from mems6dof_ros.pose.cycle_pose import CyclePose
from mems6dof_ros.pose.estimator import PoseEstimator
from mems6dof_ros.recording import messages, topics
from mems6dof_ros.simulation.experiment import focus_stack, motion_frames
from mems6dof_ros.simulation.settings import SimulationSettings
from mems6dof_ros.sources.simulator import camera_noise

#: One row of the table: quantity, measured, required (text), passed (None: for information).
Figure = dict[str, Any]

#: A gear that fits into a small field, so that the nodes are quick.
SMALL = {"width_px": 512, "height_px": 512, "gear_diameter": 60e-6, "hub_diameter": 8e-6, "particles": 30}
#: Numerical noise of the same computation in another process, m and rad.
SAME = 1e-12
_PATIENCE = 120.0  # s
#: Topics of ROS 2 itself.
_NOT_OURS = ("/parameter_events", "/rosout", "/clock")
RCLError = rclpy_implementation.RCLError
_RESTING = (ControllerState.STATE_ARRIVED, ControllerState.STATE_STOPPED)
_MOST_TRIES = 12


def figures(work: Path, seed: int, tell: Callable[[str], None]) -> Iterator[Figure]:
    """All figures, of nodes in a namespace of their own."""
    settings = SimulationSettings(**SMALL, seed=seed, optics_seed=seed)  # type: ignore[arg-type]
    tell("calibrate simulated optics")
    calibration = work / "optics.yaml"
    calibrate_small(settings, calibration)
    tell("broken images and localizations among good ones")
    yield from broken_frames(settings, calibration, 48, work)
    tell("nonsense on every topic")
    yield from fuzzed_topics(settings, calibration, 30, seed, work)


def calibrate_small(settings: SimulationSettings, path: Path) -> None:
    """A calibration of the optics of ``settings``, from few beads: there is room for no more."""
    frames = focus_stack(settings, -3e-6, 3e-6, 0.25e-6, beads=30, seed=3)
    stack = measure_stack(frames, camera_noise(settings), DEFAULT_WEIGHTING, DEFAULT_WINDOW_PX)
    save_calibration(calibrate([stack]).calibration, path)


def broken_frames(
    settings: SimulationSettings, calibration: Path, cycles: int, work: Path
) -> Iterator[Figure]:
    """Of localizer and pose_estimator: before each of ``cycles`` good frames a broken one and nonsense in place
    of localizations; after it, what comes again and late."""
    # Two of three cycles and frame numbers are left to what is broken.
    good = [
        replace(frame, cycle=3 * frame.cycle, frame_counter=3 * frame.frame_counter + 2)
        for frame in motion_frames(settings, cycles)
    ]
    optics = load_calibration(calibration)
    localizer, estimator = Localizer(optics.camera, optics), PoseEstimator()
    found = [localizer.localize(frame) for frame in good]
    expected = {pose.stamp_ns: pose for pose in map(estimator.update, found) if pose.valid}

    with running(chain(None, calibration=str(calibration)), work / "frames.log") as (system, intruder):
        images = intruder.publisher(Image, topics.IMAGE)
        infos = intruder.publisher(FrameInfo, topics.FRAME_INFO)
        localizations = intruder.publisher(Localizations, topics.LOCALIZATIONS)
        poses: dict[int, list[CyclePose]] = defaultdict(list)
        intruder.listen(
            Pose6DOF,
            topics.POSE_6DOF,
            lambda message: poses[messages.nanoseconds(message.header.stamp)].append(
                messages.to_cycle_pose(message)
            ),
        )

        def send(frame: Frame, fault: Callable[[Image], None] = lambda image: None) -> None:
            infos.publish(messages.to_rclpy(messages.frame_info(frame)))
            images.publish(broken.spoiled(messages.to_rclpy(messages.image(frame)), fault))

        broken_images = broken_localizations = repeated = 0
        for k, (frame, there) in enumerate(zip(good, found, strict=True)):
            between = replace(
                frame, stamp_ns=frame.stamp_ns - 4_000_000, frame_counter=frame.frame_counter - 2
            )
            image_faults = list(broken.IMAGE_FAULTS.values())
            send(replace(between, cycle=frame.cycle - 2), image_faults[k % len(image_faults)])
            broken_images += 1
            intruder.until(lambda: poses[between.stamp_ns], "pose of a broken image")
            message = messages.to_rclpy(messages.localizations(there))
            for fault in broken.LOCALIZATIONS_FAULTS.values():
                localizations.publish(broken.spoiled(message, fault))
                broken_localizations += 1
            nonsense = replace(
                there,
                stamp_ns=frame.stamp_ns - 2_000_000,
                frame_counter=frame.frame_counter - 1,
                cycle=frame.cycle - 1,
            )
            faults = list(broken.LOCALIZATIONS_NONSENSE.values())
            message = messages.to_rclpy(messages.localizations(nonsense))
            localizations.publish(broken.spoiled(message, faults[k % len(faults)]))
            intruder.until(lambda: poses[nonsense.stamp_ns], "pose of nonsense")
            send(frame)
            intruder.until(lambda: poses[frame.stamp_ns], "pose")
            send(frame)  # again
            send(replace(frame, stamp_ns=frame.stamp_ns - 1_000_000))  # late
            localizations.publish(messages.to_rclpy(messages.localizations(there)))
            late = replace(there, stamp_ns=there.stamp_ns - 1_000_000)
            localizations.publish(messages.to_rclpy(messages.localizations(late)))
            repeated += 2
        counted = intruder.counts_settled("localizer", "pose_estimator")
        ended = system.poll()
    measured = {stamp: poses[stamp][0] for stamp in expected if poses[stamp] and poses[stamp][0].valid}
    apart = [abs(pose.displacement - expected[stamp].displacement).max() for stamp, pose in measured.items()]
    refused = {name: counts.get("refused", 0) for name, counts in counted.items()}
    yield _information("good frames", len(good))
    yield _exact("nodes that ended", len(ended), 0)
    yield _exact("valid poses of good frames", len(measured), len(expected))
    yield _figure("largest departure from the poses without disturbance, m or rad", max(apart), SAME)
    yield _exact(
        "valid poses of anything else", sum(p[0].valid for s, p in poses.items() if s not in expected), 0
    )
    yield _exact("poses beyond one a frame", sum(len(p) - 1 for p in poses.values()), 0)
    total = broken_images + repeated
    yield _exact(
        f"localizer: images refused of {total} broken, repeated or late", refused["localizer"], total
    )
    total = broken_localizations + repeated
    yield _exact(
        f"pose_estimator: localizations refused of {total} broken, repeated or late",
        refused["pose_estimator"],
        total,
    )
    yield _exact(
        "localizer: frames lost, which are the numbers of nonsense", counted["localizer"]["lost"], len(good)
    )
    yield _exact("pose_estimator: localizations lost", counted["pose_estimator"].get("lost", 0), 0)


def fuzzed_topics(
    settings: SimulationSettings, calibration: Path, rounds: int, seed: int, work: Path
) -> Iterator[Figure]:
    """Of a whole closed loop with recorder and monitor: on every topic that any of its nodes subscribes to,
    ``rounds`` messages of fields that nobody expects, and as many that are no messages. Then the loop must
    still reach a target."""
    rng = random.Random(seed)
    nodes = chain(
        commanded(**settings.to_dict()),
        calibration=str(calibration),
        controller=NodeSpec("controller"),
        output=str(work / "bag"),
        monitor=NodeSpec("monitor", {"port": 0}),
    )
    names = [node.executable for node in nodes]
    with running(nodes, work / "fuzzed.log") as (system, intruder):
        states: list[ControllerState] = []
        poses: list[Pose6DOF] = []
        intruder.listen(ControllerState, topics.CONTROLLER_STATE, states.append, ANSWERS)
        targets = intruder.publisher(Float64, topics.PSI_TARGET, listeners=2)  # controller and recorder
        intruder.listen(Pose6DOF, topics.POSE_6DOF, poses.append)
        intruder.until(lambda: poses, "first pose")

        def go(target: float) -> bool:
            since = len(states)
            targets.publish(Float64(data=target))
            intruder.until(lambda: any(state.state in _RESTING for state in states[since:]), "end of motion")
            return states[-1].state == ControllerState.STATE_ARRIVED

        def tries(target: float) -> int:
            """Frames from the future, as some will be, are not believed for long, but the loop stops."""
            return next((k for k in range(1, _MOST_TRIES) if go(target)), _MOST_TRIES)

        calm = tries(0.3)
        attacked = {
            (topic, kinds[0])
            for name in names
            for topic, kinds in intruder.node.get_subscriber_names_and_types_by_node(
                name, f"/{intruder.namespace}"
            )
            if topic not in _NOT_OURS
        }
        sent = 0
        for topic, typename in sorted(attacked):
            package, _, name = typename.split("/")
            kind = getattr(importlib.import_module(f"{package}.msg"), name)
            publisher = intruder.publisher(kind, topic)
            for _ in range(rounds):
                for message in (broken.fuzzed(kind, rng), *broken.garbage(kind, rng)):
                    with contextlib.suppress(RCLError):  # longer than any message of a fixed size
                        publisher.publish(message)
                        sent += 1
                time.sleep(0.02)  # those who keep the last ten see them all
        intruder.call(Trigger, "controller/stop")
        intruder.call(Trigger, "pose_estimator/reset")
        after = tries(0.3)
        counted = intruder.counts_settled(*names)
        ended = system.poll()
    yield _information("topics that nodes subscribe to", len(attacked))
    yield _information("fuzzed messages and garbage sent", sent)
    yield _exact("nodes that ended", len(ended), 0)
    yield _exact("nodes that still report", len(counted), len(names))
    yield _information("messages refused", sum(counts.get("refused", 0) for counts in counted.values()))
    yield _exact("targets sent until one was reached, before", calm, 1)
    yield _figure("targets sent until one was reached, after", after, _MOST_TRIES - 1)
    with (work / "bag" / "bag_0.mcap").open("rb") as stream:
        recorded = sum(1 for _ in make_reader(stream).iter_messages())
    yield _figure(
        "recorded messages that a reader does not find", counted["recorder"]["messages"] - recorded, 0
    )


@contextlib.contextmanager
def running(nodes: Sequence[NodeSpec], log: Path) -> Iterator[tuple[RunningSystem, Intruder]]:
    """``nodes`` in a namespace of their own, what they print in ``log``, and an intruder among them."""
    namespace = f"lab_{os.getpid()}"
    with (
        log.open("w", encoding="utf-8") as lines,
        Intruder(namespace) as intruder,
        run_system(nodes, namespace=namespace, on_line=lambda line: print(line, file=lines)) as system,
    ):
        intruder.check = lambda: _check(system, log)
        yield system, intruder


def _check(system: RunningSystem, log: Path) -> None:
    if ended := system.poll():
        raise Mems6dofError(f"{', '.join(ended)} ended, see {log}")


class Intruder:
    """A node that publishes what it likes, and hears; its callbacks run in a thread of their own."""

    def __init__(self, namespace: str) -> None:
        for name, value in transport.LOCALHOST_ONLY.items():
            os.environ.setdefault(name, value)
        transport.use_profile(frames=True)
        self.namespace = namespace
        self.check: Callable[[], None] = lambda: None
        self.diagnostics: dict[str, dict[str, str]] = {}
        self.reports: dict[str, int] = defaultdict(int)
        self._context = Context()
        rclpy.init(args=[], context=self._context, signal_handler_options=SignalHandlerOptions.NO)
        self.node = Node("intruder", context=self._context, namespace=namespace)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._changed, self._closing = threading.Condition(), False
        self._thread = threading.Thread(target=self._spin, name="intruder", daemon=True)
        self.listen(DiagnosticArray, "/diagnostics", self._on_diagnostics)
        self._thread.start()

    def __enter__(self) -> Intruder:
        return self

    def __exit__(self, *_: object) -> None:
        self._closing = True
        self._thread.join()
        self._executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self._context)

    def _spin(self) -> None:
        while not self._closing:
            self._executor.spin_once(timeout_sec=0.05)
            with self._changed:
                self._changed.notify_all()

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            namespace, _, name = status.name.rpartition("/")
            if namespace == self.namespace:
                self.diagnostics[name] = {pair.key: pair.value for pair in status.values}
                self.reports[name] += 1

    def listen(
        self, kind: type, topic: str, act: Callable[[Any], None], quality: QoSProfile = transport.MESSAGES
    ) -> None:
        """Call ``act`` with each message."""
        self.node.create_subscription(kind, topic, act, quality)

    def call(self, kind: type, service: str) -> None:
        """Call a service and wait for its answer."""
        client = self.node.create_client(kind, service)
        self.until(client.service_is_ready, f"service {service}")
        answer = client.call_async(kind.Request())  # type: ignore[attr-defined]
        self.until(answer.done, f"answer of {service}")

    def publisher(self, kind: type, topic: str, listeners: int = 1) -> Any:
        """A publisher that so many listen to."""
        wanted = self.node.get_subscriptions_info_by_topic(topic)
        lasting = any(end.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL for end in wanted)
        quality = ANSWERS if lasting else transport.FRAMES if kind is Image else transport.MESSAGES
        publisher = self.node.create_publisher(kind, topic, quality)
        self.until(lambda: publisher.get_subscription_count() >= listeners, f"subscriber of {topic}")
        return publisher

    def until(self, condition: Callable[[], Any], what: str, timeout: float = _PATIENCE) -> None:
        """Wait for ``condition``; Mems6dofError says that ``what`` did not come within ``timeout`` s."""
        deadline = time.monotonic() + timeout
        with self._changed:
            while not condition():
                self.check()
                if time.monotonic() > deadline:
                    raise Mems6dofError(f"no {what} within {timeout:g} s")
                self._changed.wait(0.1)

    def counts_settled(self, *names: str) -> dict[str, dict[str, int]]:
        """The totals of these nodes, reported after everything that was sent has been dealt with."""
        before = dict(self.reports)
        self.until(
            lambda: all(self.reports[name] >= before.get(name, 0) + 3 for name in names), "diagnostics"
        )
        return {
            name: {key: int(value) for key, value in self.diagnostics[name].items() if value.isdecimal()}
            for name in names
        }


def _figure(quantity: str, measured: float, most: float) -> Figure:
    passed = bool(measured <= most)
    return {"quantity": quantity, "measured": float(measured), "required": f"<= {most:g}", "passed": passed}


def _exact(quantity: str, measured: float, wanted: float) -> Figure:
    passed = bool(measured == wanted)
    return {"quantity": quantity, "measured": float(measured), "required": f"{wanted:g}", "passed": passed}


def _information(quantity: str, measured: float) -> Figure:
    return {"quantity": quantity, "measured": float(measured), "required": "", "passed": None}
