"""The stage in ROS: what a node that moves the focal plane adds to itself.

Service (relative): ``move_stage`` (mems6dof_msgs/MoveStage). A node for a piezo stage of your own is a node
and this one call, with an object that has ``move_to``.
"""

from __future__ import annotations

import time

from builtin_interfaces.msg import Time
from rclpy.node import Node

from mems6dof_msgs.srv import MoveStage
from mems6dof_ros.errors import Mems6dofError
from mems6dof_ros.sources.stage import Stage

#: Name of the service.
MOVE_STAGE = "move_stage"


def serve_stage(node: Node, stage: Stage) -> None:
    """Let ``node`` move ``stage`` when asked; its other callbacks wait meanwhile."""

    def on_move(request: MoveStage.Request, response: MoveStage.Response) -> MoveStage.Response:
        try:
            response.z = float(stage.move_to(request.z))
            response.success = True
        except Mems6dofError as error:
            response.message = str(error)
        settled_ns = time.time_ns()
        response.settled = Time(sec=settled_ns // 10**9, nanosec=settled_ns % 10**9)
        return response

    node.create_service(MoveStage, MOVE_STAGE, on_move)
