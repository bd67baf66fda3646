"""The gears: particles on them, how the drive turns them, and how they depart from pure rotation."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mems6dof_ros.errors import InputError
from mems6dof_ros.simulation.settings import SimulationSettings

#: Drive amplitude, relative to nominal, up to which friction holds the gear.
STICTION = 0.3

#: Teeth of the load gear per tooth of the ring gear, whose rotation is opposite.
RING_RATIO = 80 / 200

_PLAY_MEMORY = 0.6  # correlation of the place within the clearance from one cycle to the next


class Particles(NamedTuple):
    """Particles of one rigid body: ``position`` (n, 3) m in its frame, ``diameter`` (n,) m,
    ``electrons`` (n,) expected per frame under full illumination."""

    position: NDArray[np.float64]
    diameter: NDArray[np.float64]
    electrons: NDArray[np.float64]


class BodyPose(NamedTuple):
    """``rotation`` (3, 3) and ``translation`` (3,) m, body frame to the microscope's axes with the stage
    at zero; ``psi`` rad, unwrapped."""

    rotation: NDArray[np.float64]
    translation: NDArray[np.float64]
    psi: float


class _Seat:
    """How a body sits on its axis, but for its rotation: eccentricity, tilts, and play anew in every cycle.

    ``R = Swing(t_0 + Rz(psi) t_b + t_play) Rz(psi)``: tilts fixed in the field, turning with the body,
    and within the clearance. ``t = c_0 + Rz(psi) e + play + stage``: eccentricity e of the body's origin.
    Play in x and y is confined to a disc of the clearance's diameter.
    """

    def __init__(
        self, settings: SimulationSettings, fixed: np.random.Generator, play: np.random.Generator
    ) -> None:
        self._settings, self._rng = settings, play
        self._eccentricity = settings.eccentricity * _direction(fixed)
        self._tilt_field = settings.tilt_field * _direction(fixed)
        self._tilt_body = settings.tilt_body * _direction(fixed)
        # Latent places within the clearances: x, y; z; tilt x, tilt y.
        self._place = 0.8 * play.standard_normal(5)

    def jolt(self) -> None:
        """A motion cycle."""
        push = self._rng.standard_normal(5)
        self._place = _PLAY_MEMORY * self._place + 0.8 * math.sqrt(1 - _PLAY_MEMORY**2) * push

    def pose(self, psi: float, centre: NDArray[np.float64], stage: NDArray[np.float64]) -> BodyPose:
        """Pose at ``psi`` rad about ``centre`` (3,) m, all of it moved by ``stage`` (3,) m."""
        settings = self._settings
        turn = Rotation.from_rotvec([0, 0, psi])
        turn_xy = turn.as_matrix()[:2, :2]
        tilt = self._tilt_field + turn_xy @ self._tilt_body + settings.tilt_play * _confined(self._place[3:5])
        translation = centre.copy()
        translation[:2] += turn_xy @ self._eccentricity + settings.play / 2 * _confined(self._place[:2])
        translation[2] += settings.play_z / 2 * _confined(self._place[2:3])[0]
        swing = Rotation.from_rotvec([*tilt, 0])
        return BodyPose((swing * turn).as_matrix(), translation + stage, psi)


class LoadGear:
    """The load gear on its drive, one motion cycle at a time.

    A cycle at relative ``amplitude`` a turns the drive by ``step (1 + e) g(a)`` plus jitter, where
    e is the gain error of this gear (under- or over-drive) and g rises linearly from 0 at STICTION to
    1 at a = 1 (and on to 1.5). Cycles may stall or skip at random. The gear follows the drive with
    backlash. Nothing pulls it back to its teeth: errors add up, as a controller must expect.
    """

    name = "load_gear"

    def __init__(self, settings: SimulationSettings) -> None:
        self._settings = settings
        self.particles = load_gear_particles(settings)
        fixed = np.random.default_rng([settings.seed, 2])
        self._drive_rng = np.random.default_rng([settings.seed, 3])
        self._light_rng = np.random.default_rng([settings.seed, 6])

        self._drive_gain = 1 + settings.step_error * fixed.standard_normal()
        self._seat = _Seat(settings, fixed, np.random.default_rng([settings.seed, 4]))
        self._stage = _Stage(settings, fixed, np.random.default_rng([settings.seed, 5]))
        self._bleaching = settings.bleaching * np.exp(
            0.3 * fixed.standard_normal(len(self.particles.electrons))
        )

        #: Motion cycles that the drive has completed.
        self.cycle = 0
        #: Rotation about the axis, rad, unwrapped.
        self.psi = 0.0
        #: Drift and vibration (3,) m in the latest pose.
        self.stage = np.zeros(3)
        self._drive_angle = settings.backlash / 2  # engaged for forward motion

    @property
    def drive_psi(self) -> float:
        """What the drive has turned by, rad: the gear's psi, but for its backlash."""
        return self._drive_angle - self._settings.backlash / 2

    def advance(self, cycles: int = 1, direction: int = 1, amplitude: float = 1.0) -> None:
        """Drive ``cycles`` motion cycles forward (``direction`` +1) or back (-1).

        Raises InputError for a direction that is neither, negative cycles or an amplitude outside 0 to 3.
        """
        if direction not in (1, -1):
            raise InputError("direction", repr(direction), "+1 or -1")
        if cycles < 0:
            raise InputError("cycles", repr(cycles), "0 or more")
        if not 0 <= amplitude <= 3:
            raise InputError("amplitude", repr(amplitude), "a number from 0 to 3, relative to nominal")
        settings = self._settings
        response = min(max((amplitude - STICTION) / (1 - STICTION), 0.0), 1.5)
        for _ in range(cycles):
            event, jitter = self._drive_rng.random(), self._drive_rng.standard_normal()
            if event < settings.stall_probability:
                teeth = 0
            elif event < settings.stall_probability + settings.skip_probability:
                teeth = 2
            else:
                teeth = 1
            if response and teeth:
                turn = teeth * settings.step * self._drive_gain * response + settings.step_jitter * jitter
                self._drive_angle += direction * turn
                half = settings.backlash / 2
                self.psi = min(max(self.psi, self._drive_angle - half), self._drive_angle + half)
            self._seat.jolt()
            self.cycle += 1

    def pose(self, elapsed: float) -> BodyPose:
        """Pose after ``elapsed`` s of drift, with the vibration of this moment (drawn anew each call)."""
        self.stage = self._stage.at(elapsed)
        settings = self._settings
        return self._seat.pose(
            self.psi, np.array([settings.gear_x, settings.gear_y, settings.gear_z]), self.stage
        )

    def electrons(self) -> NDArray[np.float64]:
        """Electrons (n,) of the particles now, after bleaching; 0 where one happens to be dark."""
        light = self.particles.electrons * np.exp(-self._bleaching * self.cycle)
        return np.where(self._light_rng.random(len(light)) < self._settings.missing, 0.0, light)


