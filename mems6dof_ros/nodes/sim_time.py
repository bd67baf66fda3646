"""Simulated time: what a node does when it jumps back."""

from __future__ import annotations

from collections.abc import Callable

from rclpy.clock import JumpHandle, JumpThreshold, TimeJump
from rclpy.duration import Duration
from rclpy.node import Node


def on_jump_back(node: Node, act: Callable[[float], None]) -> JumpHandle:
    """Call ``act`` with the seconds by which ``/clock`` has jumped back, each time; never without
    ``use_sim_time``. Keep the handle: without it nobody is called."""

    def jumped(jump: TimeJump) -> None:
        act(-jump.delta.nanoseconds * 1e-9)

    threshold = JumpThreshold(min_forward=None, min_backward=Duration(nanoseconds=-1), on_clock_change=False)
    return node.get_clock().create_jump_callback(threshold, post_callback=jumped)
