"""``controller``: poses and targets in, commands to the drive out.

Subscribes to ``psi_target`` (std_msgs/Float64, rad), ``pose_6dof`` and ``actuation_acknowledgement``;
publishes ``actuation_command`` and, at every decision, ``controller_state``. Service (std_srvs/Trigger):
``~/stop``. What is decided, and when it stops: control.controller. Which motion: the parameter ``law``, by
default control.position.
"""

from __future__ import annotations

import importlib
import math
import sys
import time
from collections.abc import Callable

from rclpy.clock import Clock, ClockType
from std_msgs.msg import Float64
from std_srvs.srv import Trigger

from mems6dof_msgs.msg import ActuationAcknowledgement, ActuationCommand, ControllerState, Pose6DOF
from mems6dof_ros.control.controller import Controller, ControllerSettings, Decision, State
from mems6dof_ros.control.position import DriveSettings, Law
from mems6dof_ros.errors import InputError
from mems6dof_ros.nodes import transport
from mems6dof_ros.nodes.actuation import ANSWERS, command_message, to_acknowledgement
from mems6dof_ros.nodes.common import InstrumentNode, run
from mems6dof_ros.nodes.parameters import Parameter, of_settings, to_settings
from mems6dof_ros.recording import messages, topics

PARAMETERS = (
    Parameter("body", "load_gear", "Name of the rigid body whose psi is brought to its target."),
    Parameter(
        "law",
        "mems6dof_ros.control.position:PositionLaw",
        "module:Class that decides the motion, made from the settings of the drive: a control.position.Law.",
    ),
    *of_settings(ControllerSettings, ""),
    *of_settings(DriveSettings, "drive."),
)
_WATCHDOG_PERIOD = 0.01  # s


class ControllerNode(InstrumentNode):
    """Controller between its topics; it owns the clock and nothing else."""

    def __init__(self) -> None:
        super().__init__("controller", PARAMETERS)

    def configure(self) -> None:
        drive = to_settings(DriveSettings, "drive.", self.values)
        settings = to_settings(ControllerSettings, "", self.values)
        self._controller = Controller(settings, load_law(self.values["law"])(drive))
        self._arrival = math.nan  # of the latest pose
        self._commands = self.create_publisher(ActuationCommand, topics.ACTUATION_COMMAND, transport.MESSAGES)
        self._states = self.create_publisher(ControllerState, topics.CONTROLLER_STATE, ANSWERS)

    def activate(self) -> None:
        self.create_service(Trigger, "~/stop", self._on_stop)
        self.create_subscription(
            ActuationAcknowledgement, topics.ACTUATION_ACKNOWLEDGEMENT, self._on_acknowledgement, ANSWERS
        )
        self.create_timer(
            _WATCHDOG_PERIOD,
            lambda: self._act(self._controller.on_time(time.time())),
            clock=Clock(clock_type=ClockType.STEADY_TIME),
        )
        self.when_ready(self._missing_drive, self._subscribe)

    def _missing_drive(self) -> str:
        """A drive is who hears commands and answers them; others, such as a recorder, only hear them."""
        hearing = self.get_subscriptions_info_by_topic(topics.ACTUATION_COMMAND)
        answering = self.get_publishers_info_by_topic(topics.ACTUATION_ACKNOWLEDGEMENT)
        drives = {(end.node_namespace, end.node_name) for end in hearing} & {
            (end.node_namespace, end.node_name) for end in answering
        }
        everybody = self._commands.get_subscription_count() >= len(hearing)
        return "" if drives and everybody else f"a drive on {topics.ACTUATION_COMMAND}"

    def _subscribe(self) -> None:
        self.create_subscription(Float64, topics.PSI_TARGET, self._on_target, transport.MESSAGES)
        self.create_subscription(Pose6DOF, topics.POSE_6DOF, self._on_pose, transport.MESSAGES)
        self.tell("idle")

    def deactivate(self) -> None:
        if self._controller.state is State.MOVING:
            self._act(self._controller.stop("the controller ends"))
        super().deactivate()

    def _on_pose(self, message: Pose6DOF) -> None:
        if message.body == self.values["body"]:
            self._arrival = time.time()
            self._act(self._controller.on_pose(messages.to_cycle_pose(message), self._arrival))

    def _on_acknowledgement(self, message: ActuationAcknowledgement) -> None:
        self._act(self._controller.on_acknowledgement(to_acknowledgement(message), time.time()))

    def _on_target(self, message: Float64) -> None:
        try:
            self._act(self._controller.set_target(message.data, time.time()))
        except InputError as error:
            self.health.refused(str(error))

    def _on_stop(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._act(self._controller.stop("asked to stop"))
        response.success, response.message = True, "stopped"
        return response

    def _act(self, decision: Decision | None) -> None:
        """Publish what has been decided."""
        if decision is None:
            return
        controller, command, pose = self._controller, decision.command, decision.pose
        state = ControllerState(
            state=int(controller.state),
            reason=controller.reason,
            target=controller.target,
            error=float(pose.displacement[5]) - controller.target if pose else math.nan,
            cycles=controller.cycles,
            latency_pose_transport=math.nan,
            latency_decision=math.nan,
            latency_reaction=math.nan,
        )
        if command:
            self._commands.publish(command_message(command))
            state.command_id = command.id
            self.health.count("commands")
        if pose:
            now = time.time()
            state.header = messages.to_rclpy(messages.header(pose.stamp_ns, pose.frame_id))
            frame_published = pose.stamp_ns * 1e-9 + pose.latency.capture
            state.latency_pose_transport = self._arrival - (frame_published + pose.latency.total)
            if command:
                state.latency_decision = now - self._arrival
                state.latency_reaction = now - frame_published
                self.health.time("frame to command", state.latency_reaction)
        self._states.publish(state)
        if controller.state is State.MOVING:
            self.health.state = f"moving to {controller.target:.4f} rad"
        elif controller.state is State.STOPPED:
            self.health.lost(0, f"stopped: {controller.reason}")
            self.health.state = f"stopped: {controller.reason}"
        else:
            self.tell(f"{controller.state.name.lower()} at {controller.target:.4f} rad")


def load_law(name: str) -> Callable[[DriveSettings], Law]:
    """The class that ``module:Class`` names; InputError where there is none."""
    module, _, attribute = name.partition(":")
    try:
        law: Callable[[DriveSettings], Law] = getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError, ValueError) as error:
        raise InputError("parameter law", f"'{name}': {error}", "module:Class that can be imported") from None
    return law


def main(args: list[str] | None = None) -> int:
    """Run the node; returns the exit status."""
    return run(ControllerNode, args)


if __name__ == "__main__":
    sys.exit(main())
