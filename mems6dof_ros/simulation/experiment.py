"""Simulated measurements: a turning gear, and a substrate of beads through focus."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Iterator, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from mems6dof_ros.errors import InputError
from mems6dof_ros.frame import Frame
from mems6dof_ros.simulation.microscope import Body, Microscope
from mems6dof_ros.simulation.microsystem import (
    BodyPose,
    LoadGear,
    RingGear,
    load_gear_particles,
    scatter_particles,
)
from mems6dof_ros.simulation.settings import SimulationSettings


class Experiment:
    """The load gear under the microscope: ``advance`` the drive, take a ``frame``, repeat.

    ``microscope.camera`` tells what a localizer must know of the camera; ``gear`` is the truth. What may
    happen to a measurement, from the next frame on: ``cover``, ``shift``, ``exchange_particles``.
    """

    def __init__(self, settings: SimulationSettings) -> None:
        self.settings = settings
        self.microscope = Microscope(settings, np.random.default_rng([settings.seed, 10]))
        self.gear = LoadGear(settings)
        self.ring = RingGear(settings) if settings.ring_particles else None
        half_width, half_height = (0.5 * size * settings.pixel_size for size in settings.image_size)
        self._strays = scatter_particles(
            settings,
            np.random.default_rng([settings.seed, 7]),
            count=settings.stray_particles,
            outer_radius=math.hypot(half_width, half_height),
        )
        self._period = 0
        self._exposed = False
        self._covered = False
        self._shift = np.zeros(3)

    def advance(self, cycles: int = 1, direction: int = 1, amplitude: float = 1.0) -> None:
        """Drive the gear, see LoadGear.advance; the clock moves by one frame period per cycle."""
        self.gear.advance(cycles, direction, amplitude)
        if self.ring:
            self.ring.jolt(cycles)
        self._period += cycles
        self._exposed = self._exposed and cycles == 0

    def cover(self, covered: bool = True) -> None:
        """Cover the lens, or uncover it: no light at all."""
        self._covered = covered

    def shift(self, x: float, y: float) -> None:
        """Move everything in view by ``x``, ``y`` m from where it belongs, as a stage that was knocked."""
        self._shift = np.array([x, y, 0.0])

    def exchange_particles(self, seed: int) -> None:
        """Put another constellation on the load gear, as its ``seed`` gives it; ``settings.seed`` puts the
        right one back."""
        self.gear.particles = load_gear_particles(dataclasses.replace(self.settings, seed=seed))

    def frame(self) -> Frame:
        """Expose the gear as it stands; a second frame without a cycle between comes a period later."""
        if self._exposed:
            self._period += 1
        self._exposed = True
        pose = self.gear.pose(self._period / self.settings.frame_rate)
        bodies = [Body(self.gear.name, self.gear.particles, self.gear.electrons(), pose)]
        if self.ring:
            particles = self.ring.particles
            bodies.append(Body(self.ring.name, particles, particles.electrons, self.ring.pose(self.gear)))
        if len(self._strays.electrons):
            still = BodyPose(np.eye(3), np.array([0, 0, self.settings.gear_z]), 0.0)
            bodies.append(Body("strays", self._strays, self._strays.electrons, still))
        moved = [
            body._replace(pose=body.pose._replace(translation=body.pose.translation + self._shift))
            for body in bodies
        ]
        return self.microscope.frame(
            moved,
            period=self._period,
            cycle=self.gear.cycle,
            stage_z=self.settings.stage_z,
            covered=self._covered,
        )


def motion_frames(settings: SimulationSettings, cycles: int) -> Iterator[Frame]:
    """One frame after each of ``cycles`` motion cycles: ``cycle`` counts 1 to ``cycles``."""
    experiment = Experiment(settings)
    for _ in range(cycles):
        experiment.advance()
        yield experiment.frame()


def revolution(settings: SimulationSettings) -> list[Frame]:
    """The frames of one revolution that closes exactly, for ``loop``: a drive without error.

    Raises InputError unless the step divides a revolution.
    """
    cycles = round(2 * math.pi / abs(settings.step)) if settings.step else 0
    if not math.isclose(cycles * abs(settings.step), 2 * math.pi, rel_tol=1e-9):
        raise InputError("simulation setting step", f"{settings.step} rad", "a whole fraction of 2 pi")
    exact = dataclasses.replace(
        settings, step_error=0.0, step_jitter=0.0, stall_probability=0.0, skip_probability=0.0
    )
    return list(motion_frames(exact, cycles))


def loop(frames: Sequence[Frame], frame_rate: float = 90.0) -> Iterator[Frame]:
    """Repeat pre-rendered ``frames`` without end, as from a gear that turns on.

    Stamps, frame counters and cycles continue, at ``frame_rate`` Hz; psi of a body that turned goes on by
    whole revolutions. The images repeat, noise included, and so do play and tilt: right for measuring
    rate and latency, not for statistics beyond the first pass. Frames that do not close a revolution
    (see ``revolution``) jump where they start again. Raises InputError without frames.
    """
    if not frames:
        raise InputError("loop", "no frames", "at least one")
    first = frames[0]
    cycles = frames[-1].cycle - first.cycle + 1
    for count in itertools.count():
        turn, index = divmod(count, len(frames))
        frame = frames[index]
        truth = []
        for start, end, now in zip(first.truth, frames[-1].truth, frame.truth, strict=True):
            revolutions = round((end.psi - start.psi) / (2 * math.pi))
            truth.append(dataclasses.replace(now, psi=now.psi + turn * revolutions * 2 * math.pi))
        yield dataclasses.replace(
            frame,
            stamp_ns=first.stamp_ns + round(count * 1e9 / frame_rate),
            frame_counter=first.frame_counter + count,
            cycle=frame.cycle + turn * cycles,
            truth=tuple(truth),
        )


class BeadSubstrate:
    """A plane substrate with beads, for calibration: a ``frame`` at any position of the stage.

    ``tilt`` rad leans the substrate about its own x axis, which turns with ``rotation`` rad about the optical
    axis; ``relief`` m is the sd of the beads' own heights; ``separation`` m the least distance of two;
    ``beads`` are those inside the disc through the image's corners. ``stage_noise`` m rms: error of
    every position of the stage, on top of what it reports. ``seed`` selects the substrate.
    """

    def __init__(
        self,
        settings: SimulationSettings,
        *,
        beads: int = 200,
        tilt: float = 0.5e-3,
        rotation: float = 0.0,
        relief: float = 30e-9,
        separation: float = 8e-6,
        stage_noise: float = 0.0,
        seed: int = 0,
    ) -> None:
        self.settings = settings
        # Another substrate, or the same one turned, is another measurement: its noise differs.
        which = [settings.seed, 20, seed, int(np.float64(rotation).view(np.uint64))]
        self.microscope = Microscope(settings, np.random.default_rng(which))
        width, height = settings.image_size
        self._beads = scatter_particles(
            settings,
            np.random.default_rng([seed, 20]),
            count=beads,
            outer_radius=0.5 * math.hypot(width, height) * settings.pixel_size,
            relief=relief,
            separation=separation,
        )
        turned = Rotation.from_rotvec([0, 0, rotation]) * Rotation.from_rotvec([tilt, 0, 0])
        self._pose = BodyPose(turned.as_matrix(), np.zeros(3), rotation)
        self._stage_noise = stage_noise
        self._stage_rng = np.random.default_rng([seed, 21])
        self._period = 0

    def frame(self, stage_z: float) -> Frame:
        """Expose the beads with the focal plane at ``stage_z`` m; the substrate lies about 0."""
        at = stage_z + self._stage_noise * self._stage_rng.standard_normal()
        body = Body("substrate", self._beads, self._beads.electrons, self._pose)
        frame = self.microscope.frame(
            [body], period=self._period, cycle=0, stage_z=stage_z, focal_plane=float(at)
        )
        self._period += 1
        return frame


def focus_stack(
    settings: SimulationSettings,
    start: float,
    stop: float,
    step: float,
    *,
    frames_per_plane: int = 1,
    beads: int = 200,
    tilt: float = 0.5e-3,
    substrate_rotation: float = 0.0,
    relief: float = 30e-9,
    separation: float = 8e-6,
    stage_noise: float = 0.0,
    seed: int = 0,
) -> Iterator[Frame]:
    """Frames of a BeadSubstrate with the stage from ``start`` to ``stop`` (included) in steps, all m.

    Raises InputError unless the step leads from start to stop.
    """
    if not step or not 0 <= (stop - start) / step < math.inf:
        raise InputError("focus stack", f"{start} to {stop} m in steps of {step} m", "a step towards stop")
    substrate = BeadSubstrate(
        settings,
        beads=beads,
        tilt=tilt,
        rotation=substrate_rotation,
        relief=relief,
        separation=separation,
        stage_noise=stage_noise,
        seed=seed,
    )
    for plane in range(math.floor((stop - start) / step + 1e-6) + 1):
        for _ in range(frames_per_plane):
            yield substrate.frame(start + plane * step)
