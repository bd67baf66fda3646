"""Messages to and from the core types, in both worlds: ``rclpy`` and ``rosbags``.

A core type becomes a neutral ``Message`` (type name and fields), and one small builder per world
turns that into an instance there (``to_rclpy``, ``to_rosbags``); ``serialize`` into what is published and
written. Messages of both worlds are read by attribute, so one function per type reads either.

Not carried by the messages, hence lost on the way back: the iterations and the 7 x 7 covariance
of a fit, of which the 3 x 3 covariance of the position is the useful part.
"""

from __future__ import annotations

import array
import importlib
import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from mems6dof_ros.errors import InputError
from mems6dof_ros.frame import NAN, Frame, GroundTruth
from mems6dof_ros.localization.localizations import FIT_PARAMETERS, Flag, GaussianFits, Latency, Localizations
from mems6dof_ros.pose.cycle_pose import DEGREES_OF_FREEDOM, CyclePose, PaperAngles, Status
from mems6dof_ros.pose.rigid import quaternion
from mems6dof_ros.recording.definitions import typestore

#: Pixel types that can be measured, by ROS image encoding.
PIXEL_TYPES = {"mono8": np.uint8, "8UC1": np.uint8, "mono16": np.uint16, "16UC1": np.uint16}

_LOCALIZATION_LATENCY = ("capture", "frame_transport", "queue", "localization")
_FIT_FLAGS = Flag.FIT_FAILED | Flag.WINDOW_CUT | Flag.SATURATED | Flag.NEIGHBOUR | Flag.POOR_FIT


@dataclass(frozen=True)
class Message:
    """A message of no particular world: ``type`` as in ``geometry_msgs/msg/Pose``, and its fields.

    Arrays are ndarrays of the field's own type, nested messages are Messages.
    """

    type: str
    fields: Mapping[str, Any]


# Builders, one per world ------------------------------------------------------------------------


def rclpy_type(name: str) -> Any:
    """The generated Python class of ``package/msg/Name``."""
    module, name = name.rsplit("/", 1)
    return getattr(importlib.import_module(module.replace("/", ".")), name)


def to_rclpy(message: Message) -> Any:
    """The message as an instance of its generated Python class, ready for ``publish``."""
    result = rclpy_type(message.type)()
    for field, value in message.fields.items():
        if isinstance(value, Message):
            value = to_rclpy(value)
        elif isinstance(sequence := getattr(result, field), array.array):
            # The only assignment that rclpy does not check element by element (seconds per frame).
            sequence = array.array(sequence.typecode)
            sequence.frombytes(np.ascontiguousarray(value, dtype=sequence.typecode).view(np.uint8).data)
            value = sequence
        setattr(result, field, value)
    return result


def to_rosbags(message: Message) -> Any:
    """The message as an instance of the ``rosbags`` type of ``definitions.typestore()``."""
    values = {
        field: to_rosbags(value) if isinstance(value, Message) else value
        for field, value in message.fields.items()
    }
    return typestore().types[message.type](**values)


def prepare(*typenames: str) -> None:
    """Make what reads and writes messages of these types, 0.2 s for the first, before one is in a hurry."""
    for typename in typenames:
        typestore().get_msgdef(typename)


def serialize(message: Message) -> memoryview:
    """The message as CDR, without ROS."""
    return typestore().serialize_cdr(to_rosbags(message), message.type)


def deserialize(data: bytes | memoryview, typename: str) -> Any:
    """CDR to a ``rosbags`` message."""
    return typestore().deserialize_cdr(data, typename)


# Core types to messages --------------------------------------------------------------------------


def frame_info(frame: Frame) -> Message:
    """mems6dof_msgs/FrameInfo of a frame."""
    return Message(
        "mems6dof_msgs/msg/FrameInfo",
        {
            "header": header(frame.stamp_ns, frame.frame_id),
            "frame_counter": frame.frame_counter,
            "cycle": frame.cycle,
            "frames_dropped": frame.frames_dropped,
            "device_time_ns": frame.device_time_ns,
            "publication_time": time(frame.published_ns),
            "exposure": float(frame.exposure_s),
            "stage_z": float(frame.stage_z),
            "pixel_size": float(frame.pixel_size),
            "saturation_adu": int(frame.saturation_adu),
            "source": frame.source,
            "live": frame.live,
        },
    )


def image(frame: Frame) -> Message:
    """sensor_msgs/Image of a frame, little-endian, rows without padding."""
    height, width = frame.image.shape
    pixels = np.ascontiguousarray(frame.image, dtype=frame.image.dtype.newbyteorder("<"))
    return Message(
        "sensor_msgs/msg/Image",
        {
            "header": header(frame.stamp_ns, frame.frame_id),
            "height": height,
            "width": width,
            "encoding": frame.encoding,
            "is_bigendian": 0,
            "step": width * pixels.itemsize,
            "data": pixels.reshape(-1).view(np.uint8),
        },
    )


