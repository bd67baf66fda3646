"""How messages travel: Fast DDS profiles, quality of service, large buffers.

Without a profile, a 2048 x 2048 frame goes in 64 kB fragments through a shared-memory segment of half a
megabyte, and a reader of 90 of them a second loses some. The profiles here size the segment
for frames; only processes that publish frames pay for the large one.
"""

from __future__ import annotations

import os
import shutil
import struct
from pathlib import Path
from typing import Any

from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message

from mems6dof_ros.errors import InputError, Mems6dofError
from mems6dof_ros.nodes import shared_memory
from mems6dof_ros.recording.messages import Message, serialize

_SHARED_MEMORY = shared_memory.FOLDER
_MEBIBYTE = 2**20
#: Profile and what its segment with everything around it takes of /dev/shm, MiB.
_MESSAGES = (Path(__file__).with_name("fastdds.xml"), 10)
_FRAMES = (Path(__file__).with_name("fastdds_frames.xml"), 136)

# Jazzy reads the first name only, Kilted calls it deprecated.
_PROFILE_VARIABLES = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")

#: Environment of processes that talk only to processes on this machine.
LOCALHOST_ONLY = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}


def _reliable(depth: int) -> QoSProfile:
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.VOLATILE,
    )


#: Quality of service of images, and of everything else: reliable, as much kept as the segment holds.
FRAMES = _reliable(10)
MESSAGES = _reliable(100)


def for_images(node: Node, topic: str) -> QoSProfile:
    """Of a subscription: FRAMES, or best effort where a camera driver would else send us nothing."""
    offered = node.get_publishers_info_by_topic(node.resolve_topic_name(topic))
    if any(each.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT for each in offered):
        return QoSProfile(depth=FRAMES.depth, reliability=ReliabilityPolicy.BEST_EFFORT)
    return FRAMES


def use_profile(*, frames: bool) -> str:
    """Choose the Fast DDS profile of this process, before ``rclpy.init``; returns a warning or "".

    ``frames``: the process publishes images. A profile, or another middleware, that the user has set in the
    environment stays. Raises Mems6dofError where /dev/shm is too full for any ROS 2 process to start:
    Fast DDS would die without a word.
    """
    if os.environ.get("RMW_IMPLEMENTATION", "rmw_fastrtps_cpp") != "rmw_fastrtps_cpp":
        return ""
    given = {os.environ[name] for name in _PROFILE_VARIABLES if name in os.environ}
    if given - {str(_MESSAGES[0]), str(_FRAMES[0])}:
        return ""
    warning = ""
    profile, need = _FRAMES if frames else _MESSAGES
    free = _free_shared_memory(need)
    if free < need and shared_memory.remove_abandoned():
        free = _free_shared_memory(need)
    if free < _MESSAGES[1]:
        raise Mems6dofError(
            f"{_SHARED_MEMORY}: found {free} MiB free; expected {need} MiB or more: enlarge it, or end"
            " processes that fill it"
        )
    if free < need:
        warning = f"{_SHARED_MEMORY}: {free} of {need} MiB free: large frames will be slow or lost"
        profile = _MESSAGES[0]
    for name in _PROFILE_VARIABLES:
        os.environ[name] = str(profile)
    return warning


def _free_shared_memory(otherwise: int) -> int:
    """MiB; ``otherwise`` where the system has none."""
    if not _SHARED_MEMORY.is_dir():
        return otherwise
    return shutil.disk_usage(_SHARED_MEMORY).free // _MEBIBYTE


def publish(publisher: Publisher, message: Message) -> None:
    """Publish ``message`` serialized: rclpy's own way checks and converts it field by field, three times
    slower."""
    publisher.publish(bytes(serialize(message)))


def stamp_of(data: bytes) -> int:
    """Stamp, ns, of a serialized message that begins with a header: 4 bytes of CDR, then two integers;
    InputError where it is shorter."""
    if len(data) < 12:
        raise InputError("serialized message", f"{len(data)} bytes", "a header")
    seconds, nanoseconds = struct.unpack_from("<iI" if data[1] & 1 else ">iI", data, 4)
    return int(seconds) * 10**9 + int(nanoseconds)


def deserialize(data: bytes, kind: type) -> Any:
    """The message of ``kind`` that ``data`` is; InputError where it is none."""
    try:
        return deserialize_message(data, kind)
    except RuntimeError as error:
        raise InputError(kind.__name__, f"{len(data)} bytes that are none", "a serialized message") from error
