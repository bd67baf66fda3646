"""What broken messages do to the nodes, as figures of `mems6dof validate lab`.

A good recording is measured while somebody else publishes nonsense on the same topics: what is refused must
be counted, and what is measured must not change.
"""

from __future__ import annotations

import contextlib
import importlib
import random
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from mcap.reader import make_reader
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.qos import QoSProfile
from sensor_msgs.msg import Image
from std_msgs.msg import Float64
from std_srvs.srv import Trigger

from mems6dof_msgs.msg import ActuationAcknowledgement, ControllerState, FrameInfo, Localizations, Pose6DOF
from mems6dof_ros.calibration.calibrate import calibrate
from mems6dof_ros.calibration.file import load_calibration, save_calibration
from mems6dof_ros.calibration.focus_stack import DEFAULT_WINDOW_PX, measure_stack
from mems6dof_ros.figures import Figure, at_least, at_most, exactly, information
from mems6dof_ros.frame import Frame
from mems6dof_ros.localization.fitting import DEFAULT_WEIGHTING
from mems6dof_ros.localization.localizer import Localizer
from mems6dof_ros.nodes import transport
from mems6dof_ros.nodes.actuation import ANSWERS
from mems6dof_ros.nodes.system import NodeSpec, chain, commanded
from mems6dof_ros.nodes.validation import broken
from mems6dof_ros.nodes.validation.bystander import Bystander, running
from mems6dof_ros.pose.cycle_pose import CyclePose
from mems6dof_ros.pose.estimator import PoseEstimator
from mems6dof_ros.recording import messages, topics
from mems6dof_ros.simulation.experiment import focus_stack, motion_frames
from mems6dof_ros.simulation.settings import SimulationSettings
from mems6dof_ros.sources.simulator import camera_noise

#: A gear that fits into a small field, so that the nodes are quick.
SMALL = {"width_px": 512, "height_px": 512, "gear_diameter": 60e-6, "hub_diameter": 8e-6, "particles": 30}
#: Numerical noise of the same computation in another process, m and rad.
SAME = 1e-12
#: Topics of ROS 2 itself.
_NOT_OURS = ("/parameter_events", "/rosout", "/clock")
RCLError = rclpy_implementation.RCLError
_Fault = Callable[[Any], None]
_RESTING = (ControllerState.STATE_ARRIVED, ControllerState.STATE_STOPPED)
_MOST_TRIES = 12
_MOST_BURSTS = 5

#: A FrameInfo is refused with its image, of which ``broken_frames`` sends both.
_REFUSED_ELSEWHERE = ("localizer", topics.FRAME_INFO)


def _no_fault(message: Any) -> None:
    """Leave a message as it is."""


def figures(work: Path, seed: int, tell: Callable[[str], None]) -> Iterator[Figure]:
    """All figures, of nodes in a namespace of their own."""
    settings = SimulationSettings(**SMALL, seed=seed, optics_seed=seed)  # type: ignore[arg-type]
    tell("calibrate simulated optics")
    calibration = work / "optics.yaml"
    calibrate_quickly(settings, calibration)
    tell("broken images and localizations among good ones")
    yield from broken_frames(settings, calibration, 48, work)
    tell("nonsense on every topic")
    yield from fuzzed_topics(settings, calibration, 30, seed, work)


