"""What is said of the poses of one frame, live and offline alike: topics, and their messages.

The first body has the usual topics, so that who follows one body need not know of others; each further one
has the same below its own name, and there its pose relative to the first.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

from mems6dof_ros.pose.bodies import relative_pose
from mems6dof_ros.pose.cycle_pose import CyclePose
from mems6dof_ros.recording import messages, topics
from mems6dof_ros.recording.messages import Message

_TYPES = {
    topics.POSE_6DOF: "mems6dof_msgs/msg/Pose6DOF",
    topics.POSE: "geometry_msgs/msg/PoseStamped",
    topics.POSE_WITH_COVARIANCE: "geometry_msgs/msg/PoseWithCovarianceStamped",
}


def pose_topics(bodies: Sequence[str]) -> dict[str, str]:
    """Topics, relative to the namespace, and types for bodies of these names, in order."""
    found = dict(_TYPES)
    for body in bodies[1:]:
        found |= {topics.of_body(body, topic): kind for topic, kind in _TYPES.items()}
        found[topics.of_body(body, topics.RELATIVE_POSE)] = _TYPES[topics.POSE_WITH_COVARIANCE]
    return found


def pose_messages(poses: Sequence[CyclePose]) -> Iterator[tuple[str, Message]]:
    """Topic and message of everything said of ``poses``, one for each body in order; where a pose is not
    valid, ``pose_6dof`` alone says so."""
    for number, pose in enumerate(poses):
        prefix = "" if number == 0 else topics.of_body(pose.body, "")
        message = messages.pose6dof(pose)
        yield prefix + topics.POSE_6DOF, message
        if not pose.valid:
            continue
        yield prefix + topics.POSE, messages.pose_stamped(message)
        yield prefix + topics.POSE_WITH_COVARIANCE, messages.pose_with_covariance_stamped(message)
        if number > 0 and poses[0].valid:
            relative = messages.pose6dof(_relative(pose, poses[0]))
            yield prefix + topics.RELATIVE_POSE, messages.pose_with_covariance_stamped(relative)


def _relative(of: CyclePose, to: CyclePose) -> CyclePose:
    """Pose of ``of`` in the body frame of ``to``, which is named after that body."""
    pose, covariance = relative_pose(of, to)
    return replace(
        of, frame_id=to.body, rotation=pose.rotation, translation=pose.translation, covariance=covariance
    )
