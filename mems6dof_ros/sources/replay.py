"""A recording from somewhere in it, once or over and over, without ever going back in time."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

from mems6dof_ros.errors import Mems6dofError
from mems6dof_ros.frame import Frame
from mems6dof_ros.sources.source import FrameSource, SourceInfo

#: Between rounds of a single frame, ns.
_PAUSE_NS = 100_000_000


class _Place(NamedTuple):
    """Of a frame in time, or a step from one to another."""

    stamp_ns: int
    frame_counter: int
    cycle: int


class Replay:
    """FrameSource of the frames of ``source`` from ``begin`` s after its first stamp on, with ``loop`` again
    and again.

    The first round has the stamps, frame counters and cycles of the recording. Every later one, also after
    another ``start``, follows the one before at the mean interval of its frames where it would go back: all
    that follow frames by stamp or by cycle need both to ascend. At the seam the motion jumps, not time.
    """

    def __init__(self, source: FrameSource, *, begin: float = 0.0, loop: bool = False) -> None:
        self.source = source
        self.rounds = 0  # that have begun
        self._begin, self._loop = begin, loop
        self._last: _Place | None = None  # of the latest frame of all rounds
        self._interval_ns = _PAUSE_NS  # mean of the latest round

    @property
    def info(self) -> SourceInfo:
        """Of the source; ``frames`` includes those before ``begin``."""
        return replace(self.source.info, frames=None) if self._loop else self.source.info

    def start(self) -> None:
        self.source.start()
        self.rounds += 1
        self._zero_ns: int | None = None  # stamp of the round's first frame in the recording
        self._step = _Place(0, 0, 0)
        self._delivered = self._duration_ns = 0  # of this round

    def read(self, timeout: float | None = None) -> Frame | None:
        """As FrameSource.read; Mems6dofError where the recording is over before ``begin``."""
        while True:
            while (frame := self.source.read(timeout)) is not None:
                if self._zero_ns is None:
                    self._zero_ns = frame.stamp_ns
                if frame.stamp_ns - self._zero_ns >= self._begin * 1e9:
                    return self._deliver(frame)
            if self._delivered == 0 and self._begin > 0:
                raise Mems6dofError(f"nothing to replay: the recording ends before {self._begin:g} s")
            if self._delivered == 0 or not self._loop:
                return None
            self.start()

    def stop(self) -> None:
        self.source.stop()

    def _deliver(self, frame: Frame) -> Frame:
        if self._delivered == 0 and self._last is not None:
            self._step = self._steps(frame, self._last)
            frame = replace(frame, frames_dropped=0)  # before the recording
        place = _Place(
            frame.stamp_ns + self._step.stamp_ns,
            frame.frame_counter + self._step.frame_counter,
            frame.cycle + self._step.cycle,
        )
        if self._delivered and self._last is not None:
            self._duration_ns += place.stamp_ns - self._last.stamp_ns
            self._interval_ns = max(self._duration_ns // self._delivered, 1)
        self._delivered += 1
        self._last = place
        return replace(frame, **place._asdict())

    def _steps(self, first: Frame, last: _Place) -> _Place:
        """What must be added to a round that begins with ``first`` to follow ``last``."""
        back = first.stamp_ns <= last.stamp_ns
        return _Place(
            last.stamp_ns + self._interval_ns - first.stamp_ns if back else 0,
            max(last.frame_counter + 1 - first.frame_counter, 0),
            max(last.cycle + 1 - first.cycle, 0),
        )
