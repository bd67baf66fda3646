"""The scale of a stage, as the beads that it carried show it.

    stated = t + w(t)

t is where the beads show the stage to be and w a curve common to all of them: a cubic B-spline with a knot
to every plane and a penalty on its second differences (Eilers & Marx, Stat. Sci. 11, 89, 1996), of the weight
that predicts beads left out best. Every bead's own height is free. This is a property of a stage in one scan,
not of the optics, and no part of a calibration.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline

from mems6dof_ros.calibration.field_curves import Array

#: Weights of the penalty to choose from, in units of the mean weight of a coefficient in the data.
_PENALTIES = np.logspace(-4, 4, 9)
_DEGREE = 3
_RIDGE = 1e-9


@dataclass(frozen=True)
class BeadScan:
    """One bead in n planes: ``seen`` m, where it shows the stage to be; ``error`` m, stated minus seen;
    its ``variance`` m^2; ``judged``: planes that count in the choice of the penalty."""

    seen: Array
    error: Array
    variance: Array
    judged: NDArray[np.bool_]


@dataclass(frozen=True)
class StageScale:
    """The curve w: B-spline ``coefficients``, knots every ``step`` m from ``start`` m on, constant beyond."""

    start: float
    step: float
    coefficients: Array

    def design(self, seen: Array) -> Array:
        """B-splines (n, coefficients) at ``seen`` (n,) m."""
        count = len(self.coefficients)
        knots = self.start + self.step * np.arange(-_DEGREE, count + 1)
        inside = np.clip(seen, self.start, knots[count] - 1e-6 * self.step)
        return np.asarray(BSpline.design_matrix(inside, knots, _DEGREE).toarray())

    def remaining(self, scan: BeadScan) -> Array:
        """What the scale leaves of the bead's error in the planes judged, about its mean (n,) m."""
        if not scan.judged.any():
            return np.empty(0)
        left = (scan.error - self.design(scan.seen) @ self.coefficients)[scan.judged]
        return np.asarray(left - np.mean(left))


def stage_scale(scans: Sequence[BeadScan], step: float) -> StageScale:
    """The scale that two or more ``scans`` with planes judged, of one stage of ``step`` m, have in common."""
    scans = [scan for scan in scans if scan.judged.any()]
    seen = np.concatenate([scan.seen for scan in scans])
    count = int(np.ceil(np.ptp(seen) / step)) + _DEGREE
    flat = StageScale(float(seen.min()), step, np.zeros(count))

    def left_out(penalty: float) -> float:
        remaining = [
            _fit(flat, [*scans[:k], *scans[k + 1 :]], penalty).remaining(scan) for k, scan in enumerate(scans)
        ]
        return float(np.mean(np.concatenate(remaining) ** 2))

    return _fit(flat, scans, min(_PENALTIES, key=left_out))


def _fit(scale: StageScale, scans: Sequence[BeadScan], penalty: float) -> StageScale:
    """``scale`` with the coefficients that ``scans`` give it, the beads' own heights free."""
    bead = np.repeat(np.arange(len(scans)), [len(scan.seen) for scan in scans])
    splines = scale.design(np.concatenate([scan.seen for scan in scans]))
    weight = 1 / np.concatenate([scan.variance for scan in scans])
    design = np.column_stack([splines, np.eye(len(scans))[bead]])
    normal = (design.T * weight) @ design
    count = splines.shape[1]
    usual = np.trace(normal[:count, :count]) / count
    bends = np.diff(np.eye(count), 2, axis=0)
    normal[:count, :count] += penalty * usual * bends.T @ bends
    # A constant belongs to the scale or to the heights: the ridge decides without changing their sum.
    normal += _RIDGE * usual * np.eye(len(normal))
    right = (design.T * weight) @ np.concatenate([scan.error for scan in scans])
    return replace(scale, coefficients=np.linalg.solve(normal, right)[:count])
