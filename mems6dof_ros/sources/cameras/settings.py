"""What a user sets on a camera, and setting it through GenICam's standard feature names."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from mems6dof_ros.errors import InputError
from mems6dof_ros.frame import NAN
from mems6dof_ros.sources.cameras.device import DeviceState
from mems6dof_ros.sources.cameras.pixels import FORMATS, full_scale


def _setting(default: Any, unit: str, doc: str, **metadata: Any) -> Any:
    """A field with its unit, meaning and, where it has them, range or choices."""
    return dataclasses.field(default=default, metadata={"unit": unit, "doc": doc, **metadata})


@dataclass(frozen=True)
class CameraSettings:
    """Settings of a live camera; an empty or NaN one stays as the camera has it.

    Each field carries ``metadata`` with ``unit``, ``doc`` and ``range``, ``choices`` or ``element`` (type of
    the elements of a tuple), so that nodes and documentation can describe it. Raises InputError for a value
    of the wrong type or out of range; what the camera itself refuses shows when it is opened.
    """

    device: str = _setting("", "", "name, serial number or address of the camera; empty: the only one")
    pixel_format: str = _setting(
        "", "", "PFNC name; empty: the deepest monochrome one", choices=("", *FORMATS)
    )
    exposure: float = _setting(NAN, "s", "exposure time", range=(1e-7, 1e3))
    gain: float = _setting(NAN, "dB", "gain, in the camera's own unit where it is not dB", range=(-1e3, 1e5))
    frame_rate: float = _setting(
        NAN, "Hz", "rate of a free-running camera or of software triggers", range=(1e-3, 1e5)
    )
    region: tuple[int, ...] = _setting((), "px", "x, y, width, height; empty: the sensor", element=int)
    trigger: str = _setting(
        "off",
        "",
        "off; software: at frame_rate, or where that is not given at each call of ~/trigger; or the name of"
        " the camera's input, such as Line1: a frame per pulse",
    )
    timestamp_at: str = _setting(
        "start", "", "what of the exposure the device stamps", choices=("start", "end")
    )
    latency: float = _setting(
        NAN,
        "s",
        "from the end of the exposure to its first bytes in the host, if measured",
        range=(0.0, 10.0),
    )
    buffers: int = _setting(16, "frames", "that may wait in the driver", range=(2, 1000))
    packet_size: int = _setting(0, "bytes", "GigE Vision; 0: the largest that passes", range=(0, 65535))
    pixel_size: float = _setting(NAN, "m", "image pixel size in object space", range=(1e-9, 1e-3))
    saturation_adu: int = _setting(
        0, "ADU", "largest pixel value; 0: end of the pixel format's scale", range=(0, 65535)
    )
    features: tuple[str, ...] = _setting((), "", "further GenICam features, Name=value", element=str)

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            _check(self, field)
        if self.region and not (
            len(self.region) == 4 and min(self.region[:2]) >= 0 and min(self.region[2:]) > 0
        ):
            raise InputError("region", f"{self.region}", "x, y, width, height in pixels")
        for entry in self.features:
            if "=" not in entry:
                raise InputError("features", repr(entry), "Name=value")

    @property
    def triggered(self) -> bool:
        return self.trigger != "off"


def _check(settings: CameraSettings, field: dataclasses.Field[Any]) -> None:
    """Type, range and choices as the field's metadata tell; makes tuples of lists and floats of integers."""
    value, kind = getattr(settings, field.name), type(field.default)
    if kind is float and type(value) is int:
        value = float(value)
    elif kind is tuple and isinstance(value, (list, tuple)):
        element = field.metadata["element"]
        if any(
            not isinstance(v, (int, float) if element is int else element) or v != element(v) for v in value
        ):
            raise InputError(field.name, repr(value), f"elements of type {element.__name__}")
        value = tuple(element(v) for v in value)
    if type(value) is not kind:
        raise InputError(field.name, repr(value), f"a value of type {kind.__name__}")
    choices, span = field.metadata.get("choices"), field.metadata.get("range")
    if choices and value not in choices:
        raise InputError(field.name, repr(value), f"one of {', '.join(filter(None, choices))}")
    if span and not span[0] <= value <= span[1] and value == value:
        raise InputError(field.name, f"{value:g}", f"{span[0]:g} to {span[1]:g} {field.metadata['unit']}")
    object.__setattr__(settings, field.name, value)