def calibrate_quickly(settings: SimulationSettings, path: Path) -> None:
    """A calibration of the optics of ``settings``, from as many beads as there is room for, but 200."""
    beads = min(200, 30 * settings.width_px**2 // 512**2)
    frames = focus_stack(settings, -3e-6, 3e-6, 0.25e-6, beads=beads, seed=3)
    stack = measure_stack(frames, camera_noise(settings), DEFAULT_WEIGHTING, DEFAULT_WINDOW_PX)
    save_calibration(calibrate([stack]).calibration, path)


def broken_frames(
    settings: SimulationSettings, calibration: Path, cycles: int, work: Path
) -> Iterator[Figure]:
    """Of localizer and pose_estimator: before each of ``cycles`` good frames one with a broken image or
    FrameInfo, and nonsense in place of localizations; after it, what comes again and late."""
    # Two of three cycles and frame numbers are left to what is broken.
    good = [
        replace(frame, cycle=3 * frame.cycle, frame_counter=3 * frame.frame_counter + 2)
        for frame in motion_frames(settings, cycles)
    ]
    optics = load_calibration(calibration)
    localizer, estimator = Localizer(optics.camera, optics), PoseEstimator()
    found = [localizer.localize(frame) for frame in good]
    expected = {pose.stamp_ns: pose for pose in map(estimator.update, found) if pose.valid}

    with running(chain(None, calibration=str(calibration)), work / "frames.log") as (system, bystander):
        images = bystander.publisher(Image, topics.IMAGE)
        infos = bystander.publisher(FrameInfo, topics.FRAME_INFO)
        localizations = bystander.publisher(Localizations, topics.LOCALIZATIONS)
        poses: dict[int, list[CyclePose]] = defaultdict(list)
        bystander.listen(
            Pose6DOF,
            topics.POSE_6DOF,
            lambda message: poses[messages.nanoseconds(message.header.stamp)].append(
                messages.to_cycle_pose(message)
            ),
        )

        def wait_for_pose_of(stamp_ns: int) -> None:
            bystander.until(lambda: poses[stamp_ns], f"pose of {stamp_ns} ns")

        def send(frame: Frame, of_image: _Fault = _no_fault, of_info: _Fault = _no_fault) -> None:
            infos.publish(broken.spoiled(messages.to_rclpy(messages.frame_info(frame)), of_info))
            images.publish(broken.spoiled(messages.to_rclpy(messages.image(frame)), of_image))

        frame_faults = [
            *((fault, _no_fault) for fault in broken.IMAGE_FAULTS.values()),
            *((_no_fault, fault) for fault in broken.INFO_FAULTS.values()),
        ]
        broken_images = broken_localizations = repeated = 0
        for k, (frame, there) in enumerate(zip(good, found, strict=True)):
            between = replace(
                frame, stamp_ns=frame.stamp_ns - 4_000_000, frame_counter=frame.frame_counter - 2
            )
            send(replace(between, cycle=frame.cycle - 2), *frame_faults[k % len(frame_faults)])
            broken_images += 1
            wait_for_pose_of(between.stamp_ns)
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
            wait_for_pose_of(nonsense.stamp_ns)
            send(frame)
            wait_for_pose_of(frame.stamp_ns)
            send(frame)  # again
            send(replace(frame, stamp_ns=frame.stamp_ns - 1_000_000))  # late
            localizations.publish(messages.to_rclpy(messages.localizations(there)))
            late = replace(there, stamp_ns=there.stamp_ns - 1_000_000)
            localizations.publish(messages.to_rclpy(messages.localizations(late)))
            repeated += 2
        counted = bystander.counts_settled("localizer", "pose_estimator")
        ended = system.poll()
    measured = {stamp: poses[stamp][0] for stamp in expected if poses[stamp] and poses[stamp][0].valid}
    apart = [abs(pose.displacement - expected[stamp].displacement).max() for stamp, pose in measured.items()]
    refused = {name: counts.get("refused", 0) for name, counts in counted.items()}
    yield information("good frames", len(good))
    yield exactly("nodes that ended", len(ended), 0)
    yield exactly("valid poses of good frames", len(measured), len(expected))
    yield at_most("largest departure from the poses without disturbance, m or rad", max(apart), SAME)
    yield exactly(
        "valid poses of anything else", sum(p[0].valid for s, p in poses.items() if s not in expected), 0
    )
    yield exactly("poses beyond one a frame", sum(len(p) - 1 for p in poses.values()), 0)
    total = broken_images + repeated
    yield exactly(
        f"localizer: frames refused of {total} broken, repeated or late", refused["localizer"], total
    )
    total = broken_localizations + repeated
    yield exactly(
        f"pose_estimator: localizations refused of {total} broken, repeated or late",
        refused["pose_estimator"],
        total,
    )
    yield exactly(
        "localizer: frames lost, which are the numbers of nonsense", counted["localizer"]["lost"], len(good)
    )
    yield exactly("pose_estimator: localizations lost", counted["pose_estimator"].get("lost", 0), 0)


@contextlib.contextmanager
def _again_and_late(bystander: Bystander) -> Iterator[None]:
    """Every pose and every acknowledgement comes again, and then the one before it."""
    echoing = True

    def echo(kind: type, topic: str, quality: QoSProfile, name: Callable[[Any], Any]) -> None:
        publisher = bystander.node.create_publisher(kind, topic, quality)
        known: dict[Any, Any] = {}

        def on_message(message: Any) -> None:
            if name(message) in known:  # our own
                return
            before = next(reversed(known.values()), message)
            known[name(message)] = message
            if echoing:
                publisher.publish(message)
                publisher.publish(before)

        bystander.listen(kind, topic, on_message, quality)

    echo(Pose6DOF, topics.POSE_6DOF, transport.MESSAGES, lambda pose: pose.frame_counter)
    echo(
        ActuationAcknowledgement,
        topics.ACTUATION_ACKNOWLEDGEMENT,
        ANSWERS,
        lambda answer: (answer.id, answer.received.sec, answer.received.nanosec),
    )
    yield
    echoing = False


def fuzzed_topics(
    settings: SimulationSettings, calibration: Path, rounds: int, seed: int, work: Path
) -> Iterator[Figure]:
    """Of a whole closed loop with recorder and monitor: on every topic that any of its nodes subscribes to,
    ``rounds`` messages of fields that nobody expects, and as many that are no messages. All but the recorder,
    which takes bytes as they are, must count what they refuse, and the loop must still reach a target; also
    before, while every pose and acknowledgement comes again and late."""
    rng = random.Random(seed)
    nodes = chain(
        commanded(**settings.to_dict()),
        calibration=str(calibration),
        controller=NodeSpec("controller"),
        output=str(work / "bag"),
        monitor=NodeSpec("monitor", {"port": 0}),
        watched={topics.POSE_6DOF: "bystander"},
    )
    names = [node.executable for node in nodes]
    with running(nodes, work / "fuzzed.log") as (system, bystander):
        states: list[ControllerState] = []
        poses: list[Pose6DOF] = []
        bystander.listen(Pose6DOF, topics.POSE_6DOF, poses.append)
        bystander.listen(ControllerState, topics.CONTROLLER_STATE, states.append, ANSWERS)
        targets = bystander.publisher(Float64, topics.PSI_TARGET, listeners=2)  # controller and recorder
        bystander.until(lambda: poses, "first pose")

        def go(target: float) -> bool:
            since = len(states)
            targets.publish(Float64(data=target))
            bystander.until(lambda: any(state.state in _RESTING for state in states[since:]), "end of motion")
            return states[-1].state == ControllerState.STATE_ARRIVED

        def tries(target: float) -> int:
            """Frames from the future, as some will be, are not believed for long, but the loop stops."""
            return next((k for k in range(1, _MOST_TRIES) if go(target)), _MOST_TRIES)

        calm = tries(0.3)
        with _again_and_late(bystander):
            disturbed = tries(0.6)
        attacked: dict[tuple[str, str], list[str]] = defaultdict(list)  # who subscribes, by topic and type
        for name in names:
            for topic, kinds in bystander.subscriptions(name):
                if topic not in _NOT_OURS:
                    attacked[topic, kinds[0]].append(name)
        answers: list[ActuationAcknowledgement] = []
        bystander.listen(ActuationAcknowledgement, topics.ACTUATION_ACKNOWLEDGEMENT, answers.append, ANSWERS)

        def refusals() -> dict[str, int]:
            """By node, once they have dealt with everything; a drive tells it to who commands it."""
            counts = {name: of.get("refused", 0) for name, of in bystander.counts_settled(*names).items()}
            by_drive = sum(answer.status == ActuationAcknowledgement.STATUS_REFUSED for answer in answers)
            return {**counts, "frame_source": by_drive}

        def burst(kind: type, publisher: Any) -> int:
            """Send ``rounds`` of nonsense, then as many of garbage, after which the middleware may withhold
            good messages too; returns the number of messages."""
            sent = 0
            wrong = [message for message in broken.REFUSABLE if isinstance(message, kind)]
            nonsense = ((broken.fuzzed(kind, rng), *wrong) for _ in range(rounds))
            for several in (*nonsense, *(broken.garbage(kind, rng) for _ in range(rounds))):
                for message in several:
                    with contextlib.suppress(RCLError):  # longer than any message of a fixed size
                        publisher.publish(message)
                        sent += 1
                time.sleep(0.02)  # those who keep the last ten see them all
            return sent

        sent, before = 0, refusals()
        refused: dict[tuple[str, str], int] = {}
        for (topic, typename), listeners in sorted(attacked.items()):
            package, _, name = typename.split("/")
            kind = getattr(importlib.import_module(f"{package}.msg"), name)
            publisher = bystander.publisher(kind, topic, len(listeners))
            relative = topic.removeprefix(f"/{bystander.namespace}/")
            refusing = {
                name for name in listeners if name != "recorder" and (name, relative) != _REFUSED_ELSEWHERE
            }
            for _ in range(_MOST_BURSTS):
                sent += burst(kind, publisher)
                now = refusals()
                if all(now[name] > before[name] for name in refusing):
                    break  # else: who was sent the first may not have known the publisher yet
            refused |= {(name, relative): now[name] - before[name] for name in refusing}
            before = now
        bystander.call(Trigger, "controller/stop")
        bystander.call(Trigger, "pose_estimator/reset")
        after = tries(0.3)
        counted = bystander.counts_settled(*names)
        ended = system.poll()
    yield information("topics that nodes subscribe to", len(attacked))
    yield information("fuzzed messages and garbage sent", sent)
    yield exactly("nodes that ended", len(ended), 0)
    yield exactly("nodes that still report", len(counted), len(names))
    yield information("messages refused", sum(counts.get("refused", 0) for counts in counted.values()))
    for (name, topic), count in sorted(refused.items()):
        yield at_least(f"{name}: refused on {topic}", count, 1)
    yield exactly("targets sent until one was reached, before", calm, 1)
    # A late pose across a change of the reference stops the controller, which is safe, and once.
    what = "targets sent until one was reached, while poses and answers come again and late"
    yield at_most(what, disturbed, _MOST_TRIES - 1)
    yield at_most("targets sent until one was reached, after", after, _MOST_TRIES - 1)
    with (work / "bag" / "bag_0.mcap").open("rb") as stream:
        recorded = sum(1 for _ in make_reader(stream).iter_messages())
    yield at_most(
        "recorded messages that a reader does not find", counted["recorder"]["messages"] - recorded, 0
    )
