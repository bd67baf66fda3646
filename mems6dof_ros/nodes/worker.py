"""A bounded queue and the thread that empties it."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from typing import Generic, Literal, TypeVar

Item = TypeVar("Item")

#: Seconds that the end of a node may take: for what is queued, then for what readers have not yet taken.
DRAIN_TIMEOUT = 3.0


class Worker(Generic[Item]):
    """A thread that takes items out of a bounded queue and calls ``work`` with each.

    Callbacks only ``put``. ``policy`` when the items that wait would exceed ``capacity``, in the unit of
    their sizes: ``block`` until there is room, or ``drop_oldest`` and count them in ``dropped``. An
    exception of ``work`` ends the thread and is kept in ``failure``.
    """

    def __init__(
        self,
        work: Callable[[Item], None],
        capacity: int,
        policy: Literal["block", "drop_oldest"] = "block",
    ) -> None:
        self.dropped = 0
        self.failure: BaseException | None = None
        self._work, self._capacity, self._policy = work, capacity, policy
        self._items: deque[tuple[Item, int]] = deque()
        self._waiting = 0  # sizes of the items
        self._changed = threading.Condition()
        self._busy = self._ending = False
        self._thread = threading.Thread(target=self._run, name="worker", daemon=True)
        self._thread.start()

    def __len__(self) -> int:
        return len(self._items)

    @property
    def fill(self) -> float:
        """Fraction of the capacity that is taken."""
        return self._waiting / self._capacity

    def put(self, item: Item, size: int = 1, share: float = 1.0) -> None:
        """Append ``item``, see ``policy``; ignored once the worker has ended.

        An item greater than the capacity waits, or goes, alone. What may fill but a ``share`` of the capacity
        is itself dropped beyond it: it pushes nothing else out.
        """
        with self._changed:
            while self._items and self._waiting + size > share * self._capacity and not self._ending:
                if self._policy == "block":
                    self._changed.wait()
                    continue
                self.dropped += 1
                if share < 1:
                    return
                self._take()
            if not self._ending:
                self._items.append((item, size))
                self._waiting += size
                self._changed.notify_all()

    def end(self, timeout: float | None = DRAIN_TIMEOUT) -> int:
        """Let the worker finish what is queued, for ``timeout`` s at most, None: however long it takes;
        returns how many items it left."""
        with self._changed:
            self._changed.wait_for(lambda: self._ending or not (self._items or self._busy), timeout)
            left = len(self._items) + self._busy
            self._ending = True
            self._items.clear()
            self._changed.notify_all()
        self._thread.join(timeout=1.0)
        return left

    def _take(self) -> Item:
        item, size = self._items.popleft()
        self._waiting -= size
        return item

    def _run(self) -> None:
        try:
            while True:
                with self._changed:
                    self._changed.wait_for(lambda: self._items or self._ending)
                    if self._ending:
                        return
                    item = self._take()
                    self._busy = True
                    self._changed.notify_all()
                self._work(item)
                with self._changed:
                    self._busy = False
                    self._changed.notify_all()
        except BaseException as error:  # handed to the main thread, which ends the node
            with self._changed:
                self.failure = error
                self._ending, self._busy = True, False
                self._changed.notify_all()
