"""Frames from the physical simulator."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from typing import Any

from mems6dof_ros.errors import InputError
from mems6dof_ros.frame import Frame
from mems6dof_ros.localization.camera import CameraNoise
from mems6dof_ros.simulation.experiment import loop as repeat
from mems6dof_ros.simulation.experiment import motion_frames
from mems6dof_ros.simulation.settings import SimulationSettings
from mems6dof_ros.sources.source import SourceInfo


class SimulatorSource:
    """One frame after each motion cycle of the simulated gear, with its truth.

    ``settings`` are those of SimulationSettings. ``cycles``: how many, 0: no end. ``loop``: render so many
    cycles at the start and repeat them (see simulation.experiment.loop), which delivers full frames at
    any rate; 0: render each frame when it is read.
    """

    def __init__(self, *, cycles: int = 0, loop: int = 0, **settings: Any) -> None:
        for name, value in (("cycles", cycles), ("loop", loop)):
            if isinstance(value, bool) or not isinstance(value, int) or value < 0:
                raise InputError(name, repr(value), "a whole number of 0 or more")
        self.settings = SimulationSettings.from_dict(settings)
        self._cycles, self._loop = cycles, loop
        self._frames: Iterator[Frame] = iter(())

    @property
    def info(self) -> SourceInfo:
        width, height = self.settings.image_size
        encoding, pixel_size = self.settings.pixel_format, self.settings.pixel_size
        camera = camera_noise(self.settings)
        return SourceInfo("simulator", width, height, encoding, pixel_size, self._cycles or None, camera)

    def start(self) -> None:
        if self._loop:
            rendered = list(motion_frames(self.settings, self._loop))
            frames = repeat(rendered, self.settings.frame_rate)
        else:
            frames = motion_frames(self.settings, self._cycles or 2**62)
        self._frames = itertools.islice(frames, self._cycles or None)

    def read(self, timeout: float | None = None) -> Frame | None:
        return next(self._frames, None)

    def stop(self) -> None:
        self._frames = iter(())


def camera_noise(settings: SimulationSettings) -> CameraNoise:
    """What a data sheet would say of the simulated camera: the means of its maps."""
    read_noise = settings.read_noise * math.exp(settings.read_noise_spread**2)
    return CameraNoise(settings.offset_adu, settings.gain, read_noise, settings.saturation_adu)