class RingGear:
    """The ring gear, which the actuator turns and which drives the load gear: a second rigid body.

    Its particles lie on the part of it that faces the load gear; it turns by -RING_RATIO of the drive,
    without backlash, and sits on an axis of its own with tilts and play of its own.
    """

    name = "ring_gear"

    def __init__(self, settings: SimulationSettings) -> None:
        self._settings = settings
        outer = settings.ring_diameter / 2
        self.particles = scatter_particles(
            settings,
            np.random.default_rng([settings.seed, 8]),
            count=settings.ring_particles,
            outer_radius=outer,
            inner_radius=outer - settings.ring_width,
            relief=settings.height_relief,
        )
        fixed = np.random.default_rng([settings.seed, 9])
        self._seat = _Seat(settings, fixed, np.random.default_rng([settings.seed, 12]))
        distance = outer + settings.gear_diameter / 2
        self._centre = np.array([settings.gear_x, settings.gear_y, settings.gear_z])
        self._centre[0] += distance * math.cos(settings.ring_direction)
        self._centre[1] += distance * math.sin(settings.ring_direction)

    def jolt(self, cycles: int) -> None:
        """Motion cycles have been made."""
        for _ in range(cycles):
            self._seat.jolt()

    def pose(self, gear: LoadGear) -> BodyPose:
        """Pose when the drive of ``gear``, and the stage, are where its last pose found them."""
        return self._seat.pose(-RING_RATIO * gear.drive_psi, self._centre, gear.stage)


