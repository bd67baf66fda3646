"""When the next frame is due."""

from __future__ import annotations

#: Late by more than this and more than an interval, a new schedule begins instead of catching up, s.
_PATIENCE = 0.02


class Schedule:
    """Frames at a rate, or at the intervals of their stamps; times are monotonic, s."""

    def __init__(self) -> None:
        self._last: tuple[float, int] | None = None  # when the last frame was due, and its stamp in ns

    def restart(self) -> None:
        """The next frame is due at once."""
        self._last = None

    def due(self, stamp_ns: int, rate: float, speed: float) -> float:
        """When a frame is due: at ``speed`` times the pace of the stamps or, where that is 0, ``rate`` a
        second; 0: at once."""
        return self._last[0] + self._interval(stamp_ns, rate, speed) if self._last else 0.0

    def keep(self, stamp_ns: int, now: float, rate: float, speed: float) -> bool:
        """A frame is published ``now``; False where it is late and the schedule begins anew with it."""
        interval, due = self._interval(stamp_ns, rate, speed), self.due(stamp_ns, rate, speed)
        in_time = interval == 0 or now - due <= max(interval, _PATIENCE)
        self._last = due if in_time and interval > 0 else now, stamp_ns
        return in_time

    def _interval(self, stamp_ns: int, rate: float, speed: float) -> float:
        if self._last is None:
            return 0.0
        if speed > 0:
            return max(stamp_ns - self._last[1], 0) * 1e-9 / speed
        return 1 / rate if rate > 0 else 0.0
