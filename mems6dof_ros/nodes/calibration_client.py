"""Asks the calibrator for a calibration, shows its progress, and cancels when interrupted."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from typing import Any

import rclpy
from action_msgs.msg import GoalStatus
from rclpy.action import ActionClient
from rclpy.executors import SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions

from mems6dof_msgs.action import Calibrate
from mems6dof_ros.errors import Mems6dofError
from mems6dof_ros.nodes import transport
from mems6dof_ros.nodes.calibrator import CALIBRATE

#: Seconds in which a calibrator must be found, and in which it must have cancelled.
FIND_TIMEOUT, CANCEL_TIMEOUT = 10.0, 60.0


def request_calibration(
    goal: Calibrate.Goal,
    on_feedback: Callable[[Calibrate.Feedback], None] = lambda _: None,
    namespace: str = "",
) -> Calibrate.Result:
    """The result of ``goal``.

    Raises Mems6dofError where no calibrator takes it or it fails. KeyboardInterrupt, also one that
    ``on_feedback`` raises, cancels the goal before it goes on.
    """
    transport.use_profile(frames=False)
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)  # Ctrl-C belongs to the program
    node = rclpy.create_node(f"calibration_client_{os.getpid()}", namespace=namespace)
    client = ActionClient(node, Calibrate, CALIBRATE, feedback_sub_qos_profile=transport.MESSAGES)
    try:
        executor = SingleThreadedExecutor()
        executor.add_node(node)

        def until(done: Callable[[], Any], timeout: float = float("inf")) -> bool:
            deadline = time.monotonic() + timeout
            while not done():
                if time.monotonic() > deadline:
                    return False
                executor.spin_once(timeout_sec=0.1)
            return True

        name = f"{node.get_namespace().rstrip('/')}/{CALIBRATE}"
        if not until(client.server_is_ready, FIND_TIMEOUT):
            raise Mems6dofError(f"action {name}: found nobody; expected a calibrator that runs")
        sent = client.send_goal_async(goal, lambda message: on_feedback(message.feedback))
        until(sent.done)
        handle = sent.result()
        if not handle.accepted:
            raise Mems6dofError(f"action {name}: the goal was refused: another one is being calibrated")
        answer = handle.get_result_async()
        try:
            until(answer.done)
        except KeyboardInterrupt:
            handle.cancel_goal_async()
            until(answer.done, CANCEL_TIMEOUT)
            raise
        if answer.result().status != GoalStatus.STATUS_SUCCEEDED:
            raise Mems6dofError(answer.result().result.message or f"action {name}: aborted")
        return answer.result().result
    finally:
        client.destroy()
        node.destroy_node()
        rclpy.try_shutdown()
