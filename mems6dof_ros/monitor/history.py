"""Every cycle the page can still show, as one bounded table of numbers."""

from __future__ import annotations

import math
import threading
from dataclasses import fields

import numpy as np
from numpy.typing import NDArray

from mems6dof_ros.localization.localizations import Latency
from mems6dof_ros.pose.cycle_pose import DEGREES_OF_FREEDOM, CyclePose

LATENCY_STAGES = tuple(f"latency_{stage.name}" for stage in fields(Latency))

#: Columns of the table and their SI units ("" for counts and codes), in the order of ``pose_row``.
COLUMNS: dict[str, str] = {
    "body": "",
    "cycle": "",
    "frame_counter": "",
    "stamp": "s",
    "status": "",
    "reference_version": "",
    **{name: "m" if name in ("dx", "dy", "dz") else "rad" for name in DEGREES_OF_FREEDOM},
    **{f"sd_{name}": "m" if name in ("dx", "dy", "dz") else "rad" for name in DEGREES_OF_FREEDOM},
    "rotation_per_cycle": "rad",
    "sd_rotation_per_cycle": "rad",
    "beta": "rad",
    "alpha": "rad",
    "residual_rms_xy": "m",
    "residual_rms_z": "m",
    "chi_square": "1",
    "particles_used": "",
    "particles_seen": "",
    "particles_expected": "",
    **dict.fromkeys(LATENCY_STAGES, "s"),
    **{f"true_{name}": "m" if name in ("dx", "dy", "dz") else "rad" for name in DEGREES_OF_FREEDOM},
}


def pose_row(pose: CyclePose, body: int, truth: NDArray[np.float64] | None = None) -> NDArray[np.float64]:
    """One row of the table, SI units, NaN where unknown.

    ``body`` is the number that stands for ``pose.body``; ``truth`` (6,) the true displacement in the
    order of DEGREES_OF_FREEDOM. The rotation per cycle is the increment over the cycles it spans.
    """
    increment, sd_increment = math.nan, math.nan
    if pose.increment_cycles:
        increment = pose.increment[5] / pose.increment_cycles
        sd_increment = _sd(pose.increment_covariance)[5] / pose.increment_cycles
    angles = pose.angles
    return np.array(
        [
            body,
            pose.cycle,
            pose.frame_counter,
            pose.stamp_ns * 1e-9,
            pose.status,
            pose.reference_version,
            *pose.displacement,
            *_sd(pose.displacement_covariance),
            increment,
            sd_increment,
            angles.beta if angles.beta_valid else math.nan,
            angles.alpha if angles.alpha_valid else math.nan,
            pose.residual_rms_xy,
            pose.residual_rms_z,
            pose.chi_square,
            pose.particles_used,
            pose.particles_seen,
            pose.particles_expected,
            *(getattr(pose.latency, stage.name) for stage in fields(Latency)),
            *(np.full(6, math.nan) if truth is None else truth),
        ]
    )


def _sd(covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    with np.errstate(invalid="ignore"):
        return np.sqrt(np.diagonal(covariance))


class History:
    """The last ``capacity`` rows, numbered from 0 on; written by one thread, read by others.

    ``epoch`` counts how often it was cleared, so that a reader knows to forget what it had.
    """

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity
        self.epoch = 0
        # Filled, so that all memory it will ever take is taken now.
        self._rows = np.full((capacity, len(COLUMNS)), math.nan)
        self._first = 0
        self._end = 0
        self._lock = threading.Lock()

    def append(self, row: NDArray[np.float64]) -> None:
        """Add one row; the oldest goes where the table is full."""
        with self._lock:
            self._rows[self._end % self.capacity] = row
            self._end += 1
            self._first = max(self._first, self._end - self.capacity)

    def clear(self) -> None:
        """Forget all rows and begin a new epoch; the numbering goes on."""
        with self._lock:
            self._first = self._end
            self.epoch += 1

    def since(self, number: int, limit: int) -> tuple[int, int, NDArray[np.float64]]:
        """Rows from ``number`` on, at most ``limit``: (epoch, number to ask for next, rows).

        Rows that are gone are skipped.
        """
        with self._lock:
            start = max(number, self._first)
            stop = min(self._end, start + limit)
            return self.epoch, stop, self._rows[np.arange(start, stop) % self.capacity]