class _Stage:
    """What moves everything in view: drift and vibration."""

    def __init__(
        self, settings: SimulationSettings, fixed: np.random.Generator, vibration: np.random.Generator
    ) -> None:
        self._drift = np.append(
            settings.drift_xy * _direction(fixed), settings.drift_z * fixed.choice([-1, 1])
        )
        self._vibration = np.array([settings.vibration_xy, settings.vibration_xy, settings.vibration_z])
        self._rng = vibration

    def at(self, elapsed: float) -> NDArray[np.float64]:
        """Displacement (3,) m after ``elapsed`` s."""
        return self._drift * elapsed + self._rng.standard_normal(3) * self._vibration


def load_gear_particles(settings: SimulationSettings) -> Particles:
    """The constellation of the load gear that ``settings`` describe."""
    return scatter_particles(
        settings,
        np.random.default_rng([settings.seed, 1]),
        count=settings.particles,
        outer_radius=settings.gear_diameter / 2,
        inner_radius=settings.hub_diameter / 2,
        relief=settings.height_relief,
        clumps=settings.clumps,
    )


def scatter_particles(
    settings: SimulationSettings,
    rng: np.random.Generator,
    *,
    count: int,
    outer_radius: float,
    inner_radius: float = 0.0,
    relief: float = 0.0,
    clumps: int = 0,
    separation: float = 0.0,
) -> Particles:
    """Random particles on a ring, never overlapping, with the settings' spread of size and brightness.

    Radii, ``relief`` (sd of height) and ``separation`` (least distance, at least a diameter) in m. The last
    ``clumps`` particles touch another one. Raises InputError when so many do not fit.
    """
    apart = max(separation, settings.diameter)
    xy = np.empty((0, 2))
    attempts = 0
    while len(xy) < count:
        attempts += 1
        if attempts > 200 * count:
            raise InputError("number of particles", str(count), f"about {len(xy)}: no room for more")
        if len(xy) < count - clumps:
            radius = math.sqrt(rng.uniform(inner_radius**2, outer_radius**2))
            candidate = radius * _direction(rng)
        else:
            contact = settings.diameter * rng.uniform(1.0, 2.0)
            candidate = xy[rng.integers(count - clumps)] + contact * _direction(rng)
        needed = apart if len(xy) < count - clumps else settings.diameter
        if not len(xy) or np.hypot(*(xy - candidate).T).min() >= needed:
            xy = np.vstack([xy, candidate])
    height = relief * rng.standard_normal(count)
    size = 1 + settings.diameter_spread * np.clip(rng.standard_normal(count), -3, 3)
    spread = settings.brightness_spread
    brightness = np.exp(spread * rng.standard_normal(count) - spread**2 / 2)
    return Particles(np.column_stack([xy, height]), settings.diameter * size, settings.electrons * brightness)


def _direction(rng: np.random.Generator) -> NDArray[np.float64]:
    """A random unit vector (2,)."""
    angle = rng.uniform(0, 2 * math.pi)
    return np.array([math.cos(angle), math.sin(angle)])


def _confined(place: NDArray[np.float64]) -> NDArray[np.float64]:
    """``place`` held within the unit ball: against its wall where it would leave."""
    return place / max(1.0, float(np.linalg.norm(place)))
