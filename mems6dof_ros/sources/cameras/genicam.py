"""GenICam cameras of any maker: GigE Vision and USB3 Vision, and whatever has a GenTL producer."""

from __future__ import annotations

from functools import partial
from typing import Any

from mems6dof_ros.sources.cameras.aravis import AravisDevice
from mems6dof_ros.sources.cameras.camera import CameraSource
from mems6dof_ros.sources.cameras.gentl import GenTLDevice
from mems6dof_ros.sources.cameras.settings import parse_settings


class GenicamSource(CameraSource):
    """FrameSource of a GenICam camera.

    ``producer``: path of a GenTL producer (.cti), used through harvesters; empty: Aravis, which speaks
    GigE Vision and USB3 Vision itself. Other options: CameraSettings.
    """

    def __init__(self, *, producer: str = "", **options: Any) -> None:
        open_device = partial(GenTLDevice, producer) if producer else AravisDevice
        super().__init__("genicam", parse_settings(options), open_device)
