"""Frames from a video file."""

from __future__ import annotations

import logging
from pathlib import Path

import cv2
import numpy as np

from mems6dof_ros.errors import InputError
from mems6dof_ros.frame import NAN, Frame
from mems6dof_ros.sources.source import SourceInfo

logger = logging.getLogger(__name__)

#: What FFmpeg calls grey pixels of 8 and 16 bits (little endian), as OpenCV reports them.
_GREY_CODECS = {"Y800": np.uint8, "GREY": np.uint8, "Y8  ": np.uint8, "Y1\x00\x10": np.uint16}


class VideoSource:
    """FrameSource of a video file, exact for grey ones (FFV1 or raw, 8 or 16 bits).

    Colours are converted to 8-bit grey, and a warning says so. A video tells no time of day:
    the k-th frame is stamped (k + 1) periods after the epoch, as for images, and counts as one motion
    cycle. ``pixel_size`` m. ``saturation_adu`` 0: unknown.
    """

    def __init__(self, path: str | Path, *, pixel_size: float = NAN, saturation_adu: int = 0) -> None:
        self._path, self._pixel_size, self._saturation = Path(path), pixel_size, saturation_adu
        if not self._path.is_file():
            raise InputError(str(path), "no such file", "a video")
        self._capture = self._open()
        self._width = int(self._capture.get(cv2.CAP_PROP_FRAME_WIDTH))
        self._height = int(self._capture.get(cv2.CAP_PROP_FRAME_HEIGHT))
        self._count = int(self._capture.get(cv2.CAP_PROP_FRAME_COUNT))
        rate = self._capture.get(cv2.CAP_PROP_FPS)
        if self._count <= 0 or not rate > 0:
            raise InputError(str(path), f"{self._count} frames at {rate:g} Hz", "a video that tells both")
        self._period_ns = 1e9 / rate
        self._next = 0

    @property
    def info(self) -> SourceInfo:
        encoding = "mono16" if self._dtype == np.uint16 else "mono8"
        return SourceInfo("video", self._width, self._height, encoding, self._pixel_size, self._count)

    def start(self) -> None:
        self.stop()
        self._capture, self._next = self._open(), 0

    def read(self, timeout: float | None = None) -> Frame | None:
        k = self._next
        if k >= self._count:
            return None
        ok, image = self._capture.read()
        if not ok:
            self._next = self._count
            raise InputError(f"{self._path}, frame {k}", "a break", f"{self._count} frames")
        self._next += 1
        return Frame(
            image=image if self._exact else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY),
            stamp_ns=round((k + 1) * self._period_ns),
            frame_counter=k,
            cycle=k,
            pixel_size=self._pixel_size,
            saturation_adu=self._saturation,
            source="video",
        )

    def stop(self) -> None:
        self._capture.release()

    def _open(self) -> cv2.VideoCapture:
        capture = cv2.VideoCapture(str(self._path), cv2.CAP_FFMPEG)
        if not capture.isOpened():
            raise InputError(str(self._path), "no video that FFmpeg can read", "a video")
        codec = int(capture.get(cv2.CAP_PROP_CODEC_PIXEL_FORMAT)).to_bytes(4, "little").decode("latin-1")
        self._exact = codec in _GREY_CODECS
        self._dtype = np.dtype(_GREY_CODECS.get(codec, np.uint8))
        if self._exact:
            level = cv2.utils.logging.setLogLevel(
                cv2.utils.logging.LOG_LEVEL_ERROR
            )  # it warns of what is wanted
            capture.set(cv2.CAP_PROP_CONVERT_RGB, 0)
            cv2.utils.logging.setLogLevel(level)
        else:
            logger.warning("%s: pixels of '%s' are converted to 8-bit grey", self._path, codec.strip())
        return capture
