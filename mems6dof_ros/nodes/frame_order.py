"""What follows what: new frames, those that come again or late, and a source that has begun anew."""

from __future__ import annotations

import enum
import threading
from collections import deque

#: Frames whose stamps are known to have come.
_MEMORY = 64
#: So many frames in a row that are all behind, but follow each other, are no disorder.
_A_NEW_RUN = 5


class Arrival(enum.Enum):
    """What a frame is to those before it."""

    NEXT = enum.auto()
    AGAIN = enum.auto()  # it has come before
    LATE = enum.auto()  # younger ones have come before
    ANEW = enum.auto()  # the first of a source that was started again, on the same microsystem
    REWOUND = enum.auto()  # the first after simulated time has jumped back


class FrameOrder:
    """Judges frames by stamp and frame counter, in the order in which they arrive.

    A source that is restarted counts from 0: a camera goes on in time, a recording goes back in it. Where its
    first frame is missed, or its counter begins elsewhere, it is known by a run of frames behind the last
    that follow each other. ``rewind`` may be called from another thread.
    """

    def __init__(self) -> None:
        self._last: tuple[int, int] | None = None  # stamp in ns, and counter
        self._recent: deque[int] = deque(maxlen=_MEMORY)
        self._behind = 0, 0  # latest stamp of frames behind the last, and how many follow each other
        self._rewound = threading.Event()

    def rewind(self) -> None:
        """Time has jumped back: the next frame with a stamp before the last begins a new time."""
        self._rewound.set()

    def judge(self, stamp_ns: int, counter: int | None) -> Arrival:
        """Take in a frame; ``stamp_ns`` 0: not stamped, ``counter`` None: not counted."""
        arrival = self._compare(stamp_ns, counter)
        if arrival in (Arrival.AGAIN, Arrival.LATE):
            return arrival
        if arrival is not Arrival.NEXT:
            self._recent.clear()
        self._last = stamp_ns, -1 if counter is None else counter
        self._recent.append(stamp_ns)
        self._behind = 0, 0
        return arrival

    def _compare(self, stamp_ns: int, counter: int | None) -> Arrival:
        if self._last is None or stamp_ns == 0:
            return Arrival.NEXT
        last_ns, last_counter = self._last
        if stamp_ns > last_ns:
            return Arrival.ANEW if counter is not None and counter < last_counter else Arrival.NEXT
        if self._rewound.is_set() and stamp_ns < last_ns:
            self._rewound.clear()
            return Arrival.REWOUND
        behind_ns, run = self._behind
        self._behind = stamp_ns, run + 1 if stamp_ns > behind_ns else 1
        if (counter == 0 and last_counter > 0) or self._behind[1] == _A_NEW_RUN:
            return Arrival.ANEW
        return Arrival.AGAIN if stamp_ns in self._recent else Arrival.LATE


class CycleCount:
    """Motion cycles that ascend, also over a restart of the source that counts them."""

    def __init__(self) -> None:
        self._ahead, self._next = 0, 0
        self._restarted = False

    def restart(self) -> None:
        """The source counts anew from the next cycle on."""
        self._restarted = True

    def __call__(self, cycle: int) -> int:
        """The number of a cycle that the source calls ``cycle``."""
        if self._restarted:
            self._ahead, self._restarted = self._next - cycle, False
        self._next = max(self._next, cycle + self._ahead + 1)
        return cycle + self._ahead
