"""Constellation map: the particles of one body, refined cycle by cycle.

All positions and the smooth field error are estimated together in one information matrix, from which
the pose of every cycle is eliminated exactly (Schur complement): generalised Procrustes analysis with
covariances, in recursive form. Positions are linearised where a particle was first confirmed, which keeps
the six directions that no observation can fix (the gauge) free of false information
(Huang, Mourikis and Roumeliotis 2010); the founding cycle holds them.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.linalg.lapack import dpotri

from mems6dof_ros.pose.field import FieldModes
from mems6dof_ros.pose.rigid import RigidPose
from mems6dof_ros.pose.solve import pose_jacobian

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]

#: Prior sd of the correction of a position, m: only keeps the matrix regular.
WEAK_PRIOR = 10e-6
#: How much more stiffly than one observation the founding cycle holds the gauge.
GAUGE_STIFFNESS = 1e4
#: Evidence, in degrees of freedom, behind the assumption that a particle is as noisy as it claims.
NOISE_PRIOR = 20.0
#: Variance factor assumed of a particle with a neighbour, until its own residuals say better.
OVERLAP_FACTOR = 9.0
#: Outliers in a row that prove a particle is not where the map has it.
OUTLIERS_IN_A_ROW = 4
#: Largest interval between two refinements, cycles.
REFINE_AT_MOST = 64


class Constellation:
    """Particles of one body with the joint covariance of their positions and of the field error.

    ``ids`` (m,), ``position`` (m, 3) m in the map frame, ``covariance`` (m, 3, 3) m^2 given the field
    error, ``field_mean`` (k,) m, ``field_covariance`` (k, k) m^2 and its Cholesky ``field_factor``,
    ``coupling`` (m, 3, k): how the estimate of a position changes with the field error; all renewed by
    ``refine``. ``active`` (m,): False once retired.
    """

    def __init__(self, modes: FieldModes, field_prior: Array, retire_after: int, overlap: float) -> None:
        self.modes = modes
        self.retire_after, self.overlap = retire_after, overlap
        self.field_mean = np.zeros(len(modes))
        self.field_covariance = np.diag(field_prior)
        self.field_factor = np.diag(np.sqrt(field_prior))
        self.ids = np.empty(0, np.int64)
        self.active = np.empty(0, bool)
        self.position = np.empty((0, 3))
        self.covariance = np.empty((0, 3, 3))
        self.coupling = np.empty((0, 3, len(modes)))
        self.sightings = np.empty(0, np.int64)
        self.misses = np.empty(0, np.int64)
        self.outliers = np.empty((0, 2), np.int64)  # in a row: in x and y, in z
        self.cycles = 0
        self._squares = np.empty((0, 2))  # sums of squared normalised residuals, xy and z
        self._freedom = np.empty((0, 2))
        self._origin = np.empty((0, 3))  # linearisation points
        self._information = np.diag(1 / field_prior)  # lower triangle; field first, then particles
        self._vector = np.zeros(len(modes))
        self._refined_at = 0

    def __len__(self) -> int:
        return len(self.ids)

    def found(self, ids: Indices, position: Array, covariance: Array, modes: Array) -> None:
        """Start the map from one cycle, whose pose is the identity by definition: ``position`` (n, 3) m
        in the map frame, ``covariance`` (n, 3, 3) m^2, ``modes`` (n, 3, k) of the field at each place."""
        self.add(ids, position, covariance, -modes)
        weight = np.asarray(np.linalg.inv(covariance), float)
        rows = np.arange(len(ids))
        self.observe(rows, RigidPose(np.eye(3), np.zeros(3)), np.zeros_like(position), weight, modes)
        jacobian = pose_jacobian(position, np.eye(3))
        held = (weight @ jacobian).reshape(-1, 6)
        normal = np.einsum("nia,nib->ab", jacobian, weight @ jacobian)
        k = len(self.modes)
        self._information[k:, k:] += GAUGE_STIFFNESS * held @ np.linalg.solve(normal, held.T)
        self.refine()

    def add(self, ids: Indices, position: Array, covariance: Array, coupling: Array) -> None:
        """Add particles (n,) at ``position`` (n, 3) m, known to ``covariance`` until evidence comes in."""
        n, k, old = len(ids), len(self.modes), len(self._vector)
        self.ids = np.r_[self.ids, ids]
        self.active = np.r_[self.active, np.ones(n, bool)]
        self.position = np.r_[self.position, position]
        self.covariance = np.r_[self.covariance, covariance]
        self.coupling = np.r_[self.coupling, coupling]
        self.sightings = np.r_[self.sightings, np.ones(n, np.int64)]
        self.misses = np.r_[self.misses, np.zeros(n, np.int64)]
        self.outliers = np.r_[self.outliers, np.zeros((n, 2), np.int64)]
        self._origin = np.r_[self._origin, position]
        information = np.zeros((old + 3 * n, old + 3 * n))
        information[:old, :old] = self._information
        new = np.arange(old, old + 3 * n)
        information[new, new] = WEAK_PRIOR**-2
        self._information = information
        self._vector = np.r_[self._vector, np.zeros(3 * n)]
        near = self._has_neighbour()[-n:]
        prior = NOISE_PRIOR * np.where(near, OVERLAP_FACTOR, 1.0)
        self._squares = np.r_[self._squares, np.c_[prior, prior]]
        self._freedom = np.r_[self._freedom, np.full((n, 2), NOISE_PRIOR)]
        assert len(self._vector) == k + 3 * len(self)

    def observe(self, rows: Indices, pose: RigidPose, offset: Array, weight: Array, modes: Array) -> None:
        """Add one cycle's evidence on particles ``rows`` (n,) seen at ``pose``.

        ``offset`` (n, 3) m: measured minus the place of ``linearisation(rows)``, field error not removed;
        ``weight`` (n, 3, 3) m^-2: inverse covariance of the localizations alone; ``modes`` (n, 3, k).
        """
        jacobian = pose_jacobian(self._origin[rows], pose.rotation)
        normal = np.einsum("nia,nib->ab", jacobian, weight @ jacobian)
        _accumulate(
            self._information, self._vector, rows, pose.rotation, offset, weight, jacobian,
            np.linalg.inv(normal), modes,
        )  # fmt: skip
        self.cycles += 1

    def linearisation(self, rows: Indices) -> Array:
        """Fixed positions (n, 3) m that ``observe`` refers to."""
        return self._origin[rows]

    def noise_factor(self, rows: Indices) -> Array:
        """Variance factors (n, 2), xy and z, of particles against what their covariance claims:
        overlapping and unsteady ones count less."""
        return self._squares[rows] / self._freedom[rows]

    def count(self, seen: Indices, missed: Indices, rows: Indices, outlying: Mask) -> Indices:
        """Count one cycle's sightings and misses, and of ``rows`` (n,) where x and y, or z, were
        ``outlying`` (n, 2); retire what is gone or has moved on the body, and return those rows."""
        self.sightings[seen] += 1
        self.misses[seen] = 0
        self.misses[missed] += 1
        self.outliers[rows] = np.where(outlying, self.outliers[rows] + 1, 0)
        gone = self.misses >= np.minimum(self.retire_after, 2 + self.sightings)
        moved = (self.outliers >= OUTLIERS_IN_A_ROW).any(axis=1)
        retired = np.flatnonzero(self.active & (gone | moved))
        self.active[retired] = False
        return retired

    def learn_noise(self, rows: Indices, squares: Array, freedom: Array) -> None:
        """Add squared residuals (n, 2), normalised by the claimed covariance, with their degrees of
        freedom (n, 2); the memory is about 200 cycles."""
        self._squares[rows] += squares
        self._freedom[rows] += freedom
        long = np.maximum(1.0, self._freedom[rows] / 400.0)
        self._squares[rows] /= long
        self._freedom[rows] /= long

    @property
    def due(self) -> bool:
        """True when enough evidence has come in to make ``refine`` worth its time."""
        return self.cycles - self._refined_at >= min(REFINE_AT_MOST, max(1, self.cycles // 8))

    def refine(self) -> None:
        """Solve for all positions and the field error: milliseconds, hence not in every cycle."""
        self._forget_retired()
        k, n = len(self.modes), len(self)
        information = self._information
        scale = 1 / np.sqrt(np.diag(information))
        vector = self._vector * scale
        particles = information[k:, k:] * np.outer(scale[k:], scale[k:])
        cross = information[k:, :k] * np.outer(scale[k:], scale[:k])
        factor = cho_factor(particles, lower=True, overwrite_a=True, check_finite=False)
        # Positions given the field error; then the field error itself (Schur complement).
        gain = cho_solve(factor, np.c_[cross, vector[k:]], check_finite=False)
        field_information = information[:k, :k] * np.outer(scale[:k], scale[:k])
        field_information = np.tril(field_information) + np.tril(field_information, -1).T
        field_covariance = np.linalg.inv(field_information - cross.T @ gain[:, :k])
        field_mean = field_covariance @ (vector[:k] - cross.T @ gain[:, k])
        correction = (gain[:, k] - gain[:, :k] @ field_mean) * scale[k:]
        self.field_mean = field_mean * scale[:k]
        self.field_covariance = field_covariance * np.outer(scale[:k], scale[:k])
        self.field_factor = np.linalg.cholesky(self.field_covariance)
        self.coupling = -(gain[:, :k] * scale[k:, None] / scale[:k]).reshape(n, 3, k)
        self.position = self._origin + correction.reshape(n, 3)
        inverse, _ = dpotri(factor[0], lower=1)
        first = 3 * np.arange(n)
        for a in range(3):
            for b in range(a + 1):
                block = inverse[first + a, first + b] * scale[k + first + a] * scale[k + first + b]
                self.covariance[:, a, b] = self.covariance[:, b, a] = block
        self._refined_at = self.cycles

    def _forget_retired(self) -> None:
        """Eliminate retired particles from the information matrix: what they told stays."""
        if self.active.all():
            return
        k = len(self.modes)
        out = k + (3 * np.flatnonzero(~self.active)[:, None] + np.arange(3)).ravel()
        keep = np.r_[np.arange(k), k + (3 * np.flatnonzero(self.active)[:, None] + np.arange(3)).ravel()]
        full = np.tril(self._information) + np.tril(self._information, -1).T
        cross = full[np.ix_(out, keep)]
        gain = np.linalg.solve(full[np.ix_(out, out)], np.c_[cross, self._vector[out]])
        self._information = full[np.ix_(keep, keep)] - cross.T @ gain[:, :-1]
        self._vector = self._vector[keep] - cross.T @ gain[:, -1]
        for name in ("ids", "position", "covariance", "coupling", "sightings", "misses", "outliers"):
            setattr(self, name, getattr(self, name)[self.active])
        self._origin, self._squares = self._origin[self.active], self._squares[self.active]
        self._freedom = self._freedom[self.active]
        self.active = np.ones(len(self.ids), bool)

    def _has_neighbour(self) -> Mask:
        distance = np.hypot(*(self.position[:, None, :2] - self.position[None, :, :2]).transpose(2, 0, 1))
        np.fill_diagonal(distance, np.inf)
        return distance.min(axis=1, initial=np.inf) < self.overlap


class Candidates:
    """Places on the body where something was seen, not yet or no longer part of the map.

    ``ids`` (c,), ``position`` (c, 3) m, ``covariance`` (c, 3, 3) m^2 of one sighting, ``sightings``,
    ``misses`` (c,), ``former`` (c,): has been in the map, so it is remembered for its return.
    """

    MISSES = 2  # in a row, before a newcomer is forgotten
    FORMER_AT_MOST = 300

    def __init__(self) -> None:
        self.ids = np.empty(0, np.int64)
        self.position = np.empty((0, 3))
        self.covariance = np.empty((0, 3, 3))
        self.sightings = np.empty(0, np.int64)
        self.misses = np.empty(0, np.int64)
        self.former = np.empty(0, bool)

    def __len__(self) -> int:
        return len(self.ids)

    def add(self, ids: Indices, position: Array, covariance: Array, former: bool) -> None:
        """Add places: newcomers with one sighting, or ``former`` particles with none."""
        n = len(ids)
        self.ids = np.r_[self.ids, ids]
        self.position = np.r_[self.position, position]
        self.covariance = np.r_[self.covariance, covariance]
        self.sightings = np.r_[self.sightings, np.full(n, 0 if former else 1)]
        self.misses = np.r_[self.misses, np.zeros(n, np.int64)]
        self.former = np.r_[self.former, np.full(n, former)]

    def count(self, seen: Indices, position: Array, covariance: Array, missed: Mask) -> None:
        """Sightings of ``seen`` (s,) at ``position`` (s, 3) m, averaged, or begun anew where they
        disagree; ``missed`` (c,) should have been seen and were not."""
        n = self.sightings[seen]
        variance = np.diagonal(self.covariance[seen] + covariance, axis1=1, axis2=2)
        n = np.where(((position - self.position[seen]) ** 2 > 25 * variance).any(axis=1), 0, n)
        self.position[seen] = (self.position[seen] * n[:, None] + position) / (n + 1)[:, None]
        self.covariance[seen] = covariance
        self.sightings[seen] = n + 1
        self.misses[seen] = 0
        self.misses[missed] += 1
        self.sightings[self.former & (self.misses >= self.MISSES)] = 0
        self.keep(self.former | (self.misses < self.MISSES))
        surplus = np.flatnonzero(self.former)[: -self.FORMER_AT_MOST]
        if len(surplus):
            self.keep(~np.isin(np.arange(len(self)), surplus))

    def keep(self, mask: Mask) -> None:
        """Keep the places where ``mask`` (c,) is True."""
        for name in ("ids", "position", "covariance", "sightings", "misses", "former"):
            setattr(self, name, getattr(self, name)[mask])


@njit(cache=True, nogil=True)
def _accumulate(information, vector, rows, rotation, offset, weight, jacobian, inverse, modes):  # type: ignore[no-untyped-def]
    n, k = len(rows), modes.shape[2]
    evidence = np.empty((n, 3, 6))  # R^T W J
    gain = np.empty((n, 3, 6))  # R^T W J (J^T W J)^-1
    field = np.zeros((k, 6))  # F^T W J
    pull = np.zeros(6)  # J^T W r
    for i in range(n):
        wj = weight[i] @ jacobian[i]
        evidence[i] = rotation.T @ wj
        gain[i] = evidence[i] @ inverse
        pull += wj.T @ offset[i]
        if k:
            field += modes[i].T @ wj
    field_gain = field @ inverse
    for a in range(k):
        for c in range(6):
            vector[a] -= field_gain[a, c] * pull[c]
        for b in range(a + 1):
            total = 0.0
            for c in range(6):
                total += field_gain[a, c] * field[b, c]
            information[a, b] -= total
    for i in range(n):
        row = k + 3 * rows[i]
        turned = rotation.T @ weight[i]
        own = turned @ rotation
        wr = turned @ offset[i]
        for a in range(3):
            total = wr[a]
            for c in range(6):
                total -= gain[i, a, c] * pull[c]
            vector[row + a] += total
            for b in range(3):
                information[row + a, row + b] += own[a, b]
        for j in range(n):
            column = k + 3 * rows[j]
            if column > row:
                continue
            for a in range(3):
                for b in range(3):
                    total = 0.0
                    for c in range(6):
                        total += gain[i, a, c] * evidence[j, b, c]
                    information[row + a, column + b] -= total
        if k:
            wf = weight[i] @ modes[i]
            seen = rotation.T @ wf
            for m in range(k):
                for a in range(3):
                    total = seen[a, m]
                    for c in range(6):
                        total -= gain[i, a, c] * field[m, c]
                    information[row + a, m] += total
                for a in range(3):
                    vector[m] += wf[a, m] * offset[i, a]
            information[:k, :k] += modes[i].T @ wf
