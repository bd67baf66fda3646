"""Options that say what frames to read and what camera made them, shared by the subcommands."""

from __future__ import annotations

import argparse
import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from mems6dof_ros.errors import InputError

if TYPE_CHECKING:
    from mems6dof_ros.localization.camera import CameraNoise
    from mems6dof_ros.sources.source import FrameSource, SourceInfo

_CAMERA = {
    "offset": ("offset_adu", "pixel value without light, ADU"),
    "gain": ("gain_adu_per_electron", "ADU per electron"),
    "read-noise": ("read_noise_electrons", "electrons rms"),
    "saturation": ("saturation_adu", "pixel value at saturation, ADU (default: the largest of the encoding)"),
}


def add_image_options(parser: argparse.ArgumentParser) -> None:
    """What images do not tell of themselves, and the topic of a bag."""
    group = parser.add_argument_group("frames, where the input does not tell")
    group.add_argument("--pixel-size", type=float, default=math.nan, help="pixel size in object space, m")
    group.add_argument("--step", type=float, default=math.nan, help="stage step from image to image, m")
    group.add_argument("--topic", default="", help="topic of the images in a bag with several")


def add_camera_options(parser: argparse.ArgumentParser) -> None:
    """Numbers of the camera."""
    group = parser.add_argument_group(
        "camera, where neither calibration nor input tells, or to override them"
    )
    for option, (name, text) in _CAMERA.items():
        group.add_argument(f"--{option}", dest=name, type=float, help=text)


def open_input(path: Path, args: argparse.Namespace) -> FrameSource:
    """The bag, image stack or folder of images at ``path``."""
    from mems6dof_ros.sources.source import open_recording

    return open_recording(path, args.topic, pixel_size=args.pixel_size, step=args.step)


def camera_of(args: argparse.Namespace, info: SourceInfo, known: CameraNoise | None) -> CameraNoise:
    """The camera ``known``, else as the input tells, with the options on top; InputError if none does."""
    from mems6dof_ros.localization.camera import CameraNoise

    names = {name: option for option, (name, _) in _CAMERA.items()}
    given = {name: value for name in names if (value := getattr(args, name)) is not None}
    camera = known or info.camera
    if camera is not None:
        return replace(camera, **given)
    given.setdefault("saturation_adu", 255 if info.encoding == "mono8" else 65535)
    if missing := [f"--{option}" for name, option in names.items() if name not in given]:
        raise InputError("camera", "nothing known of its noise", f"{', '.join(missing)}, or a calibration")
    return CameraNoise(**given)
