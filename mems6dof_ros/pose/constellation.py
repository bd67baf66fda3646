"""Constellation map: the particles of one body, refined cycle by cycle.

All positions and the smooth field error are estimated together in one information matrix, from which
the pose of every cycle is eliminated exactly (Schur complement): generalised Procrustes analysis with
covariances, in recursive form. Positions are linearised where a particle was first confirmed, which keeps
the six directions that no observation can fix (the gauge) free of false information
(Huang, Mourikis and Roumeliotis 2010); the founding cycle holds them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.linalg.blas import dsyrk
from scipy.linalg.lapack import dpotrf, dpotri, dpotrs

from mems6dof_ros.pose.field import FieldError
from mems6dof_ros.pose.rigid import RigidPose, exp_so3, hat, rotation_z
from mems6dof_ros.pose.solve import pose_jacobian, weights

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]

#: Prior sd of the correction of a position, m: only keeps the matrix regular.
WEAK_PRIOR = 10e-6
#: How much more stiffly than one observation the founding cycle holds the gauge.
GAUGE_STIFFNESS = 1e4
#: Evidence, in degrees of freedom, behind the assumption that a particle is as noisy as it claims.
NOISE_PRIOR = 20.0
#: Most evidence that is remembered: about 200 cycles.
NOISE_MEMORY = 400.0
#: Variance factor assumed of a particle with a neighbour, until its own residuals say better.
OVERLAP_FACTOR = 9.0
#: Outliers in a row that prove a particle is not where the map has it.
OUTLIERS_IN_A_ROW = 4
#: Keeps numbers sound where particles hardly fix a pose; relative to what fixes it.
LEAST_PIVOT = 1e-12
#: Poses of a revolution over which the constant effect of the field error is taken.
AROUND = 16
#: Largest interval between two refinements, cycles.
REFINE_AT_MOST = 64


class Constellation:
    """Particles of one body with the joint covariance of their positions and of the field error.

    ``ids`` (m,), ``position`` (m, 3) m in the map frame, ``covariance`` (m, 3, 3) m^2 given the field
    error, ``field_mean`` (k,) m, ``field_covariance`` (k, k) m^2 and its Cholesky ``field_factor``,
    ``coupling`` (m, 3, k): how the estimate of a position changes with the field error; all renewed by
    ``refine``. ``active`` (m,): False once retired.
    """

    def __init__(self, field: FieldError, body: str, retire_after: int, overlap: float) -> None:
        """``field``: shared with the other bodies in view, ``body``: who we are there."""
        modes = field.modes
        self.field, self.body, self.modes = field, body, modes
        self.retire_after, self.overlap = retire_after, overlap
        self.field_mean, self.field_covariance = field.mean, field.covariance
        self.field_factor = field.factor
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
        self._information = np.zeros((len(modes), len(modes)))  # lower triangle; field first, then particles
        self._vector = np.zeros(len(modes))
        self._eliminated: list[Array] = []  # of every cycle since: what its pose took, see observe
        self._refined_at, self._joined = 0, False  # particles since then
        self._joint = np.empty((0, 0))  # covariance of all positions, given the field error
        self._frames = np.zeros((12, len(modes)))  # see define_frames

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

    def adopt(self, ids: Indices, position: Array, covariance: Array) -> None:
        """Start from particles known from elsewhere, whose frame becomes the map frame."""
        self.add(ids, position, covariance, np.zeros((len(ids), 3, len(self.modes))))
        first = len(self.modes) + 3 * np.arange(len(ids))
        for a in range(3):
            for b in range(a + 1):
                self._information[first + a, first + b] += np.linalg.inv(covariance)[:, a, b]
        self.cycles = self._refined_at = 2  # as good as confirmed

    def add(
        self,
        ids: Indices,
        position: Array,
        covariance: Array,
        coupling: Array,
        carried: tuple[Indices, Array] | None = None,
    ) -> None:
        """Add particles (n,) at ``position`` (n, 3) m, known to ``covariance`` until evidence comes in.

        ``carried``: rows (s,) and (3 n, 3 s): how much of the errors of those positions is in the new ones,
        which were measured from a pose that is theirs; ``covariance`` is that of the rest.
        """
        n, old = len(ids), len(self._vector)
        if n == 0:
            return
        self._settle()
        self._joined = True
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
        self._extend_joint(n, carried)
        near = self._has_neighbour()[-n:]
        prior = NOISE_PRIOR * np.where(near, OVERLAP_FACTOR, 1.0)
        self._squares = np.r_[self._squares, np.c_[prior, prior]]
        self._freedom = np.r_[self._freedom, np.full((n, 2), NOISE_PRIOR)]

    def observe(self, rows: Indices, pose: RigidPose, offset: Array, weight: Array, modes: Array) -> None:
        """Add one cycle's evidence on particles ``rows`` (n,) seen at ``pose``.

        ``offset`` (n, 3) m: measured minus the place of ``linearisation(rows)``, field error not removed;
        ``weight`` (n, 3, 3) m^-2: inverse covariance of the localizations alone; ``modes`` (n, 3, k).
        """
        self._eliminated.append(
            _accumulate(
                self._information, self._vector, rows, pose.rotation, offset, weight,
                self._origin[rows] @ pose.rotation.T, modes,
            )
        )  # fmt: skip
        self.cycles += 1

    def relative(self, rows: Indices, pose: RigidPose, noise: Array, has_z: Mask, modes: Array) -> Relative:
        """What is uncertain of ``rows`` (n,) against each other, at ``pose``; ``noise`` (n, 3, 3) m^2 of
        their localizations, whose z counts where ``has_z`` (n,); ``modes`` (n, 3, k) of the field there.

        How the field error moves them is the directly seen ``modes``, less what the map has absorbed of them,
        less what is no error of the motion but a constant of the frames (see ``define_frames``).
        """
        constant = self.constant(pose)
        joint = _blocks(self._joint, rows)
        # They only say which motion counts as common: that x and y are not turned does not matter.
        weight = weights(noise + self.covariance[rows], has_z)
        response, spread, covariance = _relative(
            rows,
            modes,
            self.coupling,
            pose.rotation,
            self.position,
            constant,
            self.field_factor,
            weight,
            joint,
        )
        return Relative(response, spread, covariance, joint)

    def constant(self, pose: RigidPose) -> Array:
        """How the coefficients of the field error move ``pose`` by moving the frames, (6, k)."""
        return np.asarray(_motion_of_frames(*pose) @ self._frames)

    def correction(self, pose: RigidPose, position: Array, modes: Array) -> Array:
        """The field error (n, 3) m as known now at ``position`` (n, 3) m, where its ``modes`` (n, 3, k) are,
        for a body at ``pose``; less how it moves the frames, which must not move with what is learnt."""
        motion = self.constant(pose) @ self.field_mean
        return np.asarray(
            modes @ self.field_mean - motion[:3] - (position - pose.translation) @ hat(motion[3:]).T
        )

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
        freedom (n, 2)."""
        freedom = self._freedom[rows] + freedom
        memory = np.maximum(1.0, freedom / NOISE_MEMORY)
        self._squares[rows] = (self._squares[rows] + squares) / memory
        self._freedom[rows] = freedom / memory

    @property
    def due(self) -> bool:
        """True when enough evidence has come in to make ``refine`` worth its time, or when particles have
        joined since: they are known by their first sightings only, and others may join from them."""
        since = self.cycles - self._refined_at
        return self._joined or since >= min(REFINE_AT_MOST, max(1, self.cycles // 8))

    def refine(self) -> None:
        """Solve for all positions and the field error: milliseconds, hence not in every cycle. Where
        covariances contradict each other beyond what numbers can hold, the map stays as it is.
        """
        self._refined_at, self._joined = self.cycles, False
        self._settle()
        self._forget_retired()
        with suppress(np.linalg.LinAlgError):
            self._solve()

    def _solve(self) -> None:
        k, n = len(self.modes), len(self)
        information = self._information
        if not (np.diag(information)[k:] > 0).all():
            raise np.linalg.LinAlgError("the map's information is not positive definite")
        scale = np.r_[np.sqrt(np.diag(self.field.prior)), 1 / np.sqrt(np.diag(information)[k:])]
        vector = self._vector * scale
        # The lower triangle in rows is the upper one in columns, which LAPACK wants.
        particles = (information[k:, k:] * scale[k:, None] * scale[k:]).T
        cross = information[k:, :k] * scale[k:, None] * scale[:k]
        factor, failed = dpotrf(particles, clean=0, overwrite_a=1)
        if failed:
            raise np.linalg.LinAlgError("the map's information is not positive definite")
        # Positions given the field error; then what they leave to tell of it (Schur complement).
        gain, _ = dpotrs(factor, np.c_[cross, vector[k:]])
        evidence = information[:k, :k] * np.outer(scale[:k], scale[:k])
        evidence = np.tril(evidence) + np.tril(evidence, -1).T - cross.T @ gain[:, :k]
        pull = vector[:k] - cross.T @ gain[:, k]
        self.field.tell(self.body, evidence / np.outer(scale[:k], scale[:k]), pull / scale[:k])
        self.field_mean, self.field_covariance = self.field.mean, self.field.covariance
        self.field_factor = self.field.factor
        correction = (gain[:, k] - gain[:, :k] @ (self.field_mean / scale[:k])) * scale[k:]
        self.coupling = -(gain[:, :k] * scale[k:, None] / scale[:k]).reshape(n, 3, k)
        self.position = self._origin + correction.reshape(n, 3)
        inverse, _ = dpotri(factor, overwrite_c=1)
        self._joint = _unscaled(inverse, scale[k:])
        first = 3 * np.arange(n)
        for a in range(3):
            for b in range(3):
                self.covariance[:, a, b] = self._joint[first + a, first + b]

    def define_frames(self, pose: RigidPose, centre: Array) -> Callable[[RigidPose], RigidPose]:
        """Take what the field error does to all poses of a revolution alike for constants of the frames: a
        motion of the microscope frame and one of the body frame. The revolution is that of ``pose`` about
        ``centre`` (2,) m, in the microscope frame. Returns what takes a pose of the frames before to these.

        No rotating body can measure either, both are definitions, and neither may enter the covariance: an
        unknown constant is not an error of motion. Any constants would do, but they have to stay: frames
        that follow what is learnt of the field error move, and no covariance says so.
        """
        before = self._frames
        self._frames = self._constants(pose, centre)
        change = (self._frames - before) @ self.field_mean

        def moved(pose: RigidPose) -> RigidPose:
            motion = _motion_of_frames(*pose) @ change
            return RigidPose(exp_so3(motion[3:]) @ pose.rotation, pose.translation + motion[:3])

        return moved

    def _constants(self, pose: RigidPose, centre: Array) -> Array:
        """Those motions with the coefficients of the field error, (12, k), by least squares. Of a body whose
        centre is out of the field (a ring gear) only an arc is seen, over which no constant is told from a
        drift: none is taken."""
        constants = np.zeros_like(self._frames)
        if len(self.modes) == 0 or (np.abs(centre) > self.modes.half_size).any():
            return constants
        axis = np.array([*centre, 0.0])
        # Rotations count by the shift that they make at the edge of the field.
        unit = np.r_[np.ones(3), np.full(3, max(self.modes.half_size))]
        around, responses = [], []
        for angle in np.arange(AROUND) * (math.tau / AROUND):
            turn = rotation_z(angle)
            turned = pose.then(RigidPose(turn, axis - turn @ axis))
            place = turned.apply(self.position)
            seen = np.flatnonzero((np.abs(place[:, :2]) < self.modes.half_size).all(axis=1))
            if len(seen) >= 8:
                around.append(unit[:, None] * _motion_of_frames(*turned) / np.tile(unit, 2))
                responses.append(unit[:, None] * self._response(turned, place, seen))
        if around:
            solution = np.linalg.lstsq(np.concatenate(around), np.concatenate(responses), rcond=1e-3)[0]
            constants = solution / np.tile(unit, 2)[:, None]
        return constants

    def _response(self, pose: RigidPose, place: Array, seen: Indices) -> Array:
        """Change (6, k) of a pose with the coefficients of the field error, particles ``seen``."""
        modes = self.modes.evaluate(place[seen]) + pose.rotation @ self.coupling[seen]
        jacobian = pose_jacobian(self.position[seen], pose.rotation).reshape(-1, 6)
        normal = jacobian.T @ jacobian
        scale = 1 / np.sqrt(np.diag(normal))
        right = jacobian.T @ modes.reshape(len(jacobian), -1)
        solution = np.linalg.lstsq(normal * np.outer(scale, scale), scale[:, None] * right, rcond=1e-10)[0]
        return np.asarray(scale[:, None] * solution)

    def _settle(self) -> None:
        """Take off the information what the poses since took: one product for many cycles costs a tenth of
        as many updates."""
        if self._eliminated:
            taken = np.concatenate(self._eliminated)
            # In place: the lower triangle in rows is the upper one in columns.
            self._information = dsyrk(-1.0, taken.T, beta=1.0, c=self._information.T, overwrite_c=1).T
            self._eliminated.clear()

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
        rows = np.flatnonzero(self.active)
        self._joint = _blocks(self._joint, rows)
        for name in ("ids", "position", "covariance", "coupling", "sightings", "misses", "outliers"):
            setattr(self, name, getattr(self, name)[self.active])
        self._origin, self._squares = self._origin[self.active], self._squares[self.active]
        self._freedom = self._freedom[self.active]
        self.active = np.ones(len(self.ids), bool)

    def _extend_joint(self, n: int, carried: tuple[Indices, Array] | None) -> None:
        """Joint covariance of the latest ``n`` particles with all others, see ``add``."""
        old, size = len(self._joint), 3 * len(self)
        joint = np.zeros((size, size))
        joint[:old, :old] = self._joint
        first = old + 3 * np.arange(n)
        for a in range(3):
            for b in range(3):
                joint[first + a, first + b] = self.covariance[-n:, a, b]
        if carried is not None:
            rows, share = carried
            seen = (3 * rows[:, None] + np.arange(3)).ravel()
            cross = share @ self._joint[seen]
            joint[old:, :old], joint[:old, old:] = cross, cross.T
            joint[old:, old:] += cross[:, seen] @ share.T
            self.covariance[-n:] = joint[old:, old:].reshape(n, 3, n, 3)[np.arange(n), :, np.arange(n)]
        self._joint = joint

    def _has_neighbour(self) -> Mask:
        distance = np.hypot(*(self.position[:, None, :2] - self.position[None, :, :2]).transpose(2, 0, 1))
        np.fill_diagonal(distance, np.inf)
        return distance.min(axis=1, initial=np.inf) < self.overlap


class Relative(NamedTuple):
    """The map as n particles in view have it, at one pose.

    ``response`` (n, 3, k) m: how the field error moves them, for modes of unit variance. ``spread`` (n, 3, 3)
    m^2, microscope axes, and ``covariance`` (n, 3, 3) m^2, body axes: of the field error and of their
    positions, each less the motion that all of them share, which no residual shows. ``joint`` (3 n, 3 n) m^2,
    body axes: all of their positions' covariance.
    """

    response: Array
    spread: Array
    covariance: Array
    joint: Array

    def of_pose(self, rotation: Array, gain: Array) -> Array:
        """What the errors of the map add to the covariance of a pose of ``rotation`` (3, 3) beyond
        ``covariance``, had it been independent: K (P - D) K^T with the ``gain`` K (6, 3 n)."""
        return np.asarray(_carried(self.joint, self.covariance, rotation, gain))


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
        if n == 0:
            return
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
def _motion_of_frames(rotation, translation):  # type: ignore[no-untyped-def]
    """How a pose moves (6, 12) with small motions of the microscope frame and of the body frame."""
    out = np.zeros((6, 12))
    out[:, :6] = np.eye(6)
    out[:3, 3:6] = -hat(translation)
    out[:3, 6:9] = out[3:, 9:] = rotation
    return out


@njit(cache=True, nogil=True)
def _unscaled(upper, scale):  # type: ignore[no-untyped-def]
    """The symmetric matrix whose ``upper`` triangle (n, n), times ``scale`` (n,) on both sides, is given."""
    n = len(scale)
    out = np.empty((n, n))
    for i in range(n):
        for j in range(i, n):
            out[i, j] = out[j, i] = upper[i, j] * scale[i] * scale[j]
    return out


@njit(cache=True, nogil=True)
def _blocks(joint, rows):  # type: ignore[no-untyped-def]
    """The 3 x 3 blocks ``rows`` (n,) of a matrix, as one (3 n, 3 n)."""
    n = len(rows)
    out = np.empty((3 * n, 3 * n))
    for i in range(n):
        for a in range(3):
            line, given = out[3 * i + a], joint[3 * rows[i] + a]
            for j in range(n):
                for b in range(3):
                    line[3 * j + b] = given[3 * rows[j] + b]
    return out


@njit(cache=True, nogil=True, forceinline=True, fastmath={"reassoc", "contract"})
def _six_lines(lines, matrix):  # type: ignore[no-untyped-def]
    """``lines`` (6, n) times a symmetric ``matrix`` (n, n): for so few BLAS takes thrice as long."""
    out = np.empty_like(lines)
    l0, l1, l2, l3, l4, l5 = lines[0], lines[1], lines[2], lines[3], lines[4], lines[5]
    for i in range(len(matrix)):
        row = matrix[i]
        s0 = s1 = s2 = s3 = s4 = s5 = 0.0
        for j in range(len(row)):
            s0 += row[j] * l0[j]
            s1 += row[j] * l1[j]
            s2 += row[j] * l2[j]
            s3 += row[j] * l3[j]
            s4 += row[j] * l4[j]
            s5 += row[j] * l5[j]
        out[0, i], out[1, i], out[2, i], out[3, i], out[4, i], out[5, i] = s0, s1, s2, s3, s4, s5
    return out


@njit(cache=True, nogil=True)
def _carried(joint, covariance, rotation, gain):  # type: ignore[no-untyped-def]
    """See ``Relative.of_pose``."""
    n = len(covariance)
    turned = np.empty((6, 3 * n))
    for q in range(6):
        for i in range(n):
            g = gain[q, 3 * i : 3 * i + 3]
            for a in range(3):
                turned[q, 3 * i + a] = g[0] * rotation[0, a] + g[1] * rotation[1, a] + g[2] * rotation[2, a]
    shared = _six_lines(turned, joint)
    for q in range(6):
        for i in range(n):
            for a in range(3):
                for b in range(3):
                    shared[q, 3 * i + a] -= covariance[i, a, b] * turned[q, 3 * i + b]
    return np.dot(shared, turned.T)


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def _relative(  # type: ignore[no-untyped-def]
    rows, modes, coupling, rotation, position, constant, factor, weight, joint
):
    """See ``Constellation.relative``: with J = [1, -hat(R p)] and A = (J^T W J)^-1 J^T W, the motion A e that
    errors e have in common is taken off: e - J A e."""
    n, k = len(rows), modes.shape[2]
    lines, design, pull = np.empty((3 * n, k)), np.zeros((3 * n, 6)), np.empty((3 * n, 6))
    for i in range(n):
        p, g = position[rows[i]], coupling[rows[i]]
        v = design[3 * i : 3 * i + 3]
        x, y, z = (
            rotation[0, 0] * p[0] + rotation[0, 1] * p[1] + rotation[0, 2] * p[2],
            rotation[1, 0] * p[0] + rotation[1, 1] * p[1] + rotation[1, 2] * p[2],
            rotation[2, 0] * p[0] + rotation[2, 1] * p[1] + rotation[2, 2] * p[2],
        )
        v[0, 0] = v[1, 1] = v[2, 2] = 1.0
        v[0, 4], v[0, 5] = z, -y
        v[1, 3], v[1, 5] = -z, x
        v[2, 3], v[2, 4] = y, -x
        for a in range(3):
            # Row a of J has two entries beside the one.
            one, other = (4, 5) if a == 0 else ((3, 5) if a == 1 else (3, 4))
            r0, r1, r2 = rotation[a, 0], rotation[a, 1], rotation[a, 2]
            line = lines[3 * i + a]
            for m in range(k):
                line[m] = (
                    modes[i, a, m] + r0 * g[0, m] + r1 * g[1, m] + r2 * g[2, m]
                    - constant[a, m] - v[a, one] * constant[one, m] - v[a, other] * constant[other, m]
                )  # fmt: skip
            for c in range(6):
                pull[3 * i + a, c] = (
                    weight[i, a, 0] * v[0, c] + weight[i, a, 1] * v[1, c] + weight[i, a, 2] * v[2, c]
                )
    normal = np.dot(design.T, pull)
    scale = np.empty(6)
    for c in range(6):
        scale[c] = 1 / math.sqrt(max(normal[c, c], 1e-300))
    for c in range(6):
        for b in range(6):
            normal[c, b] *= scale[c] * scale[b]
        normal[c, c] += LEAST_PIVOT
    inverse = np.linalg.inv(normal)
    for c in range(6):
        for b in range(6):
            inverse[c, b] *= scale[c] * scale[b]
    share = np.dot(pull, inverse)  # A^T
    response = np.dot(lines, factor)
    apart = response - np.dot(design, np.dot(share.T, response))
    # Into body axes, in which the joint covariance is.
    turned, levers = np.empty((6, 3 * n)), np.empty((6, 3 * n))
    for i in range(n):
        for a in range(3):
            for c in range(6):
                s, t = 0.0, 0.0
                for b in range(3):
                    s += rotation[b, a] * share[3 * i + b, c]
                    t += rotation[b, a] * design[3 * i + b, c]
                turned[c, 3 * i + a], levers[c, 3 * i + a] = s, t
    shared = _six_lines(turned, joint)
    common = np.dot(turned, shared.T)
    by_lever = 0.5 * np.dot(common, levers) - shared
    spread, covariance = np.empty((n, 3, 3)), np.empty((n, 3, 3))
    for i in range(n):
        for a in range(3):
            for b in range(a + 1):
                total, own = 0.0, joint[3 * i + a, 3 * i + b]
                for m in range(k):
                    total += apart[3 * i + a, m] * apart[3 * i + b, m]
                for c in range(6):
                    own += by_lever[c, 3 * i + a] * levers[c, 3 * i + b]
                    own += by_lever[c, 3 * i + b] * levers[c, 3 * i + a]
                spread[i, a, b] = spread[i, b, a] = total
                covariance[i, a, b] = covariance[i, b, a] = own
    return response.reshape(n, 3, k), spread, covariance


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def _accumulate(information, vector, rows, rotation, offset, weight, moved, modes):  # type: ignore[no-untyped-def]
    """Add one cycle to the normal equations, its pose eliminated; ``moved`` = R p.

    With W the weights, F the modes and J = [1, -hat(R p)], all turned into the body frame, that is the sum of
    [F R]^T W [F R] less its projection on the pose, E^T (J^T W J)^-1 E with E = J^T W [F R]. The projection
    is returned as L^-1 E (6, size), L L^T = J^T W J: its square is still to be taken off.
    """
    n, k = len(rows), modes.shape[2]
    evidence = np.zeros((6, len(vector)))
    normal, pull = np.zeros((6, 6)), np.zeros(6)
    jacobian, wj = np.zeros((3, 6)), np.zeros((3, 6))
    jacobian[0, 0] = jacobian[1, 1] = jacobian[2, 2] = 1.0
    wf = np.empty((3 * n, k))
    turned = np.empty((3, 3))
    for i in range(n):
        v, r = moved[i], offset[i]
        jacobian[0, 4], jacobian[0, 5] = v[2], -v[1]
        jacobian[1, 3], jacobian[1, 5] = -v[2], v[0]
        jacobian[2, 3], jacobian[2, 4] = v[1], -v[0]
        place = k + 3 * rows[i]
        for a in range(3):
            w0, w1, w2 = weight[i, a]
            for c in range(6):
                wj[a, c] = w0 * jacobian[0, c] + w1 * jacobian[1, c] + w2 * jacobian[2, c]
            for m in range(k):
                wf[3 * i + a, m] = w0 * modes[i, 0, m] + w1 * modes[i, 1, m] + w2 * modes[i, 2, m]
            for b in range(3):
                turned[a, b] = (
                    rotation[0, a] * weight[i, 0, b] + rotation[1, a] * weight[i, 1, b]
                    + rotation[2, a] * weight[i, 2, b]
                )  # fmt: skip
        for c in range(6):
            w0, w1, w2 = wj[0, c], wj[1, c], wj[2, c]
            pull[c] += w0 * r[0] + w1 * r[1] + w2 * r[2]
            for b in range(c + 1):
                normal[c, b] += w0 * jacobian[0, b] + w1 * jacobian[1, b] + w2 * jacobian[2, b]
            for m in range(k):
                evidence[c, m] += w0 * modes[i, 0, m] + w1 * modes[i, 1, m] + w2 * modes[i, 2, m]
            for a in range(3):
                evidence[c, place + a] = w0 * rotation[0, a] + w1 * rotation[1, a] + w2 * rotation[2, a]
        for a in range(3):
            t0, t1, t2 = turned[a]
            vector[place + a] += t0 * r[0] + t1 * r[1] + t2 * r[2]
            for b in range(a + 1):
                information[place + a, place + b] += (
                    t0 * rotation[0, b] + t1 * rotation[1, b] + t2 * rotation[2, b]
                )
            for m in range(k):
                information[place + a, m] += t0 * modes[i, 0, m] + t1 * modes[i, 1, m] + t2 * modes[i, 2, m]
        for m in range(k):
            vector[m] += wf[3 * i, m] * r[0] + wf[3 * i + 1, m] * r[1] + wf[3 * i + 2, m] * r[2]
    information[:k, :k] += np.dot(modes.reshape(3 * n, k).T, wf)
    # L^-1 E and L^-1 pull by forward substitution, in units in which J^T W J has a diagonal of ones; what the
    # particles hardly fix must not make it fail.
    scale = 1 / np.sqrt(np.diag(normal))
    for c in range(6):
        for b in range(c + 1):
            normal[c, b] *= scale[c] * scale[b]
        normal[c, c] += LEAST_PIVOT
        pull[c] *= scale[c]
        for m in range(len(vector)):
            evidence[c, m] *= scale[c]
    lower = np.linalg.cholesky(normal)
    for c in range(6):
        for b in range(c):
            pull[c] -= lower[c, b] * pull[b]
            for m in range(len(vector)):
                evidence[c, m] -= lower[c, b] * evidence[b, m]
        pull[c] /= lower[c, c]
        for m in range(len(vector)):
            evidence[c, m] /= lower[c, c]
            vector[m] -= evidence[c, m] * pull[c]
    return evidence