def parse_settings(options: dict[str, Any]) -> CameraSettings:
    """CameraSettings from a user's options; InputError names the one that is unknown or wrong."""
    known = {field.name for field in dataclasses.fields(CameraSettings)}
    for name in options:
        if name not in known:
            raise InputError("camera", f"option '{name}'", f"one of {', '.join(sorted(known))}")
    return CameraSettings(**options)


class Features(Protocol):
    """A camera's GenICam features by name, whatever the library.

    ``set`` and ``limits`` take and give what the feature holds: int, float or the entry of an enumeration.
    """

    def has(self, name: str, to_set: bool = False) -> bool: ...
    def get(self, name: str) -> Any: ...
    def set(self, name: str, value: Any) -> None: ...
    def limits(self, name: str) -> tuple[float, float]: ...
    def choices(self, name: str) -> tuple[str, ...]: ...


#: Setting, names of its feature (GenICam SFNC first, then those of older cameras) and units per SI unit.
_EXPOSURE = ("exposure", ("ExposureTime", "ExposureTimeAbs"), 1e6)
_GAIN = ("gain", ("Gain", "GainRaw"), 1.0)
_FRAME_RATE = ("frame_rate", ("AcquisitionFrameRate", "AcquisitionFrameRateAbs"), 1.0)

#: What exposure and bandwidth leave of the frame rate, where the camera tells.
_RESULTING_RATE = ("ResultingFrameRate", "ResultingFrameRateAbs", "AcquisitionResultingFrameRate")


def apply_settings(features: Features, settings: CameraSettings, name: str) -> DeviceState:
    """Set everything on the camera and read back what it made of it; InputError where it cannot."""
    for entry in settings.features:
        _set_by_text(features, *entry.split("=", 1))
    _set_if_there(features, "AcquisitionMode", "Continuous")
    pixel_format = settings.pixel_format or _deepest(features, name)
    _choose(features, "pixel_format", "PixelFormat", pixel_format)
    _set_region(features, settings.region)
    _set_exposure_and_gain(features, settings.exposure, settings.gain)
    _set_trigger(features, settings)
    if not settings.triggered and not math.isnan(settings.frame_rate):
        _set_if_there(features, "AcquisitionFrameRateEnable", True)
        _set_number(features, *_FRAME_RATE, settings.frame_rate)
    return DeviceState(
        name=name,
        width=int(features.get("Width")),
        height=int(features.get("Height")),
        pixel_format=pixel_format,
        saturation_adu=settings.saturation_adu or full_scale(pixel_format),
        exposure=_read_number(features, *_EXPOSURE[1:]),
        frame_rate=settings.frame_rate
        if settings.triggered
        else _read_number(features, (*_RESULTING_RATE, *_FRAME_RATE[1]), 1.0) or NAN,
        gain=_read_number(features, *_GAIN[1:]),
    )


def adjusted(features: Features, state: DeviceState, exposure: float, gain: float) -> DeviceState:
    """Set exposure and gain (NaN: leave it) of a running camera; ``state`` as it is then."""
    _set_exposure_and_gain(features, exposure, gain)
    return dataclasses.replace(
        state, exposure=_read_number(features, *_EXPOSURE[1:]), gain=_read_number(features, *_GAIN[1:])
    )


