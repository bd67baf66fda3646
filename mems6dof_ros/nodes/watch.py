"""Watching poses from an ordinary program: what the demonstration shows while it runs."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions

from mems6dof_msgs.msg import Pose6DOF
from mems6dof_ros.nodes import transport
from mems6dof_ros.pose.cycle_pose import CyclePose
from mems6dof_ros.recording import messages, topics


@contextlib.contextmanager
def watch_poses(
    on_pose: Callable[[CyclePose], None], namespace: str = ""
) -> Iterator[Callable[[float], None]]:
    """Call ``on_pose`` with every pose on this machine; yields ``spin(seconds)``, which lets them come."""
    for name, value in transport.LOCALHOST_ONLY.items():
        os.environ.setdefault(name, value)
    transport.use_profile(frames=False)
    # Ctrl-C belongs to the program.
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    try:
        node = rclpy.create_node("watch", namespace=namespace)
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        node.create_subscription(
            Pose6DOF,
            topics.POSE_6DOF,
            lambda message: on_pose(messages.to_cycle_pose(message)),
            transport.MESSAGES,
        )
        yield lambda seconds: executor.spin_once(timeout_sec=seconds)
    finally:
        rclpy.try_shutdown()
