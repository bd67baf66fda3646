"""Topic names, relative to the namespace, of what the nodes publish and a bag holds."""

from __future__ import annotations

IMAGE = "image_raw"
CAMERA_INFO = "camera_info"
FRAME_INFO = "frame_info"
TRUTH = "truth"
LOCALIZATIONS = "localizations"
POSE_6DOF = "pose_6dof"
POSE = "pose"
POSE_WITH_COVARIANCE = "pose_with_covariance"
RELATIVE_POSE = "relative_pose"  # of a further body, in the body frame of the first
PSI_TARGET = "psi_target"
ACTUATION_COMMAND = "actuation_command"
ACTUATION_ACKNOWLEDGEMENT = "actuation_acknowledgement"
CONTROLLER_STATE = "controller_state"


def of_body(body: str, topic: str) -> str:
    """A topic of one of several bodies, other than the first."""
    return f"{body}/{topic}"
