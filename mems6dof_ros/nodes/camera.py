"""A live camera in ROS: its parameters, what it tells of itself, and what it may be asked while it runs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from rcl_interfaces.msg import SetParametersResult
from rclpy.parameter import Parameter as RosParameter
from std_srvs.srv import Trigger

from mems6dof_ros.errors import Mems6dofError
from mems6dof_ros.nodes.common import InstrumentNode
from mems6dof_ros.nodes.parameters import Parameter, of_settings
from mems6dof_ros.sources.cameras.camera import CameraSource
from mems6dof_ros.sources.cameras.settings import CameraSettings

#: Settings that can be changed while the camera runs.
ADJUSTABLE = ("exposure", "gain")
#: Settings that V4L2 has not.
_NOT_V4L2 = ("trigger", "timestamp_at", "packet_size", "features")


def camera_parameters() -> tuple[Parameter, ...]:
    """Of every kind of camera, each under the name of its source."""
    producer = Parameter(
        "genicam.producer",
        "",
        "GenTL producer (.cti file) to go through; empty: Aravis, for GigE Vision and USB3 Vision.",
    )
    opencv = (p for p in _of_kind("opencv") if p.name.removeprefix("opencv.") not in _NOT_V4L2)
    return (producer, *_of_kind("genicam"), *_of_kind("basler"), *opencv)


def _of_kind(kind: str) -> tuple[Parameter, ...]:
    return tuple(
        replace(parameter, changeable=parameter.name.removeprefix(f"{kind}.") in ADJUSTABLE)
        for parameter in of_settings(CameraSettings, f"{kind}.")
    )


def serve_camera(node: InstrumentNode, source: CameraSource) -> None:
    """Tell of the camera in the diagnostics of ``node``, and serve ``~/trigger`` (std_srvs/Trigger), which
    exposes a frame where the setting ``trigger`` is ``software``."""

    def on_trigger(request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        try:
            source.trigger()
            response.success = True
        except Mems6dofError as error:
            response.success, response.message = False, str(error)
        return response

    node.create_service(Trigger, "~/trigger", on_trigger)
    for name, tell in {
        "camera": lambda status: status.name,
        "camera connected": lambda status: status.connected,
        "camera frames delivered": lambda status: status.delivered,
        "camera frames lost": lambda status: status.lost + status.pending,
        "camera frames incomplete": lambda status: status.incomplete,
        "camera reconnects": lambda status: status.reconnects,
        "camera clock drift, ppm": lambda status: f"{status.clock_drift * 1e6:.2f}",
        "stamp uncertainty, ms": lambda status: f"{status.stamp_uncertainty * 1e3:.3f}",
        "exposure, ms": lambda status: f"{status.exposure * 1e3:.4f}",
        "gain": lambda status: f"{status.gain:g}",
    }.items():
        node.health.gauge(name, lambda tell=tell: tell(source.status))  # type: ignore[misc]


def adjust_camera(source: CameraSource, kind: str, changes: Sequence[RosParameter]) -> SetParametersResult:
    """Hand what concerns exposure and gain on to the running camera; refused with its reason."""
    wanted = {change.name.removeprefix(f"{kind}."): change.value for change in changes}
    wanted = {name: value for name, value in wanted.items() if name in ADJUSTABLE}
    try:
        if wanted:
            source.adjust(**wanted)
    except Mems6dofError as error:
        return SetParametersResult(successful=False, reason=str(error))
    return SetParametersResult(successful=True)
