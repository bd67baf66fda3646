"""The actuation interface in ROS: what a node that drives the microsystem adds to itself.

Topics (relative): ``actuation_command`` in, ``actuation_acknowledgement`` out. Service (std_srvs/SetBool):
``actuation_enable``: false stops the drive within one cycle and refuses commands until it is true again.
"""

from __future__ import annotations

import time
from typing import Any

from builtin_interfaces.msg import Time
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from std_srvs.srv import SetBool

from mems6dof_msgs.msg import ActuationAcknowledgement, ActuationCommand
from mems6dof_ros.control.actuator import Actuator
from mems6dof_ros.control.commands import Acknowledgement, Command, Motion, Outcome
from mems6dof_ros.errors import InputError
from mems6dof_ros.nodes import transport
from mems6dof_ros.recording import topics
from mems6dof_ros.recording.messages import nanoseconds
from mems6dof_ros.sources.simulator import CommandedSimulator

#: Kept for those that come late: an answer must reach a controller however fast discovery was.
ANSWERS = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=10,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)


def serve_actuation(node: Node, actuator: Actuator) -> None:
    """Give ``node`` the actuation interface in front of ``actuator``, whose cycles another thread makes."""
    answers = node.create_publisher(ActuationAcknowledgement, topics.ACTUATION_ACKNOWLEDGEMENT, ANSWERS)

    def answer(acknowledgement: Acknowledgement) -> None:
        if acknowledgement.outcome is Outcome.REFUSED:
            node.get_logger().warning(f"command {acknowledgement.id} refused: {acknowledgement.reason}")
        answers.publish(acknowledgement_message(acknowledgement))

    def on_enable(request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        actuator.enable(request.data)
        response.success, response.message = True, "enabled" if request.data else "disabled"
        node.get_logger().info(f"drive {response.message}")
        return response

    actuator.on_acknowledgement = answer
    node.create_subscription(
        ActuationCommand,
        topics.ACTUATION_COMMAND,
        lambda message: actuator.submit(to_command(message)),
        transport.MESSAGES,
    )
    node.create_service(SetBool, "actuation_enable", on_enable)


def serve_commanded_simulator(node: Node, source: CommandedSimulator) -> None:
    """The actuation interface of the simulated microsystem; and ``~/cover`` (std_srvs/SetBool), which covers
    its lens."""

    def on_cover(request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        source.experiment.cover(request.data)
        response.success, response.message = True, "covered" if request.data else "uncovered"
        return response

    serve_actuation(node, source.actuator)
    node.create_service(SetBool, "~/cover", on_cover)


# Messages ----------------------------------------------------------------------------------------


def command_message(command: Command) -> ActuationCommand:
    """ActuationCommand, published now."""
    message = ActuationCommand(
        id=command.id,
        cycles=command.motion.cycles,
        frequency=float(command.frequency),
        amplitude=float(command.motion.amplitude),
        direction=command.motion.direction,
        expires=_time(command.expires_ns),
        pose_stamp=_time(command.pose_stamp_ns),
    )
    message.header.stamp = _time(time.time_ns())
    return message


def to_command(message: ActuationCommand) -> Command:
    """The core type."""
    motion = Motion(message.cycles, message.amplitude, message.direction)
    return Command(
        message.id, motion, message.frequency, nanoseconds(message.expires), nanoseconds(message.pose_stamp)
    )


def acknowledgement_message(acknowledgement: Acknowledgement) -> ActuationAcknowledgement:
    """ActuationAcknowledgement, published now."""
    message = ActuationAcknowledgement(
        id=acknowledgement.id,
        status=int(acknowledgement.outcome),
        reason=acknowledgement.reason,
        cycles_driven=acknowledgement.cycles_driven,
        cycle=acknowledgement.cycle,
        received=_time(acknowledgement.received_ns),
        started=_time(acknowledgement.started_ns),
        ended=_time(acknowledgement.ended_ns),
    )
    message.header.stamp = _time(time.time_ns())
    return message


def to_acknowledgement(message: ActuationAcknowledgement) -> Acknowledgement:
    """The core type; InputError for a status that there is not."""
    if message.status not in set(Outcome):
        raise InputError("ActuationAcknowledgement.status", f"{message.status}", f"0 to {max(Outcome):d}")
    return Acknowledgement(
        message.id,
        Outcome(message.status),
        message.reason,
        message.cycles_driven,
        message.cycle,
        *(nanoseconds(stamp) for stamp in (message.received, message.started, message.ended)),
    )


def _time(ns: int) -> Any:
    return Time(sec=ns // 10**9, nanosec=ns % 10**9)