def camera_info(frame: Frame) -> Message:
    """sensor_msgs/CameraInfo of a frame: size only.

    A microscope has no pinhole model; K of zeros says so by the message's own rule. The image
    scale travels in FrameInfo, the distortion in the calibration.
    """
    height, width = frame.image.shape
    roi = {"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": False}
    return Message(
        "sensor_msgs/msg/CameraInfo",
        {
            "header": header(frame.stamp_ns, frame.frame_id),
            "height": height,
            "width": width,
            "distortion_model": "",
            "d": np.zeros(0),
            "k": np.zeros(9),
            "r": np.zeros(9),
            "p": np.zeros(12),
            "binning_x": 0,
            "binning_y": 0,
            "roi": Message("sensor_msgs/msg/RegionOfInterest", roi),
        },
    )


def ground_truths(frame: Frame) -> list[Message]:
    """mems6dof_msgs/GroundTruth of every body that the simulator moved."""
    return [
        Message(
            "mems6dof_msgs/msg/GroundTruth",
            {
                "header": header(frame.stamp_ns, frame.frame_id),
                "frame_counter": frame.frame_counter,
                "cycle": frame.cycle,
                "body": truth.body,
                "pose": pose(truth.rotation, truth.translation),
                "psi": float(truth.psi),
                "particle_id": np.asarray(truth.particle_id, np.int32),
                **dict(zip("xyz", _columns(truth.position), strict=True)),
                "electrons": np.asarray(truth.electrons, np.float64),
            },
        )
        for truth in frame.truth
    ]


def localizations(found: Localizations) -> Message:
    """mems6dof_msgs/Localizations."""
    fits = found.fits
    return Message(
        "mems6dof_msgs/msg/Localizations",
        {
            "header": header(found.stamp_ns, found.frame_id),
            "frame_counter": found.frame_counter,
            "cycle": found.cycle,
            "frames_dropped": found.frames_dropped,
            **dict(zip("xyz", _columns(found.position), strict=True)),
            "covariance": _flat(found.covariance),
            **dict(zip(FIT_PARAMETERS, _columns(fits.parameters), strict=True)),
            "flux": _flat(fits.flux),
            "chi_square": _flat(fits.chi_square),
            "z_gap": _flat(found.z_gap),
            "flags": np.asarray(found.flags, np.uint32),
            "calibration_id": found.calibration_id,
            **{f"latency_{stage}": float(getattr(found.latency, stage)) for stage in _LOCALIZATION_LATENCY},
            "frame_publication_time": time(found.frame_published_ns),
            "publication_time": time(found.published_ns),
        },
    )


def pose6dof(cycle_pose: CyclePose) -> Message:
    """mems6dof_msgs/Pose6DOF."""
    angles = cycle_pose.angles
    return Message(
        "mems6dof_msgs/msg/Pose6DOF",
        {
            "header": header(cycle_pose.stamp_ns, cycle_pose.frame_id),
            "cycle": cycle_pose.cycle,
            "frame_counter": cycle_pose.frame_counter,
            "body": cycle_pose.body,
            "status": int(cycle_pose.status),
            "reason": cycle_pose.reason,
            "reference_version": cycle_pose.reference_version,
            "pose": Message(
                "geometry_msgs/msg/PoseWithCovariance",
                {
                    "pose": pose(cycle_pose.rotation, cycle_pose.translation),
                    "covariance": _flat(cycle_pose.covariance),
                },
            ),
            **dict(zip(DEGREES_OF_FREEDOM, map(float, cycle_pose.displacement), strict=True)),
            "displacement_covariance": _flat(cycle_pose.displacement_covariance),
            "alpha": float(angles.alpha),
            "beta": float(angles.beta),
            "gamma": float(angles.gamma),
            "sd_alpha": float(angles.sd_alpha),
            "sd_beta": float(angles.sd_beta),
            "sd_gamma": float(angles.sd_gamma),
            "alpha_valid": bool(angles.alpha_valid),
            "beta_valid": bool(angles.beta_valid),
            "increment_cycles": int(cycle_pose.increment_cycles),
            "increment": _flat(cycle_pose.increment),
            "increment_covariance": _flat(cycle_pose.increment_covariance),
            "residual_rms_xy": float(cycle_pose.residual_rms_xy),
            "residual_rms_z": float(cycle_pose.residual_rms_z),
            "chi_square": float(cycle_pose.chi_square),
            "particles_used": int(cycle_pose.particles_used),
            "particles_seen": int(cycle_pose.particles_seen),
            "particles_expected": int(cycle_pose.particles_expected),
            "particle_id": np.asarray(cycle_pose.particle_id, np.int32),
            **{
                f"residual_{axis}": column.astype(np.float32)
                for axis, column in zip("xyz", _columns(cycle_pose.residual), strict=True)
            },
            **{f"latency_{f.name}": float(getattr(cycle_pose.latency, f.name)) for f in fields(Latency)},
        },
    )


