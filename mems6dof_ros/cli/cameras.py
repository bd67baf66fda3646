"""`mems6dof cameras`: what can be captured from, driver by driver."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

from mems6dof_ros.errors import Mems6dofError
from mems6dof_ros.sources.cameras import aravis, basler, gentl, opencv
from mems6dof_ros.sources.cameras.device import CameraDescription


def add_parser(subparsers: Any) -> None:
    parser = subparsers.add_parser("cameras", help="list the cameras that the installed drivers find")
    parser.add_argument(
        "--producer",
        metavar="FILE.cti",
        help="GenTL producer to ask besides those on GENICAM_GENTL64_PATH",
    )
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Print one line per camera, and why a driver finds none; 0 if there is a camera, else 1."""
    found = 0
    for driver, list_cameras in _drivers(args.producer):
        try:
            cameras = list_cameras()
        except Mems6dofError as error:
            print(f"{driver}: {error}")
            continue
        print(f"{driver}: {len(cameras) or 'no'} camera{'s' * (len(cameras) != 1)}")
        for camera in cameras:
            details = " ".join(filter(None, (camera.vendor, camera.model, camera.serial, camera.address)))
            print(f"  source: {camera.kind}  device: {camera.device}  ({details})")
        found += len(cameras)
    return 0 if found else 1


def _drivers(producer: str | None) -> Iterator[tuple[str, Callable[[], list[CameraDescription]]]]:
    yield "GenICam (Aravis)", aravis.list_cameras
    for path in ([Path(producer)] if producer else []) + gentl.find_producers():
        yield f"GenICam (producer {path})", partial(gentl.list_cameras, path)
    yield "Basler (pylon)", basler.list_cameras
    yield "V4L2 (OpenCV)", opencv.list_cameras
