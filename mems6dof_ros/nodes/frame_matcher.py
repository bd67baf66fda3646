"""Image and frame_info come on two topics; this makes pairs of them."""

from __future__ import annotations

from collections import OrderedDict, deque
from typing import Any, NamedTuple


class ArrivedFrame(NamedTuple):
    """An Image with its FrameInfo, None where there is none; ``arrival_ns`` of the image, host clock."""

    image: Any
    info: Any
    arrival_ns: int


class FrameMatcher:
    """Pairs images with frame infos by their stamps in ns, and keeps the order of the images.

    Infos come in order. An image that arrives before its info waits for it only while somebody publishes
    infos, until a later one has come, or until no info has come for ``patience`` ticks: ticks of the
    callbacks' own timer, so that time in which no callback could run does not count.
    """

    def __init__(self, patience: int = 10, capacity: int = 256) -> None:
        self._patience, self._capacity = patience, capacity
        self._infos: OrderedDict[int, Any] = OrderedDict()
        self._last_info_ns = -1
        self._waiting: deque[tuple[int, int, ArrivedFrame]] = deque()
        self._ticks = self._ticks_at_info = 0

    def tick(self) -> None:
        """Time goes by."""
        self._ticks += 1

    def add_info(self, stamp_ns: int, info: Any) -> None:
        """An info has arrived; of those that nobody asked for only the latest are kept."""
        self._infos[stamp_ns] = info
        self._last_info_ns, self._ticks_at_info = stamp_ns, self._ticks
        if len(self._infos) > self._capacity:
            self._infos.popitem(last=False)

    def add_image(self, stamp_ns: int, image: Any, arrival_ns: int) -> None:
        """An image has arrived at ``arrival_ns``."""
        self._waiting.append((stamp_ns, self._ticks, ArrivedFrame(image, None, arrival_ns)))

    def has_image(self, stamp_ns: int) -> bool:
        """An image of that stamp waits."""
        return any(stamp_ns == waiting for waiting, _, _ in self._waiting)

    @property
    def lacks_last_image(self) -> bool:
        """The image that the last info told of has not come."""
        return self._last_info_ns in self._infos

    @property
    def informed(self) -> bool:
        """True once an info has come."""
        return self._last_info_ns >= 0

    def take(self, infos_expected: bool) -> list[ArrivedFrame]:
        """The frames that need not wait any longer, in the order of their images."""
        ready = []
        while self._waiting:
            stamp_ns, ticks, frame = self._waiting[0]
            waited = self._ticks - max(ticks, self._ticks_at_info)
            info = self._infos.pop(stamp_ns, None)
            if info is None and infos_expected and stamp_ns > self._last_info_ns and waited < self._patience:
                break
            self._waiting.popleft()
            ready.append(frame._replace(info=info))
        return ready