def pose_stamped(of: Message) -> Message:
    """geometry_msgs/PoseStamped: the pose of the body in the microscope frame, of a ``pose6dof``."""
    pose = of.fields["pose"].fields["pose"]
    return Message("geometry_msgs/msg/PoseStamped", {"header": of.fields["header"], "pose": pose})


def pose_with_covariance_stamped(of: Message) -> Message:
    """geometry_msgs/PoseWithCovarianceStamped: likewise, with its covariance."""
    stamped = {"header": of.fields["header"], "pose": of.fields["pose"]}
    return Message("geometry_msgs/msg/PoseWithCovarianceStamped", stamped)


def header(stamp_ns: int, frame_id: str) -> Message:
    """std_msgs/Header."""
    return Message("std_msgs/msg/Header", {"stamp": time(stamp_ns), "frame_id": frame_id})


def time(nanoseconds: int) -> Message:
    """builtin_interfaces/Time."""
    seconds, remainder = divmod(int(nanoseconds), 10**9)
    return Message("builtin_interfaces/msg/Time", {"sec": seconds, "nanosec": remainder})


def pose(rotation: NDArray[np.float64], translation: NDArray[np.float64]) -> Message:
    """geometry_msgs/Pose of a (3, 3) rotation and a (3,) translation in m; NaN stays NaN."""
    point = dict(zip("xyz", translation.tolist(), strict=True))
    orientation = dict(zip("xyzw", quaternion(rotation).tolist(), strict=True))
    return Message(
        "geometry_msgs/msg/Pose",
        {
            "position": Message("geometry_msgs/msg/Point", point),
            "orientation": Message("geometry_msgs/msg/Quaternion", orientation),
        },
    )


def _flat(values: ArrayLike) -> NDArray[np.float64]:
    return np.ascontiguousarray(values, np.float64).reshape(-1)


def _columns(table: ArrayLike) -> NDArray[np.float64]:
    return np.ascontiguousarray(np.asarray(table, np.float64).T)


# Messages to core types --------------------------------------------------------------------------


