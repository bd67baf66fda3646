"""A stage that moves the focal plane, and the scan through focus that a calibration is made of."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol, runtime_checkable

from mems6dof_ros.errors import InputError
from mems6dof_ros.frame import Frame

#: Planes that anybody would scan; more are a mistake in a unit.
MOST_PLANES = 2000
#: How far the position that a frame states may be from where the stage stands, m.
_SAME_POSITION = 1e-9


@runtime_checkable
class Stage(Protocol):
    """What moves the focal plane. Implement it for a piezo stage of your own."""

    def move_to(self, z: float) -> float:
        """Move the focal plane to ``z`` m, wait until it stands still, and return the position reached, m.

        Raises Mems6dofError where it cannot.
        """
        ...


class Standing(NamedTuple):
    """The stage at rest at ``z`` m since ``since_ns``, host clock."""

    z: float
    since_ns: int


@dataclass(frozen=True)
class FocusScan:
    """Positions from ``start`` to ``stop`` (included) in steps of ``step``, all m, with ``frames_per_plane``
    frames at each. The sign of the step is that of the way. Raises InputError where it is no scan."""

    start: float
    stop: float
    step: float
    frames_per_plane: int = 1

    def __post_init__(self) -> None:
        way, step = self.stop - self.start, abs(self.step)
        if not (math.isfinite(way) and math.isfinite(step) and step > 0 and abs(way) >= step):
            found = f"{self.start} to {self.stop} m in steps of {self.step} m"
            raise InputError("focus scan", found, "a finite way of at least one step")
        if way / step > MOST_PLANES or -way / step > MOST_PLANES:
            raise InputError("focus scan", f"{abs(way) / step:.3g} planes", f"at most {MOST_PLANES}")
        if self.frames_per_plane < 1:
            raise InputError("focus scan", f"{self.frames_per_plane} frames per plane", "1 or more")

    @property
    def positions(self) -> list[float]:
        """Of the focal plane, m."""
        way = self.stop - self.start
        count = math.floor(abs(way / self.step) + 1e-6) + 1
        return [self.start + math.copysign(self.step, way) * index for index in range(count)]


def scan(
    plan: FocusScan,
    move: Callable[[float], Standing],
    next_frame: Callable[[], Frame],
    progress: Callable[[int, int, float], None] = lambda done, total, z: None,
) -> Iterator[Frame]:
    """The frames of ``plan``, each with the position at which it was taken as its ``stage_z``.

    ``move`` brings the stage to a position, ``next_frame`` waits for the next frame of a camera that runs by
    itself; those that were exposed while the stage moved are left out. ``progress`` is called as (planes
    done, planes, position in m); what any of them raises ends the scan.
    """
    positions = plan.positions
    for done, position in enumerate(positions):
        progress(done, len(positions), position)
        standing = move(position)
        for _ in range(plan.frames_per_plane):
            while not shows((frame := next_frame()), standing):
                pass
            yield replace(frame, stage_z=standing.z)
    progress(len(positions), len(positions), positions[-1])


def shows(frame: Frame, standing: Standing) -> bool:
    """Whether ``frame`` was exposed while the stage stood.

    By its stamp where it is live, and by its own ``stage_z`` where it has one.
    """
    exposure_ns = 0 if math.isnan(frame.exposure_s) else round(frame.exposure_s * 1e9)
    if frame.live and frame.stamp_ns - exposure_ns // 2 < standing.since_ns:
        return False
    return math.isnan(frame.stage_z) or abs(frame.stage_z - standing.z) <= _SAME_POSITION
