"""The protocol of everything that yields frames, and the table of what there is."""

from __future__ import annotations

import importlib
import inspect
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from mems6dof_ros.errors import InputError
from mems6dof_ros.frame import NAN, Frame
from mems6dof_ros.localization.camera import CameraNoise


@dataclass(frozen=True)
class SourceInfo:
    """What is known before the first frame.

    ``width``, ``height`` px; ``encoding`` mono8 or mono16; ``pixel_size`` m in object space, NaN: unknown;
    ``frames``: how many there are, None: no end; ``camera``: its noise, None: unknown.
    """

    kind: str
    width: int
    height: int
    encoding: str
    pixel_size: float = NAN
    frames: int | None = None
    camera: CameraNoise | None = None


class FrameSource(Protocol):
    """Yields frames. Constructing it opens and checks what can be checked; nothing moves before start."""

    @property
    def info(self) -> SourceInfo:
        """What is known before the first frame."""
        ...

    def start(self) -> None:
        """Begin, or begin again, with the first frame."""
        ...

    def read(self, timeout: float | None = None) -> Frame | None:
        """The next frame, or None after the last.

        Raises TimeoutError where a live source delivers nothing within ``timeout`` s, and InputError for a
        frame that cannot be used; reading on after either gives the frames that follow.
        """
        ...

    def stop(self) -> None:
        """Release files and devices; harmless when repeated."""
        ...


#: Module and constructor of each kind of source, imported on use: a driver that is absent disturbs nobody.
SOURCES = {
    "simulator": ("mems6dof_ros.sources.simulator", "open_simulator"),
    "images": ("mems6dof_ros.sources.images", "ImagesSource"),
    "bag": ("mems6dof_ros.sources.bag", "BagSource"),
    "video": ("mems6dof_ros.sources.video", "VideoSource"),
    "genicam": ("mems6dof_ros.sources.cameras.genicam", "GenicamSource"),
    "basler": ("mems6dof_ros.sources.cameras.basler", "BaslerSource"),
    "opencv": ("mems6dof_ros.sources.cameras.opencv", "OpencvSource"),
}


def open_source(kind: str, **options: Any) -> FrameSource:
    """Open the source named ``kind`` with its own ``options``; InputError where either is unknown."""
    if kind not in SOURCES:
        raise InputError("source", repr(kind), f"one of {', '.join(SOURCES)}")
    module, name = SOURCES[kind]
    source = getattr(importlib.import_module(module), name)
    parameters = inspect.signature(source).parameters
    takes_any = any(p.kind is inspect.Parameter.VAR_KEYWORD for p in parameters.values())
    for option in options:
        if option not in parameters and not takes_any:
            raise InputError(f"source '{kind}'", f"option '{option}'", f"one of {', '.join(parameters)}")
    for option, parameter in parameters.items():
        needed = parameter.default is parameter.empty and parameter.kind is not parameter.VAR_KEYWORD
        if needed and option not in options:
            raise InputError(f"source '{kind}'", f"no option '{option}'", "a value for it")
    return source(**options)


#: What tells a video file, in small letters.
VIDEO_SUFFIXES = (".avi", ".m4v", ".mkv", ".mov", ".mp4", ".mpeg", ".mpg", ".webm", ".wmv")


def is_bag(path: Path) -> bool:
    """True where ``path`` is a bag, also one that was never completed, rather than images."""
    files = [path, *path.iterdir()] if path.is_dir() else [path]
    return any(file.suffix in (".mcap", ".db3") or file.name == "metadata.yaml" for file in files)


def kind_of(path: Path) -> str:
    """The source that reads the recording at ``path``: bag, video or images; InputError: nothing is there."""
    if not path.exists():
        raise InputError(str(path), "nothing there", "a bag, TIFF stack, folder of images or video")
    if is_bag(path):
        return "bag"
    return "video" if path.suffix.lower() in VIDEO_SUFFIXES else "images"


def open_recording(path: Path, topic: str = "", **images: float) -> FrameSource:
    """The bag at ``path``, images on ``topic`` (empty: the only one), or the image stack, folder of images or
    video, with options ``images`` of its source, NaN: not told; InputError for one that it does not have."""
    kind = kind_of(path)
    if kind == "bag":
        return open_source(kind, path=path, topic=topic)
    told = {name: value for name, value in images.items() if not math.isnan(value)}
    return open_source(kind, path=path, **told)


def frames(source: FrameSource) -> Iterator[Frame]:
    """All frames of ``source``, from start to stop."""
    source.start()
    try:
        while (frame := source.read()) is not None:
            yield frame
    finally:
        source.stop()