def _set_exposure_and_gain(features: Features, exposure: float, gain: float) -> None:
    if not math.isnan(exposure):
        _set_if_there(features, "ExposureAuto", "Off")
        _set_number(features, *_EXPOSURE, exposure)
    if not math.isnan(gain):
        _set_if_there(features, "GainAuto", "Off")
        _set_number(features, *_GAIN, gain)


def _set_by_text(features: Features, name: str, text: str) -> None:
    """Set the feature ``name`` to what ``text`` means for its type."""
    if not features.has(name, to_set=True):
        raise InputError("features", name, "a feature of this camera that can be set")
    kind = type(features.get(name))
    if kind is bool:
        if text.lower() not in ("true", "false"):
            raise InputError("features", f"{name}={text}", "true or false")
        features.set(name, text.lower() == "true")
        return
    try:
        features.set(name, kind(text))
    except ValueError:
        raise InputError("features", f"{name}={text}", f"a value of type {kind.__name__}") from None


def _deepest(features: Features, name: str) -> str:
    offered = features.choices("PixelFormat")
    for pixel_format in FORMATS:
        if pixel_format in offered:
            return pixel_format
    raise InputError(f"camera {name}", f"only the pixel formats {', '.join(offered)}", "a monochrome one")


def _set_region(features: Features, region: tuple[int, ...]) -> None:
    """Offsets to 0 first: they bound the size."""
    for offset in ("OffsetX", "OffsetY"):
        _set_if_there(features, offset, 0)
    largest = (int(features.limits(size)[1]) for size in ("Width", "Height"))
    x, y, width, height = region or (0, 0, *largest)
    wanted = {"Width": width, "Height": height, "OffsetX": x, "OffsetY": y}
    for feature, value in wanted.items():
        if (features.get(feature) if features.has(feature) else 0) == value:
            continue
        if not features.has(feature, to_set=True):
            raise InputError("region", f"{feature} {value}", "nothing: this camera cannot set it")
        least, most = features.limits(feature)
        if not least <= value <= most:
            raise InputError("region", f"{feature} {value}", f"{least:.0f} to {most:.0f} px")
        features.set(feature, value)
        if (got := features.get(feature)) != value:
            raise InputError("region", f"{feature} {value}", f"a step that the camera has, such as {got}")


def _set_trigger(features: Features, settings: CameraSettings) -> None:
    if not settings.triggered:
        _set_if_there(features, "TriggerMode", "Off")
        return
    if not features.has("TriggerMode"):
        raise InputError("trigger", repr(settings.trigger), "off: this camera has no trigger")
    _set_if_there(features, "TriggerSelector", "FrameStart")
    source = "Software" if settings.trigger == "software" else settings.trigger
    _choose(features, "trigger", "TriggerSource", source)
    features.set("TriggerMode", "On")


def _choose(features: Features, setting: str, feature: str, value: str) -> None:
    offered = features.choices(feature)
    if value not in offered:
        raise InputError(setting, repr(value), f"one of the camera's {', '.join(offered)}")
    if features.get(feature) != value:
        features.set(feature, value)


def _set_number(features: Features, setting: str, names: Sequence[str], scale: float, value: float) -> None:
    name = _first(features, names, to_set=True)
    if name is None:
        raise InputError(setting, f"{value}", "nothing: this camera cannot set it")
    least, most = features.limits(name)
    if not least <= value * scale <= most:
        raise InputError(setting, f"{value:g}", f"{least / scale:g} to {most / scale:g}")
    current = features.get(name)
    features.set(name, round(value * scale) if isinstance(current, int) else value * scale)


def _read_number(features: Features, names: Sequence[str], scale: float) -> float:
    name = _first(features, names)
    return NAN if name is None else features.get(name) / scale


def _first(features: Features, names: Sequence[str], to_set: bool = False) -> str | None:
    return next((name for name in names if features.has(name, to_set)), None)


def _set_if_there(features: Features, name: str, value: Any) -> None:
    if features.has(name, to_set=True):
        features.set(name, value)
