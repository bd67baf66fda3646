"""Image and frame_info come on two topics, or the image from shared memory; this makes pairs of them."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any, NamedTuple


class ArrivedFrame(NamedTuple):
    """An Image with its FrameInfo, None where there is none; ``arrival_ns`` of the image, host clock."""

    image: Any
    info: Any
    arrival_ns: int


@dataclass
class _Frame:
    stamp_ns: int
    since: int  # ticks
    info: Any = None
    image: Any = None
    arrival_ns: int = 0
    alone: bool = False  # what it lacks will not come


class FrameMatcher:
    """Pairs images with frame infos by their stamps in ns.

    The order is that of the infos, wherever their images come from. Each waits for its image until one that
    was told of later has come by the topic, on which they come in order, or for ``patience`` ticks: ticks
    of the callbacks' own timer, so that time in which no callback could run does not count. Then it is
    forgotten. An image that arrives before its info waits likewise, but only while somebody publishes infos,
    and is passed on without.
    """

    def __init__(self, patience: int = 10) -> None:
        self._patience = patience
        self._told: deque[_Frame] = deque()  # in the order of the infos
        self._early: deque[_Frame] = deque()  # without info, in the order of the images
        self._from_memory: deque[int] = deque(maxlen=64)  # stamps of the last
        self._last_info_ns = -1
        self._ticks = self._ticks_at_info = 0

    def tick(self) -> None:
        """Time goes by."""
        self._ticks += 1

    def add_info(self, stamp_ns: int, info: Any, image: Any = None, arrival_ns: int = 0) -> None:
        """An info has arrived, perhaps with its image from memory: that by the topic is then ignored."""
        frame = _Frame(stamp_ns, self._ticks, info, image, arrival_ns)
        if image is not None:
            self._from_memory.append(stamp_ns)
        for early in list(self._early):
            if early.stamp_ns == stamp_ns:
                self._early.remove(early)
                if image is None:
                    frame.image, frame.arrival_ns = early.image, early.arrival_ns
            elif early.stamp_ns < stamp_ns:
                early.alone = True
            else:
                frame.alone = True
        self._told.append(frame)
        self._last_info_ns, self._ticks_at_info = stamp_ns, self._ticks

    def passes_by(self, stamp_ns: int) -> bool:
        """An image arrives by the topic; True: it is known from memory, and tells but what was lost."""
        self._give_up_before(stamp_ns)
        return stamp_ns in self._from_memory

    def add_image(self, stamp_ns: int, image: Any, arrival_ns: int) -> None:
        """An image has arrived by the topic at ``arrival_ns``."""
        awaited = self._give_up_before(stamp_ns)
        if awaited is None:
            alone = stamp_ns <= self._last_info_ns
            self._early.append(_Frame(stamp_ns, self._ticks, None, image, arrival_ns, alone))
        else:
            awaited.image, awaited.arrival_ns = image, arrival_ns

    def _give_up_before(self, stamp_ns: int) -> _Frame | None:
        """Frames that lack their image when a later one has come; returns the one that waits for this."""
        awaited = next((f for f in self._told if f.stamp_ns == stamp_ns and f.image is None), None)
        for frame in self._told:
            if frame is awaited:
                break
            frame.alone |= awaited is not None or frame.stamp_ns < stamp_ns
        return awaited

    @property
    def lacks_image(self) -> bool:
        """An image that was told of has not come."""
        return any(frame.image is None for frame in self._told)

    @property
    def informed(self) -> bool:
        """True once an info has come."""
        return self._last_info_ns >= 0

    def take(self, infos_expected: bool) -> list[ArrivedFrame]:
        """The frames that need not wait any longer, in order."""
        ready = []
        while self._told or self._early:
            queue = min((q for q in (self._told, self._early) if q), key=lambda q: q[0].stamp_ns)
            frame = queue[0]
            complete = frame.image is not None and (frame.info is not None or not infos_expected)
            if not (complete or frame.alone or self._waited(frame) >= self._patience):
                break
            queue.popleft()
            if frame.image is not None:
                ready.append(ArrivedFrame(frame.image, frame.info, frame.arrival_ns))
        return ready

    def _waited(self, frame: _Frame) -> int:
        """Ticks; for an info while none comes."""
        return self._ticks - (max(frame.since, self._ticks_at_info) if frame.info is None else frame.since)
