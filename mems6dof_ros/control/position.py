"""The law that positions the gear: which motion brings psi to its target in the fewest cycles."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any, Protocol

from mems6dof_ros.control.commands import LOOK, MAX_AMPLITUDE, Motion
from mems6dof_ros.errors import InputError
from mems6dof_ros.pose.cycle_pose import CyclePose

_PSI = 5  # in DEGREES_OF_FREEDOM


def _field(default: Any, unit: str, low: float, high: float, doc: str) -> Any:
    return dataclasses.field(default=default, metadata={"unit": unit, "range": (low, high), "doc": doc})


@dataclass(frozen=True)
class DriveSettings:
    """What is known of a drive beforehand, and how well the gear must be placed."""

    step: float = _field(math.pi / 40, "rad", 1e-6, math.pi, "Nominal rotation per motion cycle.")
    stiction: float = _field(0.3, "1", 0.0, 0.95, "Relative amplitude up to which friction holds the gear.")
    scatter: float = _field(1e-3, "rad", 1e-9, 1.0, "Standard deviation of the rotation of one cycle.")
    backlash: float = _field(5e-3, "rad", 0.0, 1.0, "Rotation lost when the direction changes.")
    max_amplitude: float = _field(1.0, "1", 0.0, MAX_AMPLITUDE, "Largest relative amplitude to command.")
    fine_steps: bool = dataclasses.field(
        default=True,
        metadata={"doc": "The amplitude may be varied; otherwise every cycle is at max_amplitude."},
    )
    tolerance: float = _field(
        1e-3,
        "rad",
        1e-6,
        math.pi,
        "Largest error of psi at arrival. One step's resolution (the scatter of a cycle, or half a step"
        " without fine_steps) takes its place where that is larger.",
    )

    def __post_init__(self) -> None:
        if self.max_amplitude <= self.stiction:
            found, least = f"{self.max_amplitude:g}", f"more than stiction, {self.stiction:g}"
            raise InputError("drive setting max_amplitude", found, least)

    @property
    def resolution(self) -> float:
        """One step's resolution, rad: what a single cycle cannot place the gear better than."""
        return self.scatter if self.fine_steps else self.step / 2


class Law(Protocol):
    """What a controller asks after every cycle. Safety is not its business: see Controller."""

    def next_motion(self, target: float, pose: CyclePose, made: Motion | None) -> Motion | None:
        """The motion to make now; None: arrived.

        ``target`` psi in rad; ``pose`` fresh and valid; ``made``: the motion between the pose of the
        last call and this one, None where that is not known.
        """
        ...


class PositionLaw:
    """As many equal cycles as the distance takes at least, reconsidered after each of them.

    Every pose refines what is known of the drive, so that the next amplitude is right for this gear.
    """

    def __init__(self, drive: DriveSettings) -> None:
        self._drive = DriveModel(drive)
        self._settings = drive
        self._tolerance = max(drive.tolerance, drive.resolution)
        self._psi = math.nan

    def next_motion(self, target: float, pose: CyclePose, made: Motion | None) -> Motion | None:
        psi_before, self._psi = self._psi, float(pose.displacement[_PSI])
        if made is not None and made != LOOK and math.isfinite(psi_before):
            self._drive.learn(made, self._psi - psi_before)
        distance = target - self._psi
        sd = math.sqrt(pose.displacement_covariance[_PSI, _PSI])
        # Within the tolerance by four standard deviations of the measurement, where it is that good.
        if abs(distance) <= max(self._tolerance - 4 * sd, self._tolerance / 2):
            return None
        return self._drive.plan(distance)


class DriveModel:
    """A cycle at relative amplitude a turns the gear by gain (a - stiction)/(1 - stiction), less the slack
    that it takes up first. Gain, stiction and backlash are means of what the latest cycles showed."""

    MEMORY = 10  # observations after which older ones are forgotten

    def __init__(self, settings: DriveSettings) -> None:
        self.gain, self.stiction, self.backlash = settings.step, settings.stiction, settings.backlash
        self._settings = settings
        self._seen = {"gain": 0, "stiction": 1, "backlash": 1}  # the settings count as one, but for the gain
        # By direction, what the drive turns before the gear follows; not known at first, and taken for none.
        self._slack = {1: 0.0, -1: 0.0}

    def turn(self, amplitude: float) -> float:
        """Rotation of the drive by one cycle, rad."""
        return self.gain * max(amplitude - self.stiction, 0.0) / (1 - self.stiction)

    def slack(self, direction: int) -> float:
        """What the drive turns in ``direction`` before the gear follows, rad."""
        return self._slack[direction]

    def plan(self, distance: float) -> Motion:
        """The next of the fewest equal cycles that turn the gear by ``distance`` rad."""
        direction = 1 if distance > 0 else -1
        way = abs(distance) + self._slack[direction]
        amplitude = self._settings.max_amplitude
        if self._settings.fine_steps:
            cycles = math.ceil(way / self.turn(amplitude))
            amplitude = self.stiction + (1 - self.stiction) * way / cycles / self.gain
        return Motion(1, amplitude, direction)

    def learn(self, made: Motion, rotation: float) -> None:
        """The gear turned by ``rotation`` rad in ``made``."""
        direction, moved = made.direction, made.direction * rotation / made.cycles
        expected, slack = self.turn(made.amplitude), self._slack[made.direction]
        follows = moved > 0.05 * expected
        small = made.amplitude < (1 + self.stiction) / 2  # of small cycles, stiction takes the larger part
        if small and follows:
            stiction = (self.gain * made.amplitude - moved - slack) / (self.gain - moved - slack)
            self._observe("stiction", min(max(stiction, self.stiction - 0.1), self.stiction + 0.1))
        elif small and not slack:
            self.stiction = min(max(self.stiction, made.amplitude), 0.9)
        elif slack and follows:
            self._observe("backlash", max(self.backlash - slack + expected - moved, 0.0))
        elif 0.2 * expected < moved < 1.8 * expected:  # neither a stall nor a skipped tooth
            self._observe("gain", self.gain * moved / expected)
        left = 0.0 if follows else max(slack - expected, 0.0)
        self._slack = {direction: left, -direction: self.backlash - left}

    def _observe(self, what: str, value: float) -> None:
        self._seen[what] = min(self._seen[what] + 1, self.MEMORY)
        mean = getattr(self, what)
        setattr(self, what, mean + (value - mean) / self._seen[what])
