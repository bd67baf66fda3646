"""What a node tells of itself once per second, on /diagnostics."""

from __future__ import annotations

import math
import statistics
import threading
import time
from collections import defaultdict
from collections.abc import Callable
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock, ClockType
from rclpy.node import Node

from mems6dof_ros.nodes import transport


class Health:
    """Counts and times of a node, published on /diagnostics once per second; safe for any thread.

    The level is WARN while something was lost, ERROR while something was refused, in the last second; ERROR
    as long as ``failure`` says what keeps the node from its work, WARN as long as something that is watched
    has a concern, and STALE when an active node that had ``worked`` has not for STALE_AFTER.
    """

    PERIOD = 1.0  # s
    STALE_AFTER = 5.0  # s
    MOST_LINES = 10  # that are logged of the problems of one period

    def __init__(self, node: Node) -> None:
        self.lifecycle = "unconfigured"  # label of the state of a managed node
        self.state = ""  # what it does there
        self.failure = ""  # what keeps it from that until somebody helps
        self._node = node
        self._lock = threading.Lock()
        self._totals: dict[str, int] = defaultdict(int)
        self._reported: dict[str, int] = {}
        self._times: dict[str, list[float]] = defaultdict(list)
        self._values: dict[str, str] = {}
        self._problems: list[tuple[bytes, str]] = []
        self._gauges: dict[str, Callable[[], Any]] = {}
        self._watched: dict[str, Callable[[], str]] = {}
        self._worked = math.inf  # monotonic s; infinite: not since it became active
        self._since = time.monotonic()
        self._publisher = node.create_publisher(DiagnosticArray, "/diagnostics", transport.MESSAGES)
        # Wall time: with use_sim_time and no clock, diagnostics must still say so.
        node.create_timer(self.PERIOD, self.publish, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def count(self, what: str, number: int = 1) -> None:
        """Add to a total, reported with its rate."""
        with self._lock:
            self._totals[what] += number

    def total(self, what: str) -> int:
        """A total so far."""
        with self._lock:
            return self._totals[what]

    def time(self, what: str, seconds: float) -> None:
        """Add a duration in s, reported as median and maximum of the period in ms."""
        with self._lock:
            self._times[what].append(seconds)

    def set(self, what: str, value: Any) -> None:
        """Note the latest value of something."""
        with self._lock:
            self._values[what] = str(value)

    def gauge(self, what: str, read: Callable[[], Any]) -> None:
        """Have ``read`` called for every report."""
        self._gauges[what] = read

    def watch(self, what: str, concern: Callable[[], str]) -> None:
        """Have ``concern`` called for every report; it says why to worry about ``what``, or nothing."""
        self._watched[what] = concern

    def worked(self) -> None:
        """The node has done what it is there for, and is expected to go on."""
        self._worked = time.monotonic()

    def entered(self, lifecycle: str) -> None:
        """The node has changed to the state with this label."""
        self.lifecycle, self._worked = lifecycle, math.inf
        if lifecycle != "active":  # what was true then
            self.state = ""

    def lost(self, number: int, why: str) -> None:
        """Something was lost: count it and warn."""
        self._problem(DiagnosticStatus.WARN, "lost", number, why)

    def refused(self, why: str) -> None:
        """Input that could not be used: count it and report an error."""
        self._problem(DiagnosticStatus.ERROR, "refused", 1, why)

    def _problem(self, level: bytes, what: str, number: int, why: str) -> None:
        with self._lock:
            self._totals[what] += number
            self._problems.append((level, why))
            if len(self._problems) > self.MOST_LINES:
                return
        log = self._node.get_logger()
        if level == DiagnosticStatus.ERROR:
            log.error(why)
        else:
            log.warning(why)

    def publish(self) -> None:
        """Publish the report of the time since the last one."""
        now = time.monotonic()
        with self._lock:
            span, self._since = now - self._since, now
            values = {what: str(total) for what, total in self._totals.items()}
            for what, total in self._totals.items():
                values[f"{what}, 1/s"] = f"{(total - self._reported.get(what, 0)) / span:.1f}"
            self._reported = dict(self._totals)
            for what, times in self._times.items():
                if times:
                    values[f"{what}, ms, median"] = f"{statistics.median(times) * 1e3:.2f}"
                    values[f"{what}, ms, max"] = f"{max(times) * 1e3:.2f}"
                times.clear()
            values.update(self._values)
            problems, self._problems = self._problems, []
        if (more := len(problems) - self.MOST_LINES) > 0:
            self._node.get_logger().warning(f"and {more} more problems in the last second")
        values.update({what: str(read()) for what, read in self._gauges.items()})
        values["lifecycle"] = self.lifecycle
        state = f"{self.lifecycle}: {self.state}" if self.state else self.lifecycle
        problems += [(DiagnosticStatus.WARN, text) for read in self._watched.values() if (text := read())]
        if self.failure:
            problems = [(DiagnosticStatus.ERROR, self.failure)]
        if not problems and (idle := now - self._worked) > self.STALE_AFTER:
            problems = [(DiagnosticStatus.STALE, f"nothing to do for {idle:.0f} s; {state}")]
        level, message = max(problems, default=(DiagnosticStatus.OK, state), key=lambda p: p[0])
        status = DiagnosticStatus(
            level=level,
            name=self._node.get_fully_qualified_name().lstrip("/"),
            message=message,
            values=[KeyValue(key=key, value=value) for key, value in sorted(values.items())],
        )
        array = DiagnosticArray(status=[status])
        array.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(array)
