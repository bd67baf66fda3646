"""What a driver must do to be a camera: the narrow side of every driver library."""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from types import ModuleType
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from mems6dof_ros.errors import InputError, Mems6dofError
from mems6dof_ros.frame import NAN


class CameraLostError(Mems6dofError):
    """The camera no longer answers; opening it again may help."""


class DriverMissingError(Mems6dofError):
    """The driver library is not installed; says how to install it."""

    def __init__(self, driver: str, cause: Exception, install: str) -> None:
        super().__init__(f"driver '{driver}' is not installed ({cause}); install it by: {install}")


@dataclass(frozen=True)
class CameraDescription:
    """One camera that a driver sees; ``device`` is what to open it by, ``kind`` the kind of source."""

    kind: str
    device: str
    vendor: str = ""
    model: str = ""
    serial: str = ""
    address: str = ""


@dataclass(frozen=True)
class DeviceState:
    """A camera's settings as read back: px, PFNC name, ADU, s, Hz, gain in its own unit; NaN: not known."""

    name: str
    width: int
    height: int
    pixel_format: str
    saturation_adu: int
    exposure: float = NAN
    frame_rate: float = NAN
    gain: float = NAN


@dataclass(frozen=True)
class RawFrame:
    """One image as it came: ``data`` in the device's pixel format, None where parts of it are missing.

    ``counter``: of the device, None: it has none. ``device_time_ns`` 0: it has no clock.
    ``arrival_ns``: when the host noticed its first bytes, ns since the Unix epoch.
    """

    data: bytes | NDArray[np.uint8] | None
    counter: int | None
    device_time_ns: int
    arrival_ns: int


class CameraDevice(Protocol):
    """An opened, configured camera. Every method raises CameraLostError where the camera does not answer."""

    @property
    def state(self) -> DeviceState: ...

    def start(self) -> None:
        """Begin to expose."""

    def grab(self, timeout: float) -> RawFrame | None:
        """The oldest frame that waits, or None where none came within ``timeout`` s."""

    def trigger(self) -> None:
        """Expose one frame (software trigger)."""

    def adjust(self, exposure: float, gain: float) -> None:
        """Change exposure, s, and gain while it runs (NaN: leave it), and read back ``state``; InputError
        where it refuses."""

    def is_alive(self) -> bool:
        """Whether the camera still answers and is still ours."""

    def close(self) -> None:
        """Let go of the camera; never raises."""


def load_driver(module: str, install: str) -> ModuleType:
    """Import a driver library that users install where they need it."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise DriverMissingError(module.split(".")[0], error, install) from None


def choose_camera(cameras: list[CameraDescription], device: str) -> CameraDescription:
    """The camera named ``device`` (name, serial number or address), or the only one; else InputError."""
    found = [c for c in cameras if not device or device in (c.device, c.serial, *c.address.split())]
    if len(found) == 1:
        return found[0]
    there = ", ".join(c.device for c in cameras) or "no camera"
    if not found:
        raise InputError("device", there, f"'{device}'" if device else "a camera")
    raise InputError("device", f"{len(found)} cameras: {there}", "the name of one")
