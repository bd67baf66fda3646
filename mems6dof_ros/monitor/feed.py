"""What the instrument said last, between the thread that hears it and the thread that serves it."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable
from dataclasses import asdict, dataclass
from threading import RLock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mems6dof_ros.monitor.alarms import Alarms, Limit
from mems6dof_ros.monitor.history import COLUMNS, History, pose_row
from mems6dof_ros.monitor.picture import Picture
from mems6dof_ros.pose.cycle_pose import CyclePose, Status

#: Bodies told apart; an unbounded number of names would be unbounded memory.
MAX_BODIES = 16
_MAX_EVENTS = 500
_MAX_EVENTS_PER_SECOND = 20


@dataclass(frozen=True)
class Event:
    """Something worth a line in the log of the page: ``level`` is info, good, warning or alarm."""

    number: int
    time: float
    level: str
    text: str


@dataclass
class _Tracking:
    """Last pose of one body, for what it says beside its numbers."""

    status: Status
    reason: str
    cycle: int
    frame_counter: int
    reference_version: int


class Feed:
    """Shared by two threads: the instrument's side adds, the server's side reads.

    ``log`` hears every alarm, so that it is known also where nobody looks at a page.
    """

    def __init__(self, capacity: int, log: Callable[[str], None] = lambda text: None) -> None:
        self.history = History(capacity)
        self.bodies: dict[str, int] = {}
        self.watchers = 0
        self._alarms = Alarms()
        self._tracking: dict[str, _Tracking] = {}
        self._frames_missing = 0
        self._instrument: dict[str, Any] = {}
        self._picture: tuple[int, Picture | None] = (0, None)
        self._events: deque[Event] = deque(maxlen=_MAX_EVENTS)
        self._event_times: deque[float] = deque(maxlen=_MAX_EVENTS_PER_SECOND)
        self._events_hidden = 0
        self._event_number = 0
        self._log = log
        self._lock = RLock()

    # The instrument's side ----------------------------------------------------------------------

    def add_pose(self, pose: CyclePose, truth: NDArray[np.float64] | None = None) -> None:
        """Take in one pose; ``truth`` (6,) is the true displacement, where it is known."""
        with self._lock:
            if pose.body not in self.bodies:
                if len(self.bodies) == MAX_BODIES:
                    return
                self.bodies[pose.body] = len(self.bodies)
            self._follow(pose)
            row = pose_row(pose, self.bodies[pose.body], truth)
            self.history.append(row)
            for limit, value in self._alarms.judge(row):
                self._tell_alarm(limit, value, pose.cycle)

    def add_picture(self, picture: Picture) -> None:
        """Replace the picture."""
        with self._lock:
            self._picture = (self._picture[0] + 1, picture)

    def set_instrument(self, state: dict[str, Any]) -> None:
        """Replace parts of what is known of the instrument as a whole (JSON-ready: rates, services, ...)."""
        with self._lock:
            self._instrument |= state

    def tell(self, level: str, text: str) -> None:
        """Add a line to the log of the page; what would flood it is only counted."""
        with self._lock:
            now = time.time()
            if len(self._event_times) == _MAX_EVENTS_PER_SECOND and now - self._event_times[0] < 1:
                self._events_hidden += 1
                return
            if self._events_hidden:
                text += f" ({self._events_hidden} lines before this one not shown)"
                self._events_hidden = 0
            self._event_times.append(now)
            self._event_number += 1
            self._events.append(Event(self._event_number, now, level, text))

    # The server's side --------------------------------------------------------------------------

    def picture(self) -> tuple[int, Picture | None]:
        """The newest picture and its number."""
        with self._lock:
            return self._picture

    def events(self, after: int) -> list[dict[str, Any]]:
        """Events with a number beyond ``after``."""
        with self._lock:
            if after == self._event_number:
                return []
            return [asdict(event) for event in self._events if event.number > after]

    def state(self) -> dict[str, Any]:
        """Everything that is not a row, a picture or an event, JSON-ready."""
        with self._lock:
            return {
                **self._instrument,
                "frames_missing": self._frames_missing,
                "bodies": [
                    {"name": name, "number": number, **asdict(self._tracking[name])}
                    for name, number in self.bodies.items()
                ],
                "limits": [
                    {
                        "quantity": limit.quantity,
                        "low": _finite(limit.low),
                        "high": _finite(limit.high),
                        "active": limit.active,
                        "count": limit.count,
                    }
                    for limit in self._alarms.limits.values()
                ],
            }

    def set_limit(self, limit: Limit) -> None:
        """Set the limit of one quantity."""
        with self._lock:
            self._alarms.set(limit)

    def remove_limit(self, quantity: str) -> None:
        """Drop the limit of one quantity."""
        with self._lock:
            self._alarms.remove(quantity)

    # --------------------------------------------------------------------------------------------

    def _follow(self, pose: CyclePose) -> None:
        """Notice what changed since the last pose of the same body: runs, losses, status."""
        last = self._tracking.get(pose.body)
        if last is not None and pose.cycle < last.cycle:
            self.tell("info", f"Cycle {pose.cycle} after {last.cycle}: a new run, the plots begin anew")
            self.history.clear()
            self._frames_missing = 0
        elif last is not None and self.bodies[pose.body] == 0:
            self._frames_missing += max(pose.frame_counter - last.frame_counter - 1, 0)
        if last is None or pose.status != last.status:
            level = {Status.TRACKING: "good", Status.LOST: "alarm"}.get(pose.status, "warning")
            reason = f": {pose.reason}" if pose.reason else ""
            self.tell(level, f"{pose.body} {pose.status.name.lower()} in cycle {pose.cycle}{reason}")
        if last is not None and pose.reference_version != last.reference_version:
            self.tell("info", f"{pose.body}: reference {pose.reference_version} in cycle {pose.cycle}")
        self._tracking[pose.body] = _Tracking(
            pose.status, pose.reason, pose.cycle, pose.frame_counter, pose.reference_version
        )

    def _tell_alarm(self, limit: Limit, value: float, cycle: int) -> None:
        unit = COLUMNS[limit.quantity]
        text = f"{limit.quantity} = {value:.4g} {unit} in cycle {cycle}".replace("  ", " ")
        if limit.active:
            text += f", outside {limit.low:.4g} to {limit.high:.4g} {unit}".rstrip()
            self._log(text)
            self.tell("alarm", text)
        else:
            self.tell("good", f"{text}, within its limits again after {limit.count} cycles outside")


def _finite(bound: float) -> float | None:
    """JSON knows no infinity: an open limit is None."""
    return bound if math.isfinite(bound) else None
