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

    Callbacks only ``put``. ``policy`` when ``capacity`` items wait: ``block`` until there is room, or
    ``drop_oldest`` and count it in ``dropped``. An exception of ``work`` ends the thread and is kept
    in ``failure``.
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
        self._items: deque[Item] = deque()
        self._changed = threading.Condition()
        self._busy = self._ending = False
        self._thread = threading.Thread(target=self._run, name="worker", daemon=True)
        self._thread.start()

    def __len__(self) -> int:
        return len(self._items)

    def put(self, item: Item) -> None:
        """Append ``item``, see ``policy``; ignored once the worker has ended."""
        with self._changed:
            if self._policy == "drop_oldest" and len(self._items) >= self._capacity:
                self._items.popleft()
                self.dropped += 1
            while len(self._items) >= self._capacity and not self._ending:
                self._changed.wait()
            if not self._ending:
                self._items.append(item)
                self._changed.notify_all()

    def end(self, timeout: float = DRAIN_TIMEOUT) -> int:
        """Let the worker finish what is queued, for ``timeout`` s at most; returns how many items it left."""
        with self._changed:
            self._changed.wait_for(lambda: self._ending or not (self._items or self._busy), timeout)
            left = len(self._items) + self._busy
            self._ending = True
            self._items.clear()
            self._changed.notify_all()
        self._thread.join(timeout=1.0)
        return left

    def _run(self) -> None:
        try:
            while True:
                with self._changed:
                    self._changed.wait_for(lambda: self._items or self._ending)
                    if self._ending:
                        return
                    item = self._items.popleft()
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
