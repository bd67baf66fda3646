"""Which localization is which particle: iterative closest point and the global match.

Both work in the image plane on a rotation and two translations: tilts of milliradians move nothing
sideways that matters for identity. Both are verified against chance: the number of agreements is
accepted only where random points would almost never produce it (a contrario, Moisan and Stival 2004).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.special import betainc, gammaln

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


#: Pairs of localizations tried before a constellation counts as not found.
PAIRS = 400


class PlaneMotion(NamedTuple):
    """Rotation by ``angle`` rad about the origin, then translation ``shift`` (2,) m."""

    angle: float
    shift: Array

    def apply(self, points: Array) -> Array:
        """``points`` (n, 2) m after the motion."""
        c, s = math.cos(self.angle), math.sin(self.angle)
        return points @ np.array([[c, s], [-s, c]]) + self.shift


def closest_points(
    predicted: Array, measured: Array, gates: Array, identity_gate: float
) -> tuple[PlaneMotion, Indices]:
    """Iterative closest point with annealed gates.

    ``predicted`` (m, 2) m: particles at the predicted pose; ``measured`` (n, 2) m; ``gates`` m,
    descending. Pairs are mutual nearest neighbours within the gate, so that one missing or spurious
    particle cannot force a wrong pair. Returns the motion that takes ``predicted`` onto ``measured`` and, for
    each localization, the index of its particle within ``identity_gate`` m after that motion, or -1.
    """
    angle, x, y, match = _closest_points(
        np.ascontiguousarray(predicted),
        np.ascontiguousarray(measured),
        np.asarray(gates, float),
        identity_gate,
    )
    return PlaneMotion(angle, np.array([x, y])), match


def log10_false_alarms(inliers: int, points: int, chance: float, tests: float) -> float:
    """log10 of the number of chance matches as good as this one that ``tests`` hypotheses would give.

    ``inliers`` of ``points`` localizations agree; each would do so by chance with probability ``chance``.
    Two points fix the motion and prove nothing. Binomial tail through the incomplete beta function.
    """
    k, n = inliers - 2, points - 2
    if k <= 0:
        return math.inf
    tail = betainc(k, n - k + 1, chance)
    if tail > 0:
        return math.log10(tests) + math.log10(tail)
    log_tail = gammaln(n + 1) - gammaln(k + 1) - gammaln(n - k + 1) + k * math.log(chance)
    return math.log10(tests) + log_tail / math.log(10)


class GlobalMatch(NamedTuple):
    """Best motion of a global search, its agreements, and the hypotheses it took."""

    motion: PlaneMotion
    inliers: int
    tests: int


class ConstellationIndex:
    """Pair distances of a constellation (n, 2) m, sorted: the table of the global match."""

    def __init__(self, points: Array) -> None:
        self.points = np.ascontiguousarray(points)
        first, second = np.triu_indices(len(points), 1)
        distance = np.hypot(*(points[first] - points[second]).T)
        order = np.argsort(distance)
        self.distance = distance[order]
        self.first, self.second = first[order], second[order]

    def search(self, measured: Array, tolerance: float, gate: float, enough: int) -> GlobalMatch:
        """Motion of the constellation that most of ``measured`` (n, 2) m agree with, any rotation.

        Every pair of localizations whose distance occurs in the constellation within ``tolerance`` m is
        a hypothesis; a localization agrees when a particle lies within ``gate`` m. Stops at ``enough``
        agreements. Deterministic: the pairs are drawn from a fixed sequence.
        """
        if len(self.points) < 3 or len(measured) < 3:
            return GlobalMatch(PlaneMotion(0.0, np.zeros(2)), 0, 1)
        angle, x, y, inliers, tests = _search(
            self.points, self.distance, self.first, self.second, np.ascontiguousarray(measured),
            *self._pairs(measured), tolerance, gate, enough,
        )  # fmt: skip
        return GlobalMatch(PlaneMotion(angle, np.array([x, y])), inliers, max(tests, 1))

    def _pairs(self, measured: Array) -> tuple[Indices, Indices]:
        """Pairs of localizations to try: all of a few, else long ones at random, since short ones give a
        poor angle and the longest are not in the constellation."""
        n = len(measured)
        if n * (n - 1) // 2 <= PAIRS:
            one, other = np.triu_indices(n, 1)
            return one, other
        one, other = np.random.default_rng(0).integers(0, n, (2, 5 * PAIRS))
        length = np.hypot(*(measured[one] - measured[other]).T)
        usable = np.flatnonzero((length > 0.15 * self.distance[-1]) & (length < self.distance[-1]))[:PAIRS]
        return one[usable], other[usable]


@njit(cache=True, nogil=True)
def _mutual_neighbours(moved, measured, gate, match, nearest, distance):  # type: ignore[no-untyped-def]
    """Mutual nearest neighbours within ``gate`` into ``match`` (n,); the other arrays are scratch (m,)."""
    for j in range(len(moved)):
        distance[j] = gate * gate
        nearest[j] = -1
    for i in range(len(measured)):
        best, index = gate * gate, -1
        u, v = measured[i, 0], measured[i, 1]
        for j in range(len(moved)):
            dx = u - moved[j, 0]
            if abs(dx) > gate:
                continue
            dy = v - moved[j, 1]
            d = dx * dx + dy * dy
            if d < best:
                best, index = d, j
            if d < distance[j]:
                distance[j] = d
                nearest[j] = i
        match[i] = index
    for i in range(len(measured)):
        if match[i] >= 0 and nearest[match[i]] != i:
            match[i] = -1


@njit(cache=True, nogil=True)
def _closest_points(predicted, measured, gates, identity_gate):  # type: ignore[no-untyped-def]
    m, n = len(predicted), len(measured)
    moved = predicted.copy()
    match, previous = np.full(n, -1, np.int64), np.full(n, -1, np.int64)
    nearest, distance = np.empty(m, np.int64), np.empty(m)
    angle = x = y = 0.0
    for gate in gates:
        for _ in range(8):
            _mutual_neighbours(moved, measured, gate, match, nearest, distance)
            if (match == previous).all():
                break
            previous[:] = match
            count = 0
            px = py = qx = qy = 0.0
            for i in range(n):
                j = match[i]
                if j >= 0:
                    count += 1
                    px += predicted[j, 0]
                    py += predicted[j, 1]
                    qx += measured[i, 0]
                    qy += measured[i, 1]
            if count < 2:
                break
            px, py, qx, qy = px / count, py / count, qx / count, qy / count
            dot = cross = 0.0
            for i in range(n):
                j = match[i]
                if j >= 0:
                    ax, ay = predicted[j, 0] - px, predicted[j, 1] - py
                    bx, by = measured[i, 0] - qx, measured[i, 1] - qy
                    dot += ax * bx + ay * by
                    cross += ax * by - ay * bx
            angle = math.atan2(cross, dot)
            c, s = math.cos(angle), math.sin(angle)
            x, y = qx - c * px + s * py, qy - s * px - c * py
            for j in range(m):
                moved[j, 0] = c * predicted[j, 0] - s * predicted[j, 1] + x
                moved[j, 1] = s * predicted[j, 0] + c * predicted[j, 1] + y
    _mutual_neighbours(moved, measured, identity_gate, match, nearest, distance)
    return angle, x, y, match


@njit(cache=True, nogil=True)
def _search(  # type: ignore[no-untyped-def]
    points, distance, first, second, measured, one, other, tolerance, gate, enough
):
    first_look, first_needed = 24, 3
    m, n = len(points), len(measured)
    # Particles in square cells, as linked lists: a lookup costs a few comparisons.
    low_x, low_y = points[:, 0].min() - gate, points[:, 1].min() - gate
    span = max(points[:, 0].max() - low_x, points[:, 1].max() - low_y) + gate
    cells = 64
    size = max(span / cells, 2 * gate)
    cells = int(span / size) + 1
    head = np.full((cells, cells), -1, np.int64)
    following = np.full(m, -1, np.int64)
    for j in range(m):
        a, b = int((points[j, 0] - low_x) / size), int((points[j, 1] - low_y) / size)
        following[j] = head[a, b]
        head[a, b] = j

    best, best_angle, best_x, best_y, tests = 0, 0.0, 0.0, 0.0, 0
    for i, j in zip(one, other):  # noqa: B905 (numba knows no strict)
        bx, by = measured[j, 0] - measured[i, 0], measured[j, 1] - measured[i, 1]
        length = math.sqrt(bx * bx + by * by)
        k = np.searchsorted(distance, length - tolerance)
        while k < len(distance) and distance[k] <= length + tolerance:
            for swap in range(2):
                p, q = (first[k], second[k]) if swap == 0 else (second[k], first[k])
                ax, ay = points[q, 0] - points[p, 0], points[q, 1] - points[p, 1]
                angle = math.atan2(ax * by - ay * bx, ax * bx + ay * by)
                c, s = math.cos(angle), math.sin(angle)
                # The midpoints coincide: half the error of either end.
                mx, my = 0.5 * (points[p, 0] + points[q, 0]), 0.5 * (points[p, 1] + points[q, 1])
                x = 0.5 * (measured[i, 0] + measured[j, 0]) - c * mx + s * my
                y = 0.5 * (measured[i, 1] + measured[j, 1]) - s * mx - c * my
                tests += 1
                inliers = 0
                for step in range(n):
                    if step == first_look and inliers < first_needed:
                        break  # a true motion would have shown itself
                    r = (step + i) % n
                    ux, uy = measured[r, 0] - x, measured[r, 1] - y
                    vx, vy = c * ux + s * uy, c * uy - s * ux
                    a0, a1 = (
                        math.floor((vx - gate - low_x) / size),
                        math.floor((vx + gate - low_x) / size),
                    )
                    b0, b1 = (
                        math.floor((vy - gate - low_y) / size),
                        math.floor((vy + gate - low_y) / size),
                    )
                    found = False
                    for a in range(max(a0, 0), min(a1, cells - 1) + 1):
                        for b in range(max(b0, 0), min(b1, cells - 1) + 1):
                            node = head[a, b]
                            while node >= 0 and not found:
                                ex, ey = points[node, 0] - vx, points[node, 1] - vy
                                found = ex * ex + ey * ey < gate * gate
                                node = following[node]
                    if found:
                        inliers += 1
                if inliers > best:
                    best, best_angle, best_x, best_y = inliers, angle, x, y
                    if best >= enough:
                        return best_angle, best_x, best_y, best, tests
            k += 1
    return best_angle, best_x, best_y, best, tests
