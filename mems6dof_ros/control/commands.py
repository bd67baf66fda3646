"""What a drive is asked and what it answers: the core types of the actuation messages."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

#: Largest relative amplitude of a command.
MAX_AMPLITUDE = 3.0


class Motion(NamedTuple):
    """``cycles`` motion cycles at relative ``amplitude`` in ``direction`` +1 or -1; 0 cycles: stop."""

    cycles: int
    amplitude: float
    direction: int


#: No motion, but a frame: what to do when there is no fresh pose.
LOOK = Motion(1, 0.0, 1)
STOP = Motion(0, 0.0, 1)


@dataclass(frozen=True)
class Command:
    """As in mems6dof_msgs/ActuationCommand; times in ns since the Unix epoch, 0: none."""

    id: int
    motion: Motion
    frequency: float
    expires_ns: int = 0
    pose_stamp_ns: int = 0


class Outcome(IntEnum):
    """Equal to the STATUS_ constants of ActuationAcknowledgement."""

    DONE = 0
    STOPPED = 1
    REFUSED = 2


@dataclass(frozen=True)
class Acknowledgement:
    """As in mems6dof_msgs/ActuationAcknowledgement; times in ns since the Unix epoch, 0: did not happen."""

    id: int
    outcome: Outcome
    reason: str
    cycles_driven: int
    cycle: int
    received_ns: int
    started_ns: int = 0
    ended_ns: int = 0


def why_refused(command: Command, now_ns: int, max_cycles: int, max_frequency: float) -> str:
    """Why a drive must not obey ``command`` at ``now_ns``; empty: it may."""
    cycles, amplitude, direction = command.motion
    if command.expires_ns and now_ns > command.expires_ns:
        return f"expired {(now_ns - command.expires_ns) * 1e-6:.1f} ms before it arrived"
    if cycles == 0:
        return ""
    if cycles > max_cycles:
        return f"{cycles} cycles; expected at most {max_cycles}"
    if direction not in (1, -1):
        return f"direction {direction}; expected +1 or -1"
    if not 0 <= amplitude <= MAX_AMPLITUDE:
        return f"amplitude {amplitude:g}; expected 0 to {MAX_AMPLITUDE:g}"
    if not (math.isfinite(command.frequency) and 0 < command.frequency <= max_frequency):
        return f"frequency {command.frequency:g} Hz; expected more than 0, at most {max_frequency:g} Hz"
    return ""
