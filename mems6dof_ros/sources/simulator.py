"""Frames from the physical simulator: of a gear that turns by itself or under command, or of a substrate of
beads under a moving stage."""

from __future__ import annotations

import itertools
import math
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

from mems6dof_ros.control.actuator import Actuator
from mems6dof_ros.errors import InputError
from mems6dof_ros.frame import Frame
from mems6dof_ros.localization.camera import CameraNoise
from mems6dof_ros.simulation.experiment import BeadSubstrate, Experiment, motion_frames
from mems6dof_ros.simulation.experiment import loop as repeat
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


def open_simulator(
    *,
    commanded: bool = False,
    substrate: bool = False,
    substrate_beads: int = 200,
    substrate_rotation: float = 0.0,
    **options: Any,
) -> SimulatorSource | CommandedSimulator | SubstrateSimulator:
    """The source "simulator": SimulatorSource, ``commanded`` CommandedSimulator, or ``substrate``
    SubstrateSimulator."""
    if not (commanded or substrate):
        return SimulatorSource(**options)
    if commanded and substrate:
        raise InputError("simulator", "both commanded and substrate", "one of them")
    for name in ("cycles", "loop"):
        if options.pop(name, 0):
            raise InputError(name, "a number of cycles", "0 with commanded or substrate")
    if commanded:
        return CommandedSimulator(**options)
    return SubstrateSimulator(beads=substrate_beads, rotation=substrate_rotation, **options)


class CommandedSimulator:
    """The simulated gear under command: at the start one frame as it stands, then one after each motion cycle
    that ``actuator`` is asked for.

    Frames are live: stamped with the host clock at their exposure. ``experiment`` holds what may happen to
    the measurement. ``settings`` are those of SimulationSettings; the rate is that of the commands.
    """

    def __init__(self, **settings: Any) -> None:
        self.settings = SimulationSettings.from_dict(settings)
        self.actuator = Actuator()
        self.experiment = Experiment(self.settings)
        self._started = False

    @property
    def info(self) -> SourceInfo:
        return replace(SimulatorSource(**self.settings.to_dict()).info, kind="commanded simulator")

    def start(self) -> None:
        self._started = False

    def read(self, timeout: float | None = None) -> Frame | None:
        if self._started:
            command = self.actuator.next_cycle(threading.TIMEOUT_MAX if timeout is None else timeout)
            if command is None:
                raise TimeoutError
            self.experiment.advance(1, command.motion.direction, command.motion.amplitude)
            self.actuator.cycle_done()
        self._started = True
        exposed_ns = time.time_ns()
        return replace(self.experiment.frame(), stamp_ns=exposed_ns, live=True)

    def stop(self) -> None:
        self.actuator.enable(False)


class SubstrateSimulator:
    """Beads on a plane substrate, and the stage that moves the focal plane: a Stage and a FrameSource.

    A frame for each ``read``, live, of wherever ``move_to`` has brought the focal plane; 0 at the start.
    ``beads``, ``rotation`` rad: see BeadSubstrate. ``settings`` are those of SimulationSettings.
    """

    def __init__(self, *, beads: int = 200, rotation: float = 0.0, **settings: Any) -> None:
        self.settings = SimulationSettings.from_dict(settings)
        self._substrate = BeadSubstrate(self.settings, beads=beads, rotation=rotation)
        self._position = self.settings.stage_z

    @property
    def info(self) -> SourceInfo:
        return replace(SimulatorSource(**self.settings.to_dict()).info, kind="simulated substrate of beads")

    def move_to(self, z: float) -> float:
        self._position = z
        return z

    def start(self) -> None:
        pass

    def read(self, timeout: float | None = None) -> Frame | None:
        middle_ns = time.time_ns() + round(self.settings.exposure * 1e9) // 2
        return replace(self._substrate.frame(self._position), stamp_ns=middle_ns, live=True)

    def stop(self) -> None:
        pass


def camera_noise(settings: SimulationSettings) -> CameraNoise:
    """What a data sheet would say of the simulated camera: the means of its maps."""
    read_noise = settings.read_noise * math.exp(settings.read_noise_spread**2)
    return CameraNoise(settings.offset_adu, settings.gain, read_noise, settings.saturation_adu)
