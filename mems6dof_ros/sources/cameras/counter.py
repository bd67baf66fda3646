"""The device's frame counter, made endless."""

from __future__ import annotations

#: GigE Vision's 16-bit block id runs from 1 to 65535 and then from 1 again (0 is reserved).
_WRAP = 65535


class FrameCounter:
    """Tells how many frames the device produced from one count to the next.

    Counts up to 65535 are taken modulo 65535 (they may be 16-bit), larger ones as they are.
    """

    def __init__(self) -> None:
        self._last: int | None = None

    def advance(self, count: int) -> int:
        """Frames produced since the count before, this one included; 0 for one that comes again or late."""
        if self._last is None:
            step = 1
        elif max(count, self._last) > _WRAP:
            step = count - self._last
        else:
            step = (count - self._last) % _WRAP
            if step > _WRAP // 2:  # half a round ahead is a step back
                step = 0
        if step <= 0:
            return 0
        self._last = count
        return step
