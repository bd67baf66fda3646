"""From a camera's own clock to the host's, and how well that is known."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from itertools import pairwise

NAN = math.nan

#: Quartz clocks differ by less; a steeper line is noise of the arrivals.
_LARGEST_DRIFT = 5e-4


@dataclass
class _Bin:
    """Device and host time, ns, of the arrival that was quickest within a stretch of time."""

    index: int
    device: int
    host: int


class DeviceClock:
    """Line through the quickest arrivals: host = device + offset + drift * device.

    A message is late by what it meets on its way, never early: the truth lies on the lower envelope of
    (device, host - device), not in its middle. Of all lines below every point the one closest to them
    (least sum of vertical distances) is the edge of the lower convex hull beneath the mean device time
    (Zhang, Liu and Xia, Clock synchronization algorithms for network measurements, INFOCOM 2002). Only
    the quickest arrival of every ``bin_s`` is kept, for ``window_s``: a drift that wanders with
    temperature is followed, and the work stays the same.
    """

    def __init__(self, window_s: float = 60.0, bin_s: float = 0.25, settle_s: float = 5.0) -> None:
        self._bin_ns, self._settle_ns = int(bin_s * 1e9), settle_s * 1e9
        self._bins: deque[_Bin] = deque(maxlen=round(window_s / bin_s))
        self._origin = 0
        self._offset = 0.0
        self._drift = 0.0

    @property
    def drift(self) -> float:
        """Rate of the host's clock against the device's, minus 1."""
        return self._drift

    @property
    def uncertainty(self) -> float:
        """Standard uncertainty, s, of the envelope: median height of the bins' quickest arrivals above it.

        One bin's quickest arrival is off by that much, the line through many of them by less. What delays
        every message alike is not in it, for no arrival tells. NaN before the first second.
        """
        heights = sorted(self._height(b) for b in tuple(self._bins))  # asked by other threads
        return heights[len(heights) // 2] * 1e-9 if len(heights) >= 4 else NAN

    def add(self, device_ns: int, host_ns: int) -> None:
        """Take in that what happened at ``device_ns`` was noticed at ``host_ns``."""
        if not self._bins:
            self._origin, self._offset = device_ns, float(host_ns - device_ns)
        index = device_ns // self._bin_ns
        if not self._bins or index != self._bins[-1].index:
            self._bins.append(_Bin(index, device_ns, host_ns))
        elif host_ns - self.to_host(device_ns) < self._height(self._bins[-1]):
            self._bins[-1] = _Bin(index, device_ns, host_ns)
        else:
            return
        self._fit()

    def to_host(self, device_ns: int) -> int:
        """Host time, ns, of a moment on the device's clock."""
        return device_ns + round(self._offset + self._drift * (device_ns - self._origin))

    def _height(self, b: _Bin) -> float:
        return b.host - b.device - self._offset - self._drift * (b.device - self._origin)

    def _fit(self) -> None:
        points = [(b.device - self._origin, b.host - b.device) for b in self._bins]
        self._drift = 0.0
        if points[-1][0] - points[0][0] >= self._settle_ns:
            hull = _lower_hull(points)
            middle = sum(x for x, _ in points) / len(points)
            (x0, y0), (x1, y1) = next(edge for edge in pairwise(hull) if edge[1][0] >= middle)
            self._drift = min(max((y1 - y0) / (x1 - x0), -_LARGEST_DRIFT), _LARGEST_DRIFT)
        self._offset = min(y - self._drift * x for x, y in points)


def _lower_hull(points: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Lower convex hull of points that ascend in x (Andrew's monotone chain)."""
    hull: list[tuple[int, int]] = []
    for x, y in points:
        while len(hull) > 1 and (hull[-1][0] - hull[-2][0]) * (y - hull[-2][1]) <= (
            hull[-1][1] - hull[-2][1]
        ) * (x - hull[-2][0]):
            hull.pop()
        hull.append((x, y))
    return hull
