"""Controller: poses, acknowledgements and times in, commands and reasons out.

::

    IDLE ── target ──▶ MOVING ── within the tolerance ──▶ ARRIVED
                        │  ▲                                │
      limit, lost pose, │  └──────────── target ────────────┤
      deadline          ▼                                   │
                      STOPPED ──────────── target ──────────┘

It owns safety, its law the motion. One command at a time: the next is decided only on a pose that shows the
end of the last. A drive that hears nothing stands still, so a controller that has died, or waits, is safe.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

from mems6dof_ros.control.commands import LOOK, STOP, Acknowledgement, Command, Motion, Outcome
from mems6dof_ros.control.position import Law
from mems6dof_ros.errors import InputError
from mems6dof_ros.pose.cycle_pose import CyclePose, Status


def _field(default: float, unit: str, low: float, high: float, doc: str) -> Any:
    return dataclasses.field(default=default, metadata={"unit": unit, "range": (low, high), "doc": doc})


@dataclass(frozen=True)
class ControllerSettings:
    """Limits and deadlines; beyond any of them the controller stops."""

    frequency: float = _field(90.0, "Hz", 1e-3, 1e4, "Motion cycles per second.")
    max_play: float = _field(
        3e-6,
        "m",
        0.0,
        1e-3,
        "Largest displacement in x and y, from reference version 2 on, whose origin is near the centre of"
        " rotation; after a whole revolution it is known well enough for 1e-6.",
    )
    max_tilt: float = _field(5e-3, "rad", 0.0, 1.0, "Largest tilt from the reference.")
    max_sd_psi: float = _field(0.5e-3, "rad", 0.0, 1.0, "Largest standard deviation of psi to act on.")
    max_pose_age: float = _field(1.0, "s", 1e-3, 60.0, "A pose whose exposure is longer ago is stale.")
    command_lifetime: float = _field(0.2, "s", 1e-3, 60.0, "The drive refuses a command that comes later.")
    acknowledge_timeout: float = _field(0.5, "s", 1e-3, 60.0, "From the motion's end to its acknowledgement.")
    pose_timeout: float = _field(1.0, "s", 1e-3, 60.0, "From the acknowledgement to the pose that shows it.")
    move_timeout: float = _field(60.0, "s", 1e-3, 1e5, "From a target to its arrival.")


class State(IntEnum):
    """Equal to the STATE_ constants of ControllerState."""

    IDLE = 0
    MOVING = 1
    ARRIVED = 2
    STOPPED = 3


@dataclass(frozen=True)
class Decision:
    """``command`` to send, None: nothing; ``pose`` that led to it, None: none."""

    command: Command | None
    pose: CyclePose | None = None


@dataclass
class _Awaited:
    """The command under way; ``cycle``: of the frame that shows its end, 0 until acknowledged."""

    id: int
    motion: Motion
    sent: float
    deadline: float
    cycle: int = 0


class Controller:
    """Brings psi to one target after another. All times in s since the Unix epoch.

    Each method returns a Decision, or None where nothing is to be decided; ``state``, ``reason``, ``target``,
    ``cycles`` (driven for this target) tell what holds after it.
    """

    def __init__(self, settings: ControllerSettings, law: Law) -> None:
        self.settings = settings
        self.state = State.IDLE
        self.reason = ""
        self.target = math.nan
        self.cycles = 0
        self._law = law
        self._last_id = 0
        self._awaited: _Awaited | None = None
        self._move_deadline = math.inf
        self._pose: CyclePose | None = None  # the latest

    def set_target(self, target: float, now: float) -> Decision | None:
        """Go to psi = ``target`` rad. Raises InputError unless it is finite."""
        if not math.isfinite(target):
            raise InputError("target", f"{target}", "an angle psi in rad")
        known = self._pose if self.state is State.ARRIVED else None
        self.state, self.target, self.cycles, self.reason = State.MOVING, target, 0, ""
        self._move_deadline = now + self.settings.move_timeout
        if self._awaited:
            return None  # under way: the pose that is due decides
        if known is not None and not self._why_stop(known, now):
            return self._act(known, None, now)
        return self._send(LOOK, now, None)

    def on_acknowledgement(self, answer: Acknowledgement, now: float) -> Decision | None:
        """The drive has answered a command, perhaps of somebody else."""
        awaited = self._awaited
        if awaited is None or answer.id != awaited.id or awaited.cycle:
            return None
        if answer.received_ns * 1e-9 < awaited.sent:
            return None  # to a controller before this one, which counted from 1 too
        self.cycles += answer.cycles_driven
        if answer.outcome is not Outcome.DONE:
            return self.stop(f"the drive {answer.outcome.name.lower()} command {answer.id}: {answer.reason}")
        awaited.cycle, awaited.deadline = answer.cycle, now + self.settings.pose_timeout
        return self._decide(now)

    def on_pose(self, pose: CyclePose, now: float) -> Decision | None:
        """A pose has arrived."""
        before = self._pose
        if before and pose.stamp_ns < before.stamp_ns <= now * 1e9:
            return None  # late: what is known is newer, unless time itself has gone back
        self._pose = pose
        if self.state is not State.MOVING:
            return None
        if self._awaited and pose.stamp_ns * 1e-9 < self._awaited.sent:
            return None  # exposed before the command: says nothing of its motion, however late it comes
        if why := self._why_stop(pose, now) or self._why_another_psi(before, pose):
            return self.stop(why)
        return self._decide(now)

    def on_time(self, now: float) -> Decision | None:
        """To be called regularly: the watchdog."""
        if self.state is not State.MOVING:
            return None
        if now > self._move_deadline:
            return self.stop(f"not arrived within {self.settings.move_timeout:g} s")
        if self._awaited and now > self._awaited.deadline:
            what = f"pose of cycle {self._awaited.cycle}" if self._awaited.cycle else "acknowledgement"
            return self.stop(f"no {what} after command {self._awaited.id} in time")
        return None

    def stop(self, reason: str) -> Decision:
        """Stop the drive and stay so until the next target."""
        self.state, self.reason, self._awaited = State.STOPPED, reason, None
        return Decision(self._command(STOP, 0.0, None), self._pose)

    def _decide(self, now: float) -> Decision | None:
        """Ask the law, once acknowledgement and pose of the command under way are both here."""
        pose, awaited = self._pose, self._awaited
        if pose is None or awaited is None or not awaited.cycle or pose.cycle < awaited.cycle:
            return None
        if pose.cycle > awaited.cycle:
            return self.stop(f"cycle {pose.cycle} after {awaited.cycle}: somebody else moves the drive")
        if why := self._why_stop(pose, now):  # it may have waited for the acknowledgement
            return self.stop(why)
        made, self._awaited = awaited.motion, None
        return self._act(pose, made, now)

    def _act(self, pose: CyclePose, made: Motion | None, now: float) -> Decision:
        motion = self._law.next_motion(self.target, pose, made)
        if motion is not None:
            return self._send(motion, now, pose)
        self.state = State.ARRIVED
        return Decision(None, pose)

    def _send(self, motion: Motion, now: float, pose: CyclePose | None) -> Decision:
        command = self._command(motion, now, pose)
        duration = motion.cycles / command.frequency
        deadline = now + self.settings.command_lifetime + duration + self.settings.acknowledge_timeout
        self._awaited = _Awaited(command.id, motion, now, deadline)
        return Decision(command, pose)

    def _command(self, motion: Motion, now: float, pose: CyclePose | None) -> Command:
        self._last_id += 1
        return Command(
            self._last_id,
            motion,
            self.settings.frequency,
            round((now + self.settings.command_lifetime) * 1e9) if motion.cycles else 0,
            pose.stamp_ns if pose else 0,
        )

    def _why_stop(self, pose: CyclePose, now: float) -> str:
        """Why nothing may be done on ``pose``; empty: it is good."""
        limits = self.settings
        if pose.status is not Status.TRACKING:
            return f"pose {pose.status.name.lower()}: {pose.reason}"
        if (age := now - pose.stamp_ns * 1e-9) > limits.max_pose_age:
            return f"stale pose, {age:.2f} s old"
        dx, dy, _, tilt_x, tilt_y, _ = pose.displacement
        if not (sd := math.sqrt(pose.displacement_covariance[5, 5])) <= limits.max_sd_psi:
            return f"psi known to {sd * 1e3:.2f} mrad only"
        if not (tilt := math.hypot(tilt_x, tilt_y)) <= limits.max_tilt:
            return f"tilt of {tilt * 1e3:.2f} mrad"
        # In the first version the origin is that of the field, which turns with the gear.
        if pose.reference_version > 1 and not (play := math.hypot(dx, dy)) <= limits.max_play:
            return f"displaced by {play * 1e6:.2f} um"
        return ""

    def _why_another_psi(self, before: CyclePose | None, pose: CyclePose) -> str:
        """Why psi of ``pose`` does not continue that of ``before``; empty: it does."""
        if before is None or not before.valid or before.reference_version == pose.reference_version:
            return ""
        jump = pose.displacement[5] - before.displacement[5] - pose.increment[5]
        unnoticed = max(math.sqrt(pose.displacement_covariance[5, 5]), 1e-9)
        if pose.increment_cycles == pose.cycle - before.cycle and abs(jump) < unnoticed:
            return ""
        return f"reference version {pose.reference_version}: psi has another zero"
