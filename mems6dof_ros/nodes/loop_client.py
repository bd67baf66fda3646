"""An ordinary program beside a closed loop: sends targets, hears everything, and says what it took."""

from __future__ import annotations

import contextlib
import math
import os
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import rclpy
from numpy.typing import NDArray
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from std_msgs.msg import Float64
from std_srvs.srv import SetBool

from mems6dof_msgs.msg import (
    ActuationAcknowledgement,
    ActuationCommand,
    ControllerState,
    GroundTruth,
    Pose6DOF,
)
from mems6dof_ros.errors import Mems6dofError
from mems6dof_ros.nodes import transport
from mems6dof_ros.nodes.actuation import ANSWERS
from mems6dof_ros.recording import topics
from mems6dof_ros.recording.messages import nanoseconds

#: What a client listens to: for ``system.chain(watched=...)``.
WATCHED = {topics.POSE_6DOF: "loop_client", topics.TRUTH: "loop_client"}

_RESTING = (ControllerState.STATE_ARRIVED, ControllerState.STATE_STOPPED)


class LoopClient:
    """Messages by topic in ``received``, in the order in which they came."""

    def __init__(self, node: Node, executor: SingleThreadedExecutor, check: Callable[[], None]) -> None:
        self.received: dict[str, list[Any]] = defaultdict(list)
        self._node, self._executor, self._check = node, executor, check
        for topic, kind, quality in (
            (topics.POSE_6DOF, Pose6DOF, transport.MESSAGES),
            (topics.TRUTH, GroundTruth, transport.MESSAGES),
            (topics.ACTUATION_COMMAND, ActuationCommand, transport.MESSAGES),
            (topics.ACTUATION_ACKNOWLEDGEMENT, ActuationAcknowledgement, ANSWERS),
            (topics.CONTROLLER_STATE, ControllerState, ANSWERS),
        ):
            node.create_subscription(kind, topic, self.received[topic].append, quality)
        self._targets = node.create_publisher(Float64, topics.PSI_TARGET, transport.MESSAGES)

    @property
    def states(self) -> list[ControllerState]:
        """Of the controller, all that came."""
        return self.received[topics.CONTROLLER_STATE]

    @property
    def cycles(self) -> int:
        """Motion cycles that the drive has completed, by the latest truth."""
        return int(self.received[topics.TRUTH][-1].cycle)

    def until(self, condition: Callable[[], Any], what: str, timeout: float = 60.0) -> None:
        """Let messages come until ``condition``; Mems6dofError says that ``what`` did not come in time, s."""
        deadline = time.monotonic() + timeout
        while not condition():
            self._check()
            if time.monotonic() > deadline:
                raise Mems6dofError(f"closed loop: no {what} within {timeout:g} s")
            self._executor.spin_once(timeout_sec=0.1)

    def ready(self, listeners: int = 1) -> None:
        """Wait until the gear has been seen as it stands, and so many listen for targets."""
        self.until(lambda: self.received[topics.TRUTH] and self.received[topics.POSE_6DOF], "first pose")
        self.until(lambda: self._targets.get_subscription_count() >= listeners, "controller")

    def send(self, target: float) -> None:
        """Send a target, psi in rad, and return at once."""
        self._targets.publish(Float64(data=target))

    def rest(self, since: int, timeout: float = 120.0) -> ControllerState:
        """Wait until a state after the first ``since`` says that the controller rests, and return it."""

        def resting() -> list[ControllerState]:
            return [state for state in self.states[since:] if state.state in _RESTING]

        self.until(resting, "end of the motion", timeout)
        return resting()[0]

    def go(self, target: float) -> ControllerState:
        """Send a target and wait until the controller rests, with all that it did before heard."""
        since = len(self.states)
        self.send(target)
        state = self.rest(since)
        if state.state == ControllerState.STATE_ARRIVED:
            stamp = state.header.stamp
            self.until(
                lambda: self.received[topics.TRUTH][-1].header.stamp == stamp, "truth of the last frame"
            )
        return state

    def call(self, service: str, value: bool) -> None:
        """Call a service of type SetBool: frame_source/cover, actuation_enable."""
        client = self._node.create_client(SetBool, service)
        self.until(client.service_is_ready, f"service {service}")
        answer = client.call_async(SetBool.Request(data=value))
        self.until(answer.done, f"answer of {service}")

    def truth_of(self, pose_stamp: Any) -> GroundTruth:
        """The truth of the frame with that stamp."""
        return next(
            truth for truth in reversed(self.received[topics.TRUTH]) if truth.header.stamp == pose_stamp
        )


@contextlib.contextmanager
def loop_client(check: Callable[[], None] = lambda: None, namespace: str = "") -> Iterator[LoopClient]:
    """A LoopClient on this machine; ``check`` is called while it waits, and may raise."""
    for name, value in transport.LOCALHOST_ONLY.items():
        os.environ.setdefault(name, value)
    transport.use_profile(frames=False)
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)  # Ctrl-C belongs to the program
    try:
        node = rclpy.create_node("loop_client", namespace=namespace)
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        yield LoopClient(node, executor, check)
        executor.shutdown()
        node.destroy_node()
    finally:
        rclpy.try_shutdown()


def stages(client: LoopClient) -> dict[str, NDArray[np.float64]]:
    """Durations (n,) s of what happens between one command and the next, in that order, for each cycle that
    led to a command; and of the sums ``bare transport`` and ``reaction``, from a frame's publication to the
    command that answers it."""
    commands = {message.id: message for message in client.received[topics.ACTUATION_COMMAND]}
    answers = {message.id: message for message in client.received[topics.ACTUATION_ACKNOWLEDGEMENT]}
    poses = {nanoseconds(pose.header.stamp): pose for pose in client.received[topics.POSE_6DOF]}
    table = defaultdict(list)
    for state in client.states:
        pose = poses.get(nanoseconds(state.header.stamp))
        command, made = commands.get(state.command_id), answers.get(state.command_id - 1)
        if pose is None or command is None or made is None or math.isnan(state.latency_reaction):
            continue
        before = commands[made.id]
        row = {
            "command to drive": _seconds(made.received, before.header.stamp),
            "wait for the next period": _seconds(made.started, made.received),
            "motion": _seconds(made.ended, made.started),
            "motion to exposure": _seconds(pose.header.stamp, made.ended),
            "exposure to publication": pose.latency_capture,
            "frame to localizer": pose.latency_frame_transport,
            "queue": pose.latency_queue,
            "localization": pose.latency_localization,
            "localizations to estimator": pose.latency_localization_transport,
            "pose": pose.latency_pose,
            "pose to controller": state.latency_pose_transport,
            "decision": state.latency_decision,
            "bare transport": pose.latency_frame_transport
            + pose.latency_localization_transport
            + state.latency_pose_transport,
            "reaction": state.latency_reaction,
        }
        for name, seconds in row.items():
            table[name].append(seconds)
    return {name: np.array(values) for name, values in table.items()}


def _seconds(later: Any, earlier: Any) -> float:
    return (nanoseconds(later) - nanoseconds(earlier)) * 1e-9


def psi_truth(client: LoopClient, stamps: Sequence[Any]) -> NDArray[np.float64]:
    """True psi (n,) rad of the frames with ``stamps``, from the first frame on."""
    start = client.received[topics.TRUTH][0].psi
    return np.array([client.truth_of(stamp).psi - start for stamp in stamps])
