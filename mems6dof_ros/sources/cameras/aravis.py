"""GigE Vision and USB3 Vision cameras through Aravis, by its GObject introspection."""

from __future__ import annotations

from contextlib import suppress
from functools import cache
from typing import Any

from mems6dof_ros.sources.cameras.device import (
    CameraDescription,
    CameraLostError,
    DeviceState,
    DriverMissingError,
    RawFrame,
    choose_camera,
    load_driver,
)
from mems6dof_ros.sources.cameras.settings import CameraSettings, adjusted, apply_settings

#: GigE Vision bootstrap register of the control channel privilege: 0 where nobody controls the camera.
_CONTROL_PRIVILEGE = 0x0A00

_INSTALL = "apt install gir1.2-aravis-0.8 python3-gi (in a virtual environment also: pip install PyGObject)"


@cache
def _aravis() -> tuple[Any, Any]:
    """The Aravis namespace and its exception."""
    gi = load_driver("gi", _INSTALL)
    try:
        gi.require_version("Aravis", "0.8")
    except ValueError as error:
        raise DriverMissingError("Aravis", error, _INSTALL) from None
    return load_driver("gi.repository.Aravis", _INSTALL), load_driver("gi.repository.GLib", _INSTALL).Error


def list_cameras() -> list[CameraDescription]:
    """Cameras on all networks and USB ports, in the order of their names."""
    aravis, _ = _aravis()
    aravis.update_device_list()
    return sorted(
        (
            CameraDescription(
                kind="genicam",
                device=aravis.get_device_id(k),
                vendor=aravis.get_device_vendor(k) or "",
                model=aravis.get_device_model(k) or "",
                serial=aravis.get_device_serial_nbr(k) or "",
                address=f"{aravis.get_device_protocol(k)} {aravis.get_device_address(k) or ''}".strip(),
            )
            for k in range(aravis.get_n_devices())
        ),
        key=lambda camera: camera.device,
    )


class AravisDevice:
    """A CameraDevice."""

    def __init__(self, settings: CameraSettings) -> None:
        aravis, error = _aravis()
        name = choose_camera(list_cameras(), settings.device).device
        self._buffers = settings.buffers
        self._stream: Any = None
        self._answers = True
        try:
            self._camera = aravis.Camera.new(name)
        except error as problem:
            raise CameraLostError(f"camera {name}: {problem.message}") from None
        self._device = self._camera.get_device()
        try:
            self._state = apply_settings(_AravisFeatures(self._device), settings, name)
            if self._camera.is_gv_device():
                if settings.packet_size:
                    self._camera.gv_set_packet_size(settings.packet_size)
                else:
                    self._camera.gv_auto_packet_size()
        except error as problem:
            self.close()
            raise CameraLostError(f"camera {name}: {problem.message}") from None
        except Exception:
            self.close()
            raise

    @property
    def state(self) -> DeviceState:
        return self._state

    def start(self) -> None:
        aravis, error = _aravis()
        try:
            self._stream = self._camera.create_stream(None, None)
            payload = self._camera.get_payload()
            for _ in range(self._buffers):
                self._stream.push_buffer(aravis.Buffer.new_allocate(payload))
            self._camera.start_acquisition()
        except error as problem:
            raise CameraLostError(problem.message) from None

    def grab(self, timeout: float) -> RawFrame | None:
        aravis, _ = _aravis()
        buffer = self._stream.timeout_pop_buffer(round(timeout * 1e6))
        if buffer is None:
            return None
        complete = buffer.get_status() == aravis.BufferStatus.SUCCESS
        frame = RawFrame(
            data=buffer.get_data() if complete else None,
            counter=buffer.get_frame_id(),
            device_time_ns=buffer.get_timestamp(),
            arrival_ns=buffer.get_system_timestamp(),
        )
        self._stream.push_buffer(buffer)
        return frame

    def trigger(self) -> None:
        self._ask(self._camera.software_trigger)

    def adjust(self, exposure: float, gain: float) -> None:
        self._state = self._ask(adjusted, _AravisFeatures(self._device), self._state, exposure, gain)

    def is_alive(self) -> bool:
        try:
            if self._camera.is_gv_device():
                return bool(self._ask(self._device.read_register, _CONTROL_PRIVILEGE))
            self._ask(self._camera.get_payload)
        except CameraLostError:
            return False
        return True

    def close(self) -> None:
        with suppress(_aravis()[1]):  # it may be gone: nothing is left to stop
            if self._answers and self._stream is not None:
                self._camera.stop_acquisition()
            if self._answers and self._camera.is_gv_device():
                self._device.leave_control()
        self._stream = None

    def _ask(self, function: Any, *arguments: Any) -> Any:
        try:
            return function(*arguments)
        except _aravis()[1] as problem:
            self._answers = False
            raise CameraLostError(problem.message) from None


class _AravisFeatures:
    """Features of an Aravis device."""

    def __init__(self, device: Any) -> None:
        self._device = device
        self._aravis, self._error = _aravis()

    def has(self, name: str, to_set: bool = False) -> bool:
        try:
            if not self._device.is_feature_available(name):
                return False
        except self._error:
            return False
        mode = self._device.get_feature(name).get_actual_access_mode()
        return not to_set or mode in (self._aravis.GcAccessMode.RW, self._aravis.GcAccessMode.WO)

    def get(self, name: str) -> Any:
        kind, _ = self._kind(name)
        return getattr(self._device, f"get_{kind}_feature_value")(name)

    def set(self, name: str, value: Any) -> None:
        kind, convert = self._kind(name)
        getattr(self._device, f"set_{kind}_feature_value")(name, convert(value))

    def limits(self, name: str) -> tuple[float, float]:
        kind, _ = self._kind(name)
        bounds = getattr(self._device, f"get_{kind}_feature_bounds")(name)
        return bounds.min, bounds.max

    def choices(self, name: str) -> tuple[str, ...]:
        return tuple(self._device.dup_available_enumeration_feature_values_as_strings(name))

    def _kind(self, name: str) -> tuple[str, Any]:
        """How Aravis calls the type of a feature; an enumeration is an integer too, so it comes first."""
        node = self._device.get_feature(name)
        for interface, kind, convert in (
            (self._aravis.GcEnumeration, "string", str),
            (self._aravis.GcBoolean, "boolean", bool),
            (self._aravis.GcFloat, "float", float),
            (self._aravis.GcInteger, "integer", int),
        ):
            if isinstance(node, interface):
                return kind, convert
        return "string", str
