"""Enlarged copies for tools that cannot show 328 um, RViz foremost: never for measurements.

They have topics (``viz/...``) and a coordinate frame of their own, so that nobody takes them for metres.
"""

from __future__ import annotations

from functools import partial

import numpy as np
from geometry_msgs.msg import PoseStamped
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2

from mems6dof_ros.nodes import transport
from mems6dof_ros.nodes.onlooker import PolledSubscriptions
from mems6dof_ros.recording import topics

POSE = "viz/pose"
POINTS = "viz/points"
#: The microscope frame with its lengths multiplied.
FRAME = "microscope_enlarged"
_LOCALIZED = "localizations/points"
_PERIOD = 0.05  # s; RViz draws no faster


class ScaledCopies:
    """Publishes ``viz/pose`` and ``viz/points``, the newest of each at 20 Hz, lengths times ``scale``."""

    def __init__(self, node: Node, scale: float) -> None:
        self._scale = scale
        self._newest: dict[str, bytes] = {}
        self._poses = node.create_publisher(PoseStamped, POSE, transport.MESSAGES)
        self._points = node.create_publisher(PointCloud2, POINTS, transport.MESSAGES)
        polled = PolledSubscriptions(node, _PERIOD, self._publish)
        for kind, topic in ((PoseStamped, topics.POSE), (PointCloud2, _LOCALIZED)):
            polled.subscribe(kind, topic, partial(self._newest.__setitem__, topic))

    def _publish(self) -> None:
        if data := self._newest.pop(topics.POSE, None):
            self._poses.publish(enlarged_pose(transport.deserialize(data, PoseStamped), self._scale))
        if data := self._newest.pop(_LOCALIZED, None):
            self._points.publish(enlarged_points(transport.deserialize(data, PointCloud2), self._scale))


def enlarged_pose(pose: PoseStamped, scale: float) -> PoseStamped:
    """``pose``, changed: position times ``scale``, orientation as it is, in FRAME."""
    pose.header.frame_id = FRAME
    position = pose.pose.position
    position.x, position.y, position.z = scale * position.x, scale * position.y, scale * position.z
    return pose


def enlarged_points(cloud: PointCloud2, scale: float) -> PointCloud2:
    """``cloud``, changed: the float32 fields x, y, z times ``scale``, in FRAME."""
    cloud.header.frame_id = FRAME
    offsets = {field.name: field.offset for field in cloud.fields}
    points = np.frombuffer(cloud.data, dtype=np.uint8).reshape(-1, cloud.point_step).copy()
    for axis in "xyz":
        column = points[:, offsets[axis] : offsets[axis] + 4]
        column[:] = (column.copy().view("<f4") * np.float32(scale)).view(np.uint8)
    cloud.data = points.tobytes()
    return cloud
