"""V4L2 cameras (UVC among them) through OpenCV."""

from __future__ import annotations

import math
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from mems6dof_ros.errors import InputError
from mems6dof_ros.frame import NAN
from mems6dof_ros.sources.cameras.camera import CameraSource
from mems6dof_ros.sources.cameras.device import (
    CameraDescription,
    CameraLostError,
    DeviceState,
    RawFrame,
    choose_camera,
)
from mems6dof_ros.sources.cameras.pixels import full_scale
from mems6dof_ros.sources.cameras.settings import CameraSettings, parse_settings

#: FOURCC that V4L2 has for our pixel formats; others would be converted colours.
_FOURCC = {"Mono16": "Y16 ", "Mono12": "Y12 ", "Mono10": "Y10 ", "Mono8": "GREY"}

#: V4L2 counts exposure in 100 us and calls manual exposure 1.
_EXPOSURE_UNIT, _MANUAL = 1e-4, 1


class OpencvSource(CameraSource):
    """FrameSource of a V4L2/UVC camera; ``device``: /dev/videoN.

    OpenCV shows no frame counter: frames that the camera or its driver drops are not seen. Options:
    CameraSettings; ``region`` sets the size only, there is no trigger.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__("opencv", parse_settings(options), V4L2Device)


def list_cameras() -> list[CameraDescription]:
    """V4L2 devices that can capture at all."""
    names = sorted(Path("/dev").glob("video*"), key=lambda path: (len(path.name), path.name))
    return [CameraDescription("opencv", str(path), model=_card(path)) for path in names if _captures(path)]


def _captures(path: Path) -> bool:
    capture = cv2.VideoCapture(str(path), cv2.CAP_V4L2)
    try:
        return capture.isOpened()
    finally:
        capture.release()


def _card(path: Path) -> str:
    name = Path("/sys/class/video4linux", path.name, "name")
    return name.read_text(encoding="utf-8").strip() if name.is_file() else ""


class V4L2Device:
    """A CameraDevice."""

    def __init__(self, settings: CameraSettings) -> None:
        impossible = {
            "trigger": settings.triggered,
            "features": settings.features,
            "region": any(settings.region[:2]),
        }
        for name in (name for name, wanted in impossible.items() if wanted):
            raise InputError(name, str(getattr(settings, name)), "nothing that V4L2 cannot do through OpenCV")
        self._path = choose_camera(list_cameras(), settings.device).device
        self._capture = cv2.VideoCapture(self._path, cv2.CAP_V4L2, [cv2.CAP_PROP_CONVERT_RGB, 0])
        self._set(cv2.CAP_PROP_BUFFERSIZE, min(settings.buffers, 10), "buffers")
        wanted = (settings.pixel_format,) if settings.pixel_format else tuple(_FOURCC)
        for pixel_format in wanted:
            if pixel_format in _FOURCC and self._choose_fourcc(_FOURCC[pixel_format]):
                break
        else:
            raise InputError("pixel_format", f"none of {', '.join(wanted)} at {self._path}", "a grey one")
        if settings.region:
            self._set(cv2.CAP_PROP_FRAME_WIDTH, settings.region[2], "region")
            self._set(cv2.CAP_PROP_FRAME_HEIGHT, settings.region[3], "region")
        if not math.isnan(settings.frame_rate):
            self._set(cv2.CAP_PROP_FPS, settings.frame_rate, "frame_rate")
        self._set_exposure_and_gain(settings.exposure, settings.gain)
        self._state = DeviceState(
            name=self._path,
            width=int(self._capture.get(cv2.CAP_PROP_FRAME_WIDTH)),
            height=int(self._capture.get(cv2.CAP_PROP_FRAME_HEIGHT)),
            pixel_format=pixel_format,
            saturation_adu=settings.saturation_adu or full_scale(pixel_format),
            exposure=settings.exposure,
            frame_rate=self._capture.get(cv2.CAP_PROP_FPS) or NAN,
            gain=settings.gain,
        )

    @property
    def state(self) -> DeviceState:
        return self._state

    def start(self) -> None:
        pass  # the first read begins

    def grab(self, timeout: float) -> RawFrame | None:
        self._capture.set(cv2.CAP_PROP_READ_TIMEOUT_MSEC, max(round(timeout * 1e3), 1))
        ok, image = self._capture.read()
        if not ok:
            if not self.is_alive():
                raise CameraLostError("it was unplugged")
            return None
        now = time.monotonic_ns()
        noticed = round(self._capture.get(cv2.CAP_PROP_POS_MSEC) * 1e6)  # by the kernel, on the same clock
        if not 0 <= now - noticed < 10_000_000_000:
            noticed = now
        data = np.ascontiguousarray(image).view(np.uint8).ravel()
        return RawFrame(data, None, 0, noticed + time.time_ns() - now)

    def trigger(self) -> None:
        raise InputError("trigger()", "a V4L2 camera", "one that has a trigger")

    def adjust(self, exposure: float, gain: float) -> None:
        self._set_exposure_and_gain(exposure, gain)
        self._state = replace(self._state, exposure=exposure, gain=gain)

    def is_alive(self) -> bool:
        return Path(self._path).exists()

    def close(self) -> None:
        self._capture.release()

    def _set_exposure_and_gain(self, exposure: float, gain: float) -> None:
        if not math.isnan(exposure):
            self._set(cv2.CAP_PROP_AUTO_EXPOSURE, _MANUAL, "exposure")
            self._set(cv2.CAP_PROP_EXPOSURE, round(exposure / _EXPOSURE_UNIT), "exposure")
        if not math.isnan(gain):
            self._set(cv2.CAP_PROP_GAIN, gain, "gain")

    def _set(self, prop: int, value: float, setting: str) -> None:
        if not self._capture.set(prop, value):
            raise InputError(setting, f"{value:g}", f"a value that {self._path} takes")

    def _choose_fourcc(self, code: str) -> bool:
        fourcc = int.from_bytes(code.encode(), "little")
        taken = self._capture.set(cv2.CAP_PROP_FOURCC, fourcc)
        return taken and int(self._capture.get(cv2.CAP_PROP_FOURCC)) == fourcc
