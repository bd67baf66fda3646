"""Alarms on limits that the user sets, judged on every cycle and not only on those drawn."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from mems6dof_ros.errors import InputError
from mems6dof_ros.monitor.history import COLUMNS
from mems6dof_ros.pose.cycle_pose import DEGREES_OF_FREEDOM

#: What limits may be set on: columns of the history.
QUANTITIES = (
    *DEGREES_OF_FREEDOM,
    "rotation_per_cycle",
    "beta",
    "residual_rms_xy",
    "residual_rms_z",
    "chi_square",
    "particles_used",
    "latency_total",
)
#: An alarm ends when the value has been within its limits for so long, s: a value that swings across a
#: limit in every cycle is one alarm and not many.
HOLD = 2.0
_COLUMN = {name: index for index, name in enumerate(COLUMNS)}


@dataclass
class Limit:
    """Allowed range of one quantity, SI units, and how it has been kept.

    ``active``: a value of the last HOLD seconds was outside; ``count``: cycles outside since the limit
    was set.
    """

    quantity: str
    low: float
    high: float
    active: bool = False
    count: int = 0
    outside_at: float = -math.inf  # s, stamp of the last cycle outside

    def __post_init__(self) -> None:
        if self.quantity not in QUANTITIES:
            raise InputError("limit", f"quantity {self.quantity!r}", f"one of {', '.join(QUANTITIES)}")
        if not self.low <= self.high:
            raise InputError(f"limit on {self.quantity}", f"{self.low} to {self.high}", "low <= high")


@dataclass
class Alarms:
    """At most one limit per quantity."""

    limits: dict[str, Limit] = field(default_factory=dict)

    def set(self, limit: Limit) -> None:
        """Set, or replace, the limit of a quantity and start counting anew."""
        self.limits[limit.quantity] = limit

    def remove(self, quantity: str) -> None:
        """Drop the limit of a quantity, if there is one."""
        self.limits.pop(quantity, None)

    def judge(self, row: NDArray[np.float64]) -> list[tuple[Limit, float]]:
        """Limits that this row of the history has begun or ceased to violate, with its values.

        A NaN is no value and changes nothing: that tracking is lost is told elsewhere.
        """
        changed = []
        for limit in self.limits.values():
            value = float(row[_COLUMN[limit.quantity]])
            if math.isnan(value):
                continue
            outside = not limit.low <= value <= limit.high
            if outside:
                limit.count += 1
                limit.outside_at = float(row[_COLUMN["stamp"]])
            active = bool(outside or row[_COLUMN["stamp"]] - limit.outside_at < HOLD)
            if active != limit.active:
                limit.active = active
                changed.append((limit, value))
        return changed
