"""PoseEstimator: localizations of a motion cycle in, pose of the body in six degrees of freedom out."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mems6dof_ros.errors import InputError
from mems6dof_ros.localization.localizations import Flag, Localizations
from mems6dof_ros.pose.angles import paper_angles, swing_twist, swing_twist_jacobian, unwrap_near
from mems6dof_ros.pose.centre import CentreOfRotation
from mems6dof_ros.pose.constellation import Candidates, Constellation
from mems6dof_ros.pose.cycle_pose import CyclePose, PaperAngles, Status
from mems6dof_ros.pose.field import FieldModes
from mems6dof_ros.pose.registration import ConstellationIndex, closest_points, log10_false_alarms
from mems6dof_ros.pose.rigid import RigidPose, lever_jacobian, rotation_z
from mems6dof_ros.pose.solve import FULL, LATERAL, UNUSED, Solution, solve_pose

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]

#: Flags with which x and y are still good: their covariance says how good.
LATERAL_ONLY = Flag.Z_AMBIGUOUS | Flag.NO_Z | Flag.Z_OUT_OF_RANGE


@dataclass(frozen=True)
class PoseSettings:
    """What the user may set; lengths in m, angles in rad.

    reference: ``map`` registers to the constellation map, refined as cycles arrive; ``previous`` to the
        micrograph before, as the paper does, whose errors add up over the cycles.
    gates: annealed gates of the iterative closest point, descending; the last one is the final gate.
    min_particles: fewer matched particles give no pose.
    confirm_after: sightings in a row of cycles before a newcomer joins the map.
    retire_after: misses in a row, where it should have been seen, before a particle leaves the map.
    overlap: particles closer than this to another count less until their residuals prove them good.
    gate_xy, gate_z: standard deviations beyond which a particle, or only its z, is left out.
    max_displacement: farther from its centre of rotation no body moves by itself; beyond it the view has
        been shifted, and the pose is lost.
    max_tilt: likewise for the tilt.
    max_false_alarms: matches this good that chance would give, log10; the proof against a wrong pose.
    field_size: (width, height) of the field; None: taken from where particles are seen.
    field_degree: degree of the smooth field error that is estimated with the map; 0: none.
    field_sd_xy, field_sd_z: its prior standard deviation, what the calibration leaves over the field.
    recentre_at: turns (rad, since the reference) after which the origin is moved to the centre of rotation as
        known by then; each such moment is a new reference version. Empty: only ``set_reference``.
    """

    reference: str = "map"
    gates: tuple[float, ...] = (8e-6, 4e-6, 2e-6, 1e-6, 0.3e-6, 0.05e-6)
    min_particles: int = 4
    confirm_after: int = 3
    retire_after: int = 20
    overlap: float = 3e-6
    gate_xy: float = 4.5
    gate_z: float = 4.0
    max_displacement: float = 5e-6
    max_tilt: float = 0.02
    max_false_alarms: float = -6.0
    field_size: tuple[float, float] | None = None
    field_degree: int = 4
    field_sd_xy: float = 5e-9
    field_sd_z: float = 30e-9
    recentre_at: tuple[float, ...] = (math.radians(30), math.tau)

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            numbers = value if isinstance(value, tuple) else (value,)
            if any(isinstance(v, float) and not math.isfinite(v) for v in numbers):
                raise InputError(f"pose setting {item.name}", str(value), "finite numbers")
        if self.reference not in ("map", "previous"):
            raise InputError("pose setting reference", repr(self.reference), "'map' or 'previous'")
        if not self.gates or list(self.gates) != sorted(self.gates, reverse=True) or self.gates[-1] <= 0:
            raise InputError(
                "pose setting gates", str(self.gates), "positive lengths (m) in descending order"
            )
        if self.min_particles < 3:
            raise InputError("pose setting min_particles", str(self.min_particles), "at least 3")
        for name in ("confirm_after", "retire_after", "gate_xy", "gate_z", "max_displacement", "max_tilt"):
            if not getattr(self, name) > 0:
                raise InputError(f"pose setting {name}", str(getattr(self, name)), "a positive number")
        if not 0 <= self.field_degree <= 8:
            raise InputError("pose setting field_degree", str(self.field_degree), "0 (none) to 8")


class _View(NamedTuple):
    """The usable localizations of one cycle; ``of`` (n,): index in the message."""

    of: Indices
    position: Array
    covariance: Array
    has_z: Mask
    good: Mask

    def only(self, keep: Indices | Mask) -> _View:
        """The localizations ``keep``."""
        return _View(
            self.of[keep], self.position[keep], self.covariance[keep], self.has_z[keep], self.good[keep]
        )


class _Reference(NamedTuple):
    """Body frame: map frame turned by ``rotation``, origin at ``origin`` (3,) m of the map frame; the
    origin was at ``place`` (3,) m of the microscope frame in the reference pose, at ``psi`` rad."""

    version: int
    rotation: Array
    origin: Array
    place: Array
    psi: float


class _State(NamedTuple):
    """The last valid pose, in the map frame; psi unwrapped."""

    cycle: int
    pose: RigidPose
    psi: float
    covariance: Array
    noise: Array


class PoseEstimator:
    """Pose of one rigid body, cycle after cycle.

    ``update`` never raises on bad data: it returns a pose that says what is wrong. Reading ``constellation``
    and ``centre`` is allowed at any time.
    """

    def __init__(self, settings: PoseSettings | None = None, body: str = "load_gear") -> None:
        self.settings = settings or PoseSettings()
        self.body = body
        self.reset()

    def reset(self) -> None:
        """Forget everything: the next cycle founds a new constellation and reference version 1."""
        self.constellation: Constellation | None = None
        self.candidates = Candidates()
        self.centre = CentreOfRotation()
        self._index: tuple[int, ConstellationIndex] | None = None
        self._last: _State | None = None
        self._last_frame: tuple[int, int] | None = None
        self._steps: deque[float] = deque(maxlen=15)
        self._reference = _Reference(1, np.eye(3), np.zeros(3), np.zeros(3), 0.0)
        self._recentred = 0
        self._next_id = 0
        self._noise = np.array([[50.0, 50.0], [50.0, 50.0]])  # xy, z: squared residuals, degrees of freedom
        self._half_field = np.zeros(2)

    # ---------------------------------------------------------------- the cycle

    def update(self, localizations: Localizations) -> CyclePose:
        """Pose of the body in this cycle. Raises InputError only where arrays do not fit together."""
        _check_shapes(localizations)
        order = (localizations.cycle, localizations.frame_counter)
        if self._last_frame is not None and order <= self._last_frame:
            late = self._last_frame
            which = "again" if order == late else f"after cycle {late[0]}, frame {late[1]}"
            reason = f"cycle {order[0]}, frame {order[1]} arrived {which}: ignored; reset to start anew"
            return self._no_pose(localizations, Status.LOST, reason)
        self._last_frame = order
        view = self._usable(localizations)
        if self.constellation is None:
            return self._found(localizations, view)
        if len(view.of) < self.settings.min_particles:
            return self._no_pose(localizations, Status.LOST, _too_few(localizations, view))
        return self._track(localizations, view, self.constellation)

    def predict(self, cycle: int) -> tuple[Indices, Array] | None:
        """Identities and predicted positions (n, 3) m of the particles expected inside the field in
        ``cycle``; None while there is no pose to predict from."""
        if self.constellation is None or self._last is None:
            return None
        pose, _, _ = self._predicted(cycle)
        position = pose.apply(self.constellation.position)
        expected = self.constellation.active & self._inside(position)
        return self.constellation.ids[expected], position[expected]

    def set_reference(self) -> int:
        """Make the last valid pose the reference, its origin the centre of rotation as known now; returns
        the new reference version. Raises InputError before the first pose."""
        if self._last is None:
            raise InputError("set_reference", "no valid pose yet", "a pose to refer to")
        self._set_reference(self._last.pose.rotation, self._last.pose, self._last.psi)
        return self._reference.version

    # ------------------------------------------------------------------ founding

    def _found(self, localizations: Localizations, view: _View) -> CyclePose:
        s = self.settings
        if (view.good & view.has_z).sum() < max(s.min_particles, 4):
            return self._no_pose(localizations, Status.INITIALIZING, _too_few(localizations, view))
        view = view.only(view.good)
        seen = np.abs(view.position[:, :2]).max(axis=0)
        self._half_field = np.array(s.field_size) / 2 if s.field_size is not None else seen
        modes = FieldModes((float(self._half_field[0]), float(self._half_field[1])), s.field_degree)
        prior = modes.prior_variance(s.field_sd_xy, s.field_sd_z)
        constellation = Constellation(modes, prior, s.retire_after, s.overlap)
        height = float(np.median(view.position[view.has_z, 2]))
        # The map frame is the microscope frame of this cycle, moved to the height of the particles.
        self._offset = np.array([0.0, 0.0, height])
        ids = self._new_ids(len(view.of))
        constellation.found(ids, view.position - self._offset, view.covariance, modes.evaluate(view.position))
        self.constellation = constellation
        pose = RigidPose(np.eye(3), self._offset.copy())
        self._reference = _Reference(1, np.eye(3), np.zeros(3), self._offset.copy(), 0.0)
        solution = solve_pose(
            pose, constellation.position, constellation.covariance * 1e-6, view.position, view.covariance,
            view.has_z, np.zeros((len(ids), 3, 0)), s.gate_xy, s.gate_z,
        )  # fmt: skip
        if not solution.ok:
            self.constellation = None
            return self._no_pose(localizations, Status.INITIALIZING, "the particles do not fix a pose")
        state = _State(localizations.cycle, pose, 0.0, solution.noise, solution.noise)
        self.centre.add(pose.rotation, pose.translation)
        result = self._report(localizations, state, None, solution, view, ids, len(ids), "")
        self._last = state
        return result

    # ------------------------------------------------------------------ tracking

    def _track(self, localizations: Localizations, view: _View, constellation: Constellation) -> CyclePose:
        s = self.settings
        assert self._last is not None
        predicted, psi_predicted, sd_psi = self._predicted(localizations.cycle)
        elapsed = localizations.cycle - self._last.cycle
        if s.field_size is None:
            self._half_field = np.maximum(self._half_field, np.abs(view.position[:, :2]).max(axis=0))

        known = np.flatnonzero(constellation.active)
        found = self._register(view, constellation, known, predicted, sd_psi)
        if found is None:
            reason = f"none of {len(view.of)} localizations fit the constellation of {len(known)} particles"
            return self._no_pose(localizations, Status.LOST, reason)
        start, match = found
        took_part = np.flatnonzero((match >= 0) & view.good)
        rows = match[took_part]
        ids = constellation.ids[rows]
        modes = constellation.modes.evaluate(view.position[took_part])
        factor = constellation.noise_factor(rows) * (self._noise[:, 0] / self._noise[:, 1])
        measured_covariance = _scaled(view.covariance[took_part], factor)
        response = constellation.field_response(rows, start, modes)
        solution = solve_pose(
            start,
            constellation.position[rows],
            constellation.covariance[rows],
            view.position[took_part] - modes @ constellation.field_mean,
            measured_covariance,
            view.has_z[took_part],
            response @ constellation.field_factor,
            s.gate_xy,
            s.gate_z,
        )
        used, used_z = int((solution.use > UNUSED).sum()), int((solution.use == FULL).sum())
        if not solution.ok or used < s.min_particles:
            return self._no_pose(
                localizations, Status.LOST,
                f"{used} particles agree, {used_z} of them in z: too few to fix six degrees of freedom",
            )  # fmt: skip
        pose = solution.pose
        implausible = self._implausible(pose)
        if implausible:
            return self._no_pose(localizations, Status.LOST, implausible)
        psi = unwrap_near(swing_twist(pose.rotation)[2], psi_predicted)
        covariance = solution.covariance
        if s.reference == "previous":
            covariance = covariance + self._last.covariance
        state = _State(localizations.cycle, pose, psi, covariance, solution.noise)

        inside = constellation.active & self._inside(pose.apply(constellation.position))
        self._learn(view, constellation, state, solution, match, took_part, modes, inside, factor)
        if elapsed > 0:
            self._steps.append((psi - self._last.psi) / elapsed)
        self.centre.add(pose.rotation, pose.translation)
        reason = self._doubts(used, int(inside.sum()), sd_psi)
        self._recentre(state)
        result = self._report(
            localizations, state, self._last, solution, view.only(took_part), ids,
            int(inside.sum()), reason,
        )  # fmt: skip
        self._last = state
        return result

    def _predicted(self, cycle: int) -> tuple[RigidPose, float, float]:
        """Predicted pose in the map frame, its psi, and the standard deviation of psi."""
        assert self._last is not None
        elapsed = cycle - self._last.cycle
        steps = np.array(self._steps)
        step = float(np.median(steps[-5:])) if len(steps) else 0.0
        # Without a measured step anything may have happened; a degree per cycle lets the search begin.
        spread = (
            1.5 * float(np.median(np.abs(steps - np.median(steps)))) if len(steps) > 2 else math.radians(1)
        )
        sd = (spread + 1e-4) * math.sqrt(max(elapsed, 0)) + 0.1 * abs(step) * math.sqrt(max(elapsed - 1, 0))
        turn = rotation_z(step * elapsed)
        centre = self.centre.estimate()
        place = np.zeros(3)
        if centre is not None and centre.sd < 20e-6:
            place[:2] = centre.microscope
        rotation, translation = self._last.pose
        pose = RigidPose(turn @ rotation, place + turn @ (translation - place))
        return pose, self._last.psi + step * elapsed, sd

    def _register(
        self, view: _View, constellation: Constellation, known: Indices, predicted: RigidPose, sd_psi: float
    ) -> tuple[RigidPose, Indices] | None:
        """Start pose and, per localization, the row of its particle or -1; None when lost."""
        s = self.settings
        measured = view.position[:, :2]
        reach = float(np.hypot(*self._half_field))
        first_gate = 1e-6 + 3 * sd_psi * reach
        gates = [g for g in s.gates if g <= first_gate] or [s.gates[-1]]
        larger = [g for g in s.gates if g > first_gate]
        gates = larger[-1:] + gates
        position = predicted.apply(constellation.position[known])
        motion, match = closest_points(position[:, :2], measured, np.array(gates))
        if not self._proven(match, len(known), gates[-1], 1.0):
            index = self._constellation_index(constellation, known)
            enough = self._enough(len(measured), len(known), s.gates[-2:][0])
            guess = index.search(measured, 0.05e-6, s.gates[-2:][0], enough)
            if guess.inliers < 3:
                return None
            # Keep the predicted tilt and height; take the motion in the plane from the search.
            c = rotation_z(guess.motion.angle)
            height = float(predicted.translation[2])
            predicted = RigidPose(c, np.array([*guess.motion.shift, height]))
            position = predicted.apply(constellation.position[known])
            fine = np.array([g for g in s.gates if g <= 1e-6] or s.gates[-1:])
            motion, match = closest_points(position[:, :2], measured, fine)
            if not self._proven(match, len(known), float(fine[-1]), float(guess.tests)):
                return None
        turn = rotation_z(motion.angle)
        translation = turn @ predicted.translation
        translation[:2] += motion.shift
        return RigidPose(turn @ predicted.rotation, translation), np.where(match >= 0, known[match], -1)

    def _chance(self, particles: int, gate: float) -> float:
        """Probability that a random localization lies within ``gate`` of some particle."""
        return min(1.0, particles * math.pi * gate**2 / float(4 * np.prod(self._half_field)))

    def _proven(self, match: Indices, particles: int, gate: float, tests: float) -> bool:
        matched = int((match >= 0).sum())
        if matched < self.settings.min_particles:
            return False
        alarms = log10_false_alarms(matched, len(match), self._chance(particles, gate), tests)
        return alarms < self.settings.max_false_alarms

    def _enough(self, points: int, particles: int, gate: float) -> int:
        """Agreements that chance does not give in 1e5 hypotheses."""
        chance = self._chance(particles, gate)
        for inliers in range(3, points):
            if log10_false_alarms(inliers, points, chance, 1e5) < self.settings.max_false_alarms:
                return max(inliers, self.settings.min_particles)
        return points

    def _constellation_index(self, constellation: Constellation, known: Indices) -> ConstellationIndex:
        version = constellation.cycles * 10_000 + len(known)
        if self._index is None or self._index[0] != version:
            self._index = (version, ConstellationIndex(constellation.position[known, :2]))
        return self._index[1]

    def _implausible(self, pose: RigidPose) -> str:
        """Why a well-matched pose cannot be a motion of the body by itself, in words; empty: it can."""
        assert self.constellation is not None
        s = self.settings
        tilt = math.hypot(*swing_twist(pose.rotation)[:2])
        if tilt > s.max_tilt:
            return f"tilt of {tilt * 1e3:.1f} mrad is beyond max_tilt ({s.max_tilt * 1e3:.1f} mrad)"
        centre = self.centre.estimate()
        if centre is not None and centre.sd < 20e-6:
            body, place, slack = centre.body, centre.microscope, 3 * centre.sd
        else:
            body, place, slack = np.zeros(2), self._offset[:2], float(np.hypot(*self._half_field))
        now = pose.apply(np.array([body[0], body[1], 0.0]))
        turned = 2 * abs(math.sin(swing_twist(pose.rotation)[2] / 2))
        moved = math.hypot(now[0] - place[0], now[1] - place[1])
        if moved > s.max_displacement + turned * slack:
            return (
                f"centre displaced by {moved * 1e6:.1f} um, beyond max_displacement "
                f"({s.max_displacement * 1e6:.1f} um): the view was shifted"
            )
        return ""

    def _doubts(self, used: int, expected: int, sd_psi: float) -> str:
        if sd_psi > math.radians(60):
            return "whole turns of psi uncertain after the cycles lost"
        if used < 0.5 * expected:
            return f"only {used} of {expected} expected particles agree"
        return ""

    # ------------------------------------------------------------------ learning

    def _learn(
        self, view: _View, constellation: Constellation, state: _State, solution: Solution, match: Indices,
        took_part: Indices, modes: Array, inside: Mask, factor: Array,
    ) -> None:  # fmt: skip
        """Refine the map, its membership and the noise by one cycle."""
        pose, s = state.pose, self.settings
        rows = match[took_part]
        good = solution.use > UNUSED
        self._learn_noise(constellation, rows, solution, factor)
        if s.reference == "previous":
            self._follow(view, constellation, pose, match)
            return
        weight = _weights(_scaled(view.covariance[took_part], factor)[good], solution.use[good] == FULL)
        offset = view.position[took_part][good] - pose.apply(constellation.linearisation(rows[good]))
        constellation.observe(rows[good], pose, offset, weight, modes[good])

        seen = match[match >= 0]
        missed = inside.copy()
        missed[seen] = False
        outlying = np.column_stack([~good, view.has_z[took_part] & (solution.use == LATERAL)])
        retired = constellation.count(seen, np.flatnonzero(missed), rows, outlying)
        self._recruit(view, constellation, state, np.flatnonzero((match < 0) & view.good & view.has_z))
        self.candidates.add(
            constellation.ids[retired],
            constellation.position[retired],
            constellation.covariance[retired],
            former=True,
        )
        if constellation.due:
            constellation.refine()

    def _learn_noise(
        self, constellation: Constellation, rows: Indices, solution: Solution, factor: Array
    ) -> None:
        """Compare residuals with what the covariances claim, over all particles and for each."""
        use = solution.use
        counted = np.stack([use > UNUSED, use == FULL], axis=1)
        squares = np.where(counted, np.stack([solution.distance_xy, solution.distance_z], axis=1), 0.0)
        freedom = counted * np.array([2.0, 1.0])
        total = freedom.sum(axis=0)
        left = np.maximum(total - 3, 0) / np.maximum(total, 1)  # the pose takes three of each
        current = self._noise[:, 0] / self._noise[:, 1]
        own = constellation.noise_factor(rows)
        self._noise[:, 0] += (squares * current).sum(axis=0)
        self._noise[:, 1] += total * left
        self._noise /= np.maximum(1.0, self._noise[:, 1:] / 20_000.0)
        constellation.learn_noise(rows, squares * own, freedom * left)

    def _recruit(self, view: _View, constellation: Constellation, state: _State, newcomers: Indices) -> None:
        """Follow unmatched localizations as candidates; confirm those that move with the body."""
        pose, candidates = state.pose, self.candidates
        if not len(newcomers) and not len(candidates):
            return
        back = pose.inverse()
        place = back.apply(view.position[newcomers])
        jacobian = np.zeros((len(newcomers), 3, 6))
        jacobian[:, [0, 1, 2], [0, 1, 2]] = 1.0
        lever = view.position[newcomers] - pose.translation
        jacobian[:, 0, 4], jacobian[:, 0, 5] = lever[:, 2], -lever[:, 1]
        jacobian[:, 1, 3], jacobian[:, 1, 5] = -lever[:, 2], lever[:, 0]
        jacobian[:, 2, 3], jacobian[:, 2, 4] = lever[:, 1], -lever[:, 0]
        covariance = view.covariance[newcomers] + jacobian @ state.covariance @ jacobian.transpose(0, 2, 1)
        covariance = pose.rotation.T @ covariance @ pose.rotation
        taken = np.zeros(len(newcomers), bool)
        if len(candidates):
            separation = np.hypot(*(place[:, None, :2] - candidates.position[None, :, :2]).transpose(2, 0, 1))
            nearest = separation.argmin(axis=1) if len(newcomers) else np.empty(0, np.int64)
            taken = separation.min(axis=1, initial=np.inf) < self.settings.gates[-2:][0]
            seen, first = np.unique(nearest[taken], return_index=True)
            which = np.flatnonzero(taken)[first]
            missed = self._inside(pose.apply(candidates.position))
            missed[seen] = False
            candidates.count(seen, place[which], covariance[which], missed)
        active = constellation.active
        free = np.flatnonzero(~taken)
        if len(free):
            distance = np.hypot(
                *(place[free][:, None, :2] - constellation.position[active][None, :, :2]).transpose(2, 0, 1)
            )
            free = free[distance.min(axis=1, initial=np.inf) > 1e-6]  # no two spheres in one place
            candidates.add(self._new_ids(len(free)), place[free], covariance[free], former=False)
        ready = candidates.sightings >= self.settings.confirm_after
        if ready.any():
            position = candidates.position[ready]
            modes = constellation.modes.evaluate(pose.apply(position))
            constellation.add(
                candidates.ids[ready], position, candidates.covariance[ready], -pose.rotation.T @ modes
            )
            candidates.keep(~ready)

    def _follow(self, view: _View, constellation: Constellation, pose: RigidPose, match: Indices) -> None:
        """Chained registration: this cycle's localizations become the constellation of the next."""
        ids = np.where(match >= 0, constellation.ids[match], -1)
        new = ids < 0
        ids[new] = self._new_ids(int(new.sum()))
        keep = view.good
        turned = pose.rotation.T @ view.covariance[keep] @ pose.rotation
        successor = Constellation(
            constellation.modes, np.diag(constellation.field_covariance).copy(), self.settings.retire_after,
            self.settings.overlap,
        )  # fmt: skip
        modes = constellation.modes.evaluate(view.position[keep])
        successor.add(ids[keep], pose.inverse().apply(view.position[keep]), turned, -pose.rotation.T @ modes)
        self.constellation = successor

    # ----------------------------------------------------------------- reference

    def _recentre(self, state: _State) -> None:
        """Move the origin to the centre of rotation at the turns that the settings name."""
        due = self.settings.recentre_at
        if self._recentred >= len(due) or abs(state.psi - self._reference.psi) < due[self._recentred]:
            return
        self._recentred += 1
        now = self._reference
        pose = RigidPose(now.rotation, now.place - now.rotation @ now.origin)
        self._set_reference(now.rotation, pose, now.psi)

    def _set_reference(self, rotation: Array, pose: RigidPose, psi: float) -> None:
        """Refer to ``pose`` (map frame), with the origin at the centre of rotation as known now."""
        centre = self.centre.estimate()
        origin = self._reference.origin.copy()
        if centre is not None and centre.sd < self.settings.max_displacement:
            origin[:2] = centre.body
        self._reference = _Reference(self._reference.version + 1, rotation, origin, pose.apply(origin), psi)

    # ------------------------------------------------------------------- helpers

    def _usable(self, localizations: Localizations) -> _View:
        """Localizations with finite x and y; z where it is finite and unflagged."""
        position, covariance = localizations.position, localizations.covariance
        flags = localizations.flags.astype(np.int64)
        variance = np.diagonal(covariance, axis1=1, axis2=2)
        finite = np.isfinite(position[:, :2]).all(axis=1)
        sound = np.isfinite(covariance[:, :2, :2]).all(axis=(1, 2)) & (variance[:, :2] > 0).all(axis=1)
        index = np.flatnonzero(finite & sound & ((flags & (Flag.FIT_FAILED)) == 0))
        position, covariance, flags = position[index].copy(), covariance[index].copy(), flags[index]
        has_z = (
            np.isfinite(position[:, 2]) & np.isfinite(covariance).all(axis=(1, 2)) & (covariance[:, 2, 2] > 0)
        )
        determinant = np.where(
            has_z, np.linalg.det(np.where(has_z[:, None, None], covariance, np.eye(3))), 0.0
        )
        has_z &= determinant > 0
        has_z &= (flags & LATERAL_ONLY) == 0
        good = (flags & ~int(LATERAL_ONLY)) == 0
        position[~has_z, 2] = 0.0
        covariance[~has_z, 2, :] = covariance[~has_z, :, 2] = 0.0
        covariance[~has_z, 2, 2] = 1e-10  # (10 um)^2: no knowledge of z
        return _View(index, position, covariance, has_z, good)

    def _inside(self, position: Array) -> Mask:
        """Where ``position`` (n, 3) m lies well inside the field."""
        margin = 2e-6
        return np.asarray((np.abs(position[:, :2]) < self._half_field - margin).all(axis=1))

    def _new_ids(self, count: int) -> Indices:
        ids = np.arange(self._next_id, self._next_id + count)
        self._next_id += count
        return ids

    def _report(
        self, localizations: Localizations, state: _State, before: _State | None, solution: Solution,
        view: _View, ids: Indices, expected: int, reason: str,
    ) -> CyclePose:  # fmt: skip
        """The pose in the body frame of the current reference, with everything derived from it."""
        reference = self._reference
        lever = state.pose.rotation @ reference.origin
        rotation = state.pose.rotation @ reference.rotation.T
        translation = state.pose.translation + lever
        shift = lever_jacobian(lever)
        displacement, jacobian = self._displaced(state)
        increment, increment_covariance, span = np.full(6, np.nan), np.full((6, 6), np.nan), 0
        if before is not None:
            # The map and the field error are common to both cycles; their noise is not.
            displacement_before, jacobian_before = self._displaced(before)
            increment = displacement - displacement_before
            increment_covariance = (
                jacobian @ state.noise @ jacobian.T + jacobian_before @ before.noise @ jacobian_before.T
            )
            span = state.cycle - before.cycle
        displacement_covariance = jacobian @ state.covariance @ jacobian.T
        particle_id = np.full(len(localizations), -1, np.int32)
        residual = np.full((len(localizations), 3), np.nan)
        used = solution.use > UNUSED
        particle_id[view.of[used]] = ids[used]
        residual[view.of[used]] = solution.residual[used]
        residual[view.of[solution.use == LATERAL], 2] = np.nan
        lateral = solution.residual[used, :2]
        axial = solution.residual[solution.use == FULL, 2]
        return CyclePose(
            stamp_ns=localizations.stamp_ns,
            frame_id=localizations.frame_id,
            frame_counter=localizations.frame_counter,
            cycle=localizations.cycle,
            body=self.body,
            status=Status.DEGRADED if reason else Status.TRACKING,
            reason=reason,
            reference_version=reference.version,
            rotation=rotation,
            translation=translation,
            covariance=shift @ state.covariance @ shift.T,
            displacement=displacement,
            displacement_covariance=displacement_covariance,
            angles=paper_angles(displacement, displacement_covariance),
            increment=increment,
            increment_covariance=increment_covariance,
            increment_cycles=span,
            residual_rms_xy=math.sqrt((lateral**2).sum() / max(2 * len(lateral) - 3, 1)),
            residual_rms_z=math.sqrt((axial**2).sum() / max(len(axial) - 3, 1)),
            chi_square=solution.chi_square / max(solution.degrees_of_freedom, 1),
            particles_used=int(used.sum()),
            particles_seen=len(localizations),
            particles_expected=expected,
            particle_id=particle_id,
            residual=residual,
            latency=localizations.latency,
        )

    def _displaced(self, state: _State) -> tuple[Array, Array]:
        """Displacement (6,) of ``state`` from the reference, and its derivative (6, 6) by the disturbance
        of the pose in the map frame."""
        reference = self._reference
        lever = state.pose.rotation @ reference.origin
        tilt_x, tilt_y, twist = swing_twist(state.pose.rotation @ reference.rotation.T)
        displacement = np.empty(6)
        displacement[:3] = state.pose.translation + lever - reference.place
        displacement[3:] = tilt_x, tilt_y, unwrap_near(twist, state.psi - reference.psi)
        jacobian = lever_jacobian(lever)
        jacobian[3:, 3:] = swing_twist_jacobian(tilt_x, tilt_y)
        return displacement, jacobian

    def _no_pose(self, localizations: Localizations, status: Status, reason: str) -> CyclePose:
        nan6, nan66, n = np.full(6, np.nan), np.full((6, 6), np.nan), len(localizations)
        nan = math.nan
        return CyclePose(
            stamp_ns=localizations.stamp_ns,
            frame_id=localizations.frame_id,
            frame_counter=localizations.frame_counter,
            cycle=localizations.cycle,
            body=self.body,
            status=status,
            reason=reason,
            reference_version=self._reference.version,
            rotation=np.full((3, 3), nan),
            translation=np.full(3, nan),
            covariance=nan66,
            displacement=nan6,
            displacement_covariance=nan66,
            angles=PaperAngles(nan, nan, nan, nan, nan, nan, False, False),
            increment=nan6,
            increment_covariance=nan66,
            increment_cycles=0,
            residual_rms_xy=nan,
            residual_rms_z=nan,
            chi_square=nan,
            particles_used=0,
            particles_seen=n,
            particles_expected=0,
            particle_id=np.full(n, -1, np.int32),
            residual=np.full((n, 3), nan),
            latency=localizations.latency,
        )


def _scaled(covariance: Array, factor: Array) -> Array:
    """Covariances (n, 3, 3) with their lateral and axial variances multiplied by ``factor`` (n, 2)."""
    root = np.sqrt(factor)[:, [0, 0, 1]]
    return covariance * root[:, :, None] * root[:, None, :]


def _weights(covariance: Array, full: Mask) -> Array:
    """Inverse covariances (n, 3, 3); where not ``full``, of x and y alone."""
    weight = np.zeros_like(covariance)
    weight[full] = np.linalg.inv(covariance[full])
    weight[~full, :2, :2] = np.linalg.inv(covariance[~full, :2, :2])
    return weight


def _too_few(localizations: Localizations, view: _View) -> str:
    if len(localizations) == 0:
        return "no particles seen"
    count = f"{len(view.of)} usable of {len(localizations)} localizations"
    return f"{count}, {int(view.has_z.sum())} with z: too few"


def _check_shapes(localizations: Localizations) -> None:
    n = len(localizations.position)
    for name, shape in (("position", (n, 3)), ("covariance", (n, 3, 3)), ("flags", (n,))):
        found = np.shape(getattr(localizations, name))
        if found != shape:
            raise InputError(f"localizations.{name}", f"shape {found}", f"shape {shape}")
