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

    An image waits for its info only while somebody publishes infos, for ``patience_ns`` at most, and
    not behind a later image that has its own.
    """

    def __init__(self, patience_ns: int = 200_000_000, capacity: int = 256) -> None:
        self._patience_ns, self._capacity = patience_ns, capacity
        self._infos: OrderedDict[int, Any] = OrderedDict()
        self._waiting: deque[tuple[int, Any, int]] = deque()

    def add_info(self, stamp_ns: int, info: Any) -> None:
        """An info has arrived; of those that nobody asked for only the latest are kept."""
        self._infos[stamp_ns] = info
        if len(self._infos) > self._capacity:
            self._infos.popitem(last=False)

    def add_image(self, stamp_ns: int, image: Any, arrival_ns: int) -> None:
        """An image has arrived at ``arrival_ns``."""
        self._waiting.append((stamp_ns, image, arrival_ns))

    def take(self, now_ns: int, infos_expected: bool) -> list[ArrivedFrame]:
        """The frames that need not wait any longer, in the order of their images."""
        known = [k for k, (stamp, _, _) in enumerate(self._waiting) if stamp in self._infos]
        late = [k for k, (_, _, arrival) in enumerate(self._waiting) if now_ns - arrival > self._patience_ns]
        number = max([*known, *late], default=-1) + 1 if infos_expected else len(self._waiting)
        ready = []
        for _ in range(number):
            stamp, image, arrival = self._waiting.popleft()
            ready.append(ArrivedFrame(image, self._infos.pop(stamp, None), arrival))
        return ready
