"""Basler cameras through pylon's Python wheel."""

from __future__ import annotations

import time
from contextlib import suppress
from typing import Any

from mems6dof_ros.sources.cameras.camera import CameraSource
from mems6dof_ros.sources.cameras.device import (
    CameraDescription,
    CameraLostError,
    DeviceState,
    RawFrame,
    choose_camera,
    load_driver,
)
from mems6dof_ros.sources.cameras.settings import CameraSettings, adjusted, apply_settings, parse_settings

_INSTALL = "pip install pypylon==26.9"

#: s, to wait until the camera can take the next trigger.
_TRIGGER_PATIENCE = 1.0

#: Block id of a device that does not count its frames.
_NO_COUNTER = 2**64 - 1


class BaslerSource(CameraSource):
    """FrameSource of a Basler camera (GigE, USB3, CoaXPress as pylon has them); options: CameraSettings."""

    def __init__(self, **options: Any) -> None:
        super().__init__("basler", parse_settings(options), BaslerDevice)


def list_cameras() -> list[CameraDescription]:
    """Cameras that pylon finds; ``device`` is the serial number."""
    return [
        CameraDescription(
            kind="basler",
            device=info.GetSerialNumber(),
            vendor=info.GetVendorName(),
            model=info.GetModelName(),
            serial=info.GetSerialNumber(),
            address=info.GetIpAddress() if info.IsIpAddressAvailable() else info.GetDeviceClass(),
        )
        for info in _devices()
    ]


class BaslerDevice:
    """A CameraDevice."""

    def __init__(self, settings: CameraSettings) -> None:
        self._pylon = _pylon()
        self._error = load_driver("pypylon.genicam", _INSTALL).GenericException
        serial = choose_camera(list_cameras(), settings.device).device
        info = next(info for info in _devices() if info.GetSerialNumber() == serial)
        try:
            self._camera = self._pylon.InstantCamera(self._pylon.TlFactory.GetInstance().CreateDevice(info))
            self._camera.Open()
            nodes = self._camera.GetNodeMap()
            self._state = apply_settings(_PylonFeatures(nodes), settings, serial)
            self._camera.MaxNumBuffer.Value = settings.buffers
            if settings.packet_size:
                nodes.GetNode("GevSCPSPacketSize").SetValue(settings.packet_size)
            self._ns_per_tick = _ns_per_tick(nodes)
        except self._error as problem:
            raise CameraLostError(f"camera {serial}: {problem}") from None

    @property
    def state(self) -> DeviceState:
        return self._state

    def start(self) -> None:
        # One by one: a frame that waits is worth more here than the newest.
        self._ask(lambda: self._camera.StartGrabbing(self._pylon.GrabStrategy_OneByOne))

    def grab(self, timeout: float) -> RawFrame | None:
        if self._camera.IsCameraDeviceRemoved():
            raise CameraLostError("it was unplugged")
        result = self._ask(
            lambda: self._camera.RetrieveResult(round(timeout * 1e3), self._pylon.TimeoutHandling_Return)
        )
        arrival_ns = time.time_ns()
        if not result.IsValid():
            return None
        frame = RawFrame(
            data=result.GetBuffer() if result.GrabSucceeded() else None,
            counter=None if result.BlockID == _NO_COUNTER else result.BlockID,
            device_time_ns=round(result.TimeStamp * self._ns_per_tick),
            arrival_ns=arrival_ns,
        )
        result.Release()
        return frame

    def trigger(self) -> None:
        if self._camera.CanWaitForFrameTriggerReady():  # a trigger that comes too early is ignored
            wait = round(_TRIGGER_PATIENCE * 1e3)
            self._ask(lambda: self._camera.WaitForFrameTriggerReady(wait, self._pylon.TimeoutHandling_Return))
        self._ask(self._camera.ExecuteSoftwareTrigger)

    def adjust(self, exposure: float, gain: float) -> None:
        features = _PylonFeatures(self._camera.GetNodeMap())
        self._state = self._ask(lambda: adjusted(features, self._state, exposure, gain))

    def is_alive(self) -> bool:
        return not self._camera.IsCameraDeviceRemoved()

    def close(self) -> None:
        with suppress(self._error):  # it is gone: nothing is left to close
            self._camera.Close()
            self._camera.DestroyDevice()

    def _ask(self, function: Any) -> Any:
        try:
            return function()
        except self._error as problem:
            raise CameraLostError(str(problem).split(" : ")[0]) from None


def _pylon() -> Any:
    return load_driver("pypylon.pylon", _INSTALL)


def _devices() -> list[Any]:
    return list(_pylon().TlFactory.GetInstance().EnumerateDevices())


def _ns_per_tick(nodes: Any) -> float:
    """GigE cameras tell the rate of their clock, the others count nanoseconds."""
    features = _PylonFeatures(nodes)
    name = "GevTimestampTickFrequency"
    return 1e9 / features.get(name) if features.has(name) else 1.0


class _PylonFeatures:
    """Features of a pylon node map."""

    def __init__(self, nodes: Any) -> None:
        self._nodes = nodes
        self._genicam = load_driver("pypylon.genicam", _INSTALL)

    def has(self, name: str, to_set: bool = False) -> bool:
        node = self._nodes.GetNode(name)
        return self._genicam.IsWritable(node) if to_set else self._genicam.IsAvailable(node)

    def get(self, name: str) -> Any:
        return self._nodes.GetNode(name).GetValue()

    def set(self, name: str, value: Any) -> None:
        self._nodes.GetNode(name).SetValue(value)

    def limits(self, name: str) -> tuple[float, float]:
        node = self._nodes.GetNode(name)
        return node.GetMin(), node.GetMax()

    def choices(self, name: str) -> tuple[str, ...]:
        return tuple(self._nodes.GetNode(name).Symbolics)