def image_pixels(message: Any) -> NDArray[np.generic]:
    """Pixels (height, width) of a sensor_msgs/Image, without a copy where the layout allows.

    Raises InputError where the encoding cannot be measured or the sizes contradict each other.
    """
    where = f"Image on frame_id '{message.header.frame_id}'"
    if message.encoding not in PIXEL_TYPES:
        raise InputError(where, f"encoding '{message.encoding}'", "mono8 or mono16")
    dtype = np.dtype(PIXEL_TYPES[message.encoding]).newbyteorder(">" if message.is_bigendian else "<")
    height, width, step = int(message.height), int(message.width), int(message.step)
    if height == 0 or width == 0:
        raise InputError(where, f"an empty image of {width} x {height} px", "at least one pixel")
    if step < width * dtype.itemsize or step % dtype.itemsize:
        raise InputError(
            where, f"step {step} B", f"{width * dtype.itemsize} B for {width} px {message.encoding}"
        )
    data = np.asarray(message.data, np.uint8)
    if data.size != step * height:
        raise InputError(where, f"{data.size} B of data", f"{step * height} B for {height} rows of {step} B")
    pixels = data.view(dtype).reshape(height, step // dtype.itemsize)[:, :width]
    return pixels.astype(dtype.newbyteorder("="), copy=False)


def to_frame(image_message: Any, info: Any = None, truth: tuple[GroundTruth, ...] = ()) -> Frame:
    """Frame of an Image and, where there is one, its FrameInfo; InputError as of image_pixels."""
    known: dict[str, Any] = {"frame_counter": 0, "cycle": 0}
    if info is not None:
        known = {
            "frame_counter": int(info.frame_counter),
            "cycle": int(info.cycle),
            "frames_dropped": int(info.frames_dropped),
            "device_time_ns": int(info.device_time_ns),
            "published_ns": nanoseconds(info.publication_time),
            "exposure_s": float(info.exposure),
            "stage_z": float(info.stage_z),
            "pixel_size": float(info.pixel_size),
            "saturation_adu": int(info.saturation_adu),
            "source": str(info.source),
            "live": bool(info.live),
        }
    return Frame(
        image=image_pixels(image_message),
        stamp_ns=nanoseconds(image_message.header.stamp),
        frame_id=image_message.header.frame_id,
        truth=truth,
        **known,
    )


def to_ground_truth(message: Any) -> GroundTruth:
    """GroundTruth of its message."""
    rotation, translation = _matrix(message.pose)
    return GroundTruth(
        body=message.body,
        rotation=rotation,
        translation=translation,
        psi=float(message.psi),
        particle_id=np.array(message.particle_id, np.int32),
        position=_rows(message, "x", "y", "z"),
        electrons=np.array(message.electrons, np.float64),
    )


def to_localizations(message: Any) -> Localizations:
    """Localizations of their message; InputError where the parallel arrays differ in length."""
    table = _rows(message, "x", "y", "z", *FIT_PARAMETERS, "chi_square", "z_gap")
    n = len(table)
    _check_length("Localizations.covariance", len(message.covariance), 9 * n)
    _check_length("Localizations.flags", len(message.flags), n)
    flags = np.array(message.flags, np.uint32)
    return Localizations(
        stamp_ns=nanoseconds(message.header.stamp),
        frame_id=message.header.frame_id,
        frame_counter=int(message.frame_counter),
        cycle=int(message.cycle),
        position=table[:, :3],
        covariance=np.array(message.covariance, np.float64).reshape(n, 3, 3),
        fits=GaussianFits(
            parameters=table[:, 3:10],
            covariance=np.full((n, 7, 7), math.nan),
            chi_square=table[:, 10],
            iterations=np.zeros(n, np.int32),
            flags=flags & np.uint32(_FIT_FLAGS),
        ),
        z_gap=table[:, 11],
        flags=flags,
        calibration_id=message.calibration_id,
        frames_dropped=int(message.frames_dropped),
        published_ns=nanoseconds(message.publication_time),
        frame_published_ns=nanoseconds(message.frame_publication_time),
        latency=Latency(
            **{stage: float(getattr(message, f"latency_{stage}")) for stage in _LOCALIZATION_LATENCY}
        ),
    )


def to_cycle_pose(message: Any) -> CyclePose:
    """CyclePose of a Pose6DOF."""
    rotation, translation = _matrix(message.pose.pose)
    if message.status not in set(Status):
        raise InputError("Pose6DOF.status", str(message.status), f"0 to {max(Status):d}")
    return CyclePose(
        stamp_ns=nanoseconds(message.header.stamp),
        frame_id=message.header.frame_id,
        frame_counter=int(message.frame_counter),
        cycle=int(message.cycle),
        body=message.body,
        status=Status(int(message.status)),
        reason=message.reason,
        reference_version=int(message.reference_version),
        rotation=rotation,
        translation=translation,
        covariance=_square(message.pose.covariance),
        displacement=np.array([getattr(message, name) for name in DEGREES_OF_FREEDOM], np.float64),
        displacement_covariance=_square(message.displacement_covariance),
        angles=PaperAngles(**{f.name: getattr(message, f.name) for f in fields(PaperAngles)}),
        increment=np.array(message.increment, np.float64),
        increment_covariance=_square(message.increment_covariance),
        increment_cycles=int(message.increment_cycles),
        residual_rms_xy=float(message.residual_rms_xy),
        residual_rms_z=float(message.residual_rms_z),
        chi_square=float(message.chi_square),
        particles_used=int(message.particles_used),
        particles_seen=int(message.particles_seen),
        particles_expected=int(message.particles_expected),
        particle_id=np.array(message.particle_id, np.int32),
        residual=_rows(message, "residual_x", "residual_y", "residual_z"),
        latency=Latency(**{f.name: float(getattr(message, f"latency_{f.name}")) for f in fields(Latency)}),
    )


def nanoseconds(stamp: Any) -> int:
    """builtin_interfaces/Time in ns."""
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


def _rows(message: Any, *names: str) -> NDArray[np.float64]:
    columns = [np.asarray(getattr(message, name), np.float64) for name in names]
    for name, column in zip(names, columns, strict=True):
        _check_length(f"{type(message).__name__}.{name}", len(column), len(columns[0]))
    return np.stack(columns, axis=1)


def _check_length(where: str, found: int, expected: int) -> None:
    if found != expected:
        raise InputError(where, f"{found} elements", f"{expected}, parallel to the other arrays")


def _square(values: Any) -> NDArray[np.float64]:
    return np.array(values, np.float64).reshape(6, 6)


def _matrix(message: Any) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    p, q = message.position, message.orientation
    turn = np.array([q.x, q.y, q.z, q.w])
    known = np.isfinite(turn).all() and turn.any()
    rotation = Rotation.from_quat(turn).as_matrix() if known else np.full((3, 3), NAN)
    return rotation, np.array([p.x, p.y, p.z])
