"""GenICam cameras through harvesters and the GenTL producer (.cti file) of any maker."""

from __future__ import annotations

import os
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from mems6dof_ros.errors import InputError
from mems6dof_ros.sources.cameras.device import (
    CameraDescription,
    CameraLostError,
    DeviceState,
    RawFrame,
    choose_camera,
    load_driver,
)
from mems6dof_ros.sources.cameras.settings import CameraSettings, adjusted, apply_settings

_INSTALL = "pip install harvesters==1.4.3 genicam==1.6.0"

#: The GenTL standard's search path of producers.
_PRODUCER_PATH = "GENICAM_GENTL64_PATH"


def find_producers() -> list[Path]:
    """The .cti files on the GenTL search path."""
    folders = [Path(folder) for folder in os.environ.get(_PRODUCER_PATH, "").split(os.pathsep) if folder]
    return sorted(file for folder in folders for file in folder.glob("*.cti"))


def list_cameras(producer: str | Path) -> list[CameraDescription]:
    """Cameras that the GenTL producer finds."""
    harvester = _harvester(producer)
    try:
        return _describe(harvester)
    finally:
        harvester.reset()


class GenTLDevice:
    """A CameraDevice."""

    def __init__(self, producer: str | Path, settings: CameraSettings) -> None:
        libraries = ("genicam.gentl", "genicam.genapi")  # the transport and the camera's features
        self._error = tuple(load_driver(library, _INSTALL).GenericException for library in libraries)
        self._harvester = _harvester(producer)
        try:
            cameras = _describe(self._harvester)
            camera = choose_camera(cameras, settings.device)
            try:
                self._acquirer = self._harvester.create(cameras.index(camera))
                self._acquirer.num_buffers = max(settings.buffers, self._acquirer.min_num_buffers)
                self._nodes = self._acquirer.remote_device.node_map
                self._state = apply_settings(_NodeMapFeatures(self._nodes), settings, camera.device)
            except self._error as problem:
                raise CameraLostError(f"camera {camera.device}: {problem}") from None
        except Exception:
            self._harvester.reset()
            raise

    @property
    def state(self) -> DeviceState:
        return self._state

    def start(self) -> None:
        self._ask(self._acquirer.start)

    def grab(self, timeout: float) -> RawFrame | None:
        # Harvesters itself drops incomplete buffers: the next frame's counter tells.
        buffer = self._ask(lambda: self._acquirer.try_fetch(timeout=max(timeout, 1e-3), is_raw=True))
        if buffer is None:
            return None
        arrival_ns = time.time_ns()
        data = np.frombuffer(buffer.raw_buffer, np.uint8, int(buffer.size_filled)).copy()
        frame = RawFrame(data, int(buffer.frame_id), self._timestamp_ns(buffer), arrival_ns)
        buffer.parent.queue_buffer(buffer)
        return frame

    def trigger(self) -> None:
        self._ask(self._nodes.TriggerSoftware.execute)

    def adjust(self, exposure: float, gain: float) -> None:
        features = _NodeMapFeatures(self._nodes)
        self._state = self._ask(lambda: adjusted(features, self._state, exposure, gain))

    def is_alive(self) -> bool:
        try:
            self._ask(lambda: self._nodes.Width.value)
        except CameraLostError:
            return False
        return True

    def close(self) -> None:
        with suppress(*self._error):  # it is gone: nothing is left to stop
            self._acquirer.destroy()
        self._harvester.reset()

    def _timestamp_ns(self, buffer: Any) -> int:
        try:
            return int(buffer.timestamp_ns)
        except self._error:
            return 0  # the producer has none

    def _ask(self, function: Any) -> Any:
        try:
            return function()
        except self._error as problem:
            raise CameraLostError(str(problem)) from None


def _harvester(producer: str | Path) -> Any:
    core = load_driver("harvesters.core", _INSTALL)
    if not Path(producer).is_file():
        raise InputError("producer", f"no file {producer}", "the path of a GenTL producer (.cti)")
    harvester = core.Harvester()
    harvester.add_file(str(producer))
    harvester.update()
    return harvester


def _describe(harvester: Any) -> list[CameraDescription]:
    return [
        CameraDescription("genicam", d.id_, d.vendor, d.model, d.serial_number, d.tl_type)
        for d in harvester.device_info_list
    ]


class _NodeMapFeatures:
    """Features of the GenICam reference implementation's node map."""

    def __init__(self, nodes: Any) -> None:
        self._nodes = nodes
        self._genapi = load_driver("genicam.genapi", _INSTALL)

    def has(self, name: str, to_set: bool = False) -> bool:
        if not self._nodes.has_node(name):
            return False
        modes = self._genapi.EAccessMode
        able = (modes.RW, modes.WO) if to_set else (modes.RO, modes.RW, modes.WO)
        return self._nodes.get_node(name).get_access_mode() in able

    def get(self, name: str) -> Any:
        return getattr(self._nodes, name).value

    def set(self, name: str, value: Any) -> None:
        getattr(self._nodes, name).value = value

    def limits(self, name: str) -> tuple[float, float]:
        node = getattr(self._nodes, name)
        return node.min, node.max

    def choices(self, name: str) -> tuple[str, ...]:
        return tuple(getattr(self._nodes, name).symbolics)
