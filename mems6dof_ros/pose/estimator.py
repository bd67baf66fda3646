"""PoseEstimator: localizations of a motion cycle in, pose of the body in six degrees of freedom out."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from functools import partial
from statistics import median

import numpy as np
from numpy.typing import NDArray

from mems6dof_ros.errors import InputError
from mems6dof_ros.localization.localizations import Localizations
from mems6dof_ros.pose.angles import swing_twist, unwrap_near
from mems6dof_ros.pose.body_frame import BodyFrame, State, no_pose, report
from mems6dof_ros.pose.centre import CentreOfRotation
from mems6dof_ros.pose.constellation import Candidates, Constellation
from mems6dof_ros.pose.constellation_file import ReferenceConstellation
from mems6dof_ros.pose.cycle_pose import CyclePose, Status
from mems6dof_ros.pose.field import FieldError
from mems6dof_ros.pose.registration import ConstellationIndex, closest_points, log10_false_alarms
from mems6dof_ros.pose.rigid import RigidPose, rotation_z
from mems6dof_ros.pose.settings import PoseSettings, Region
from mems6dof_ros.pose.solve import FULL, LATERAL, UNUSED, Solution, pose_jacobian, solve_pose, weights
from mems6dof_ros.pose.usable import Usable, scaled, usable

__all__ = ["PoseEstimator", "PoseSettings", "Region"]

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]

#: The centre of rotation counts as known below this standard deviation, m.
CENTRE_KNOWN = 20e-6
#: How far inside the field's edge a particle must be to be expected, m.
EDGE = 2e-6
#: Agreement of a pair's length in the global match, m: some standard deviations and the field error.
PAIR_TOLERANCE = 50e-9
#: Degrees of freedom behind, and remembered of, the noise level of all particles.
NOISE_PRIOR, NOISE_MEMORY = 50.0, 20_000.0


class PoseEstimator:
    """Pose of one rigid body, cycle after cycle.

    ``region``: where in the field the body is; None: anywhere. ``reference``: a constellation of an earlier
    session to start from; None: the first cycle founds one. ``field``: what is known of the field error,
    perhaps shared with other bodies; None: what the settings assume. ``constellation``, ``candidates`` and
    ``centre`` may be read at any time, and are those of the last ``learn``.
    """

    def __init__(
        self,
        settings: PoseSettings | None = None,
        body: str = "load_gear",
        region: Region | None = None,
        reference: ReferenceConstellation | None = None,
        field: FieldError | None = None,
    ) -> None:
        self.settings = settings or PoseSettings()
        self.body, self.region, self.reference, self.field = body, region, reference, field
        self._next_id = 0  # versions and identities are never used twice
        self._begin(1)

    def reset(self) -> None:
        """Forget everything measured: the next cycle founds a new constellation and reference."""
        self._begin(self._frame.version + (self._last is not None))

    def _begin(self, version: int) -> None:
        self._frame = BodyFrame(version, np.eye(3), np.zeros(3), np.zeros(3), 0.0)
        self._last_frame: tuple[int, int] | None = None
        self._forget()

    def _forget(self) -> None:
        self.constellation: Constellation | None = None
        if self.field is not None:
            self.field.forget(self.body)
        self.candidates = Candidates()
        self.centre = CentreOfRotation()
        self._index: tuple[tuple[int, int], ConstellationIndex] | None = None
        self._last: State | None = None
        self._steps: deque[float] = deque(maxlen=15)
        self._recentred = 0
        # Squared residuals over degrees of freedom, in xy and z: the noise against what is claimed.
        self._noise = np.full((2, 2), NOISE_PRIOR)
        self._half_field = np.zeros(2)
        self._place = np.zeros(2)
        # Chained registration: error handed on, and which of the latest localizations the pose is from.
        self._chained = np.zeros((6, 6))
        self._in_solution = np.empty(0, bool)
        self._lesson: Callable[[], None] | None = None

    # ------------------------------------------------------------------------------- cycles

    def update(self, localizations: Localizations, available: Mask | None = None) -> CyclePose:
        """Pose of the body in this cycle, from the localizations ``available`` (n,) (None: all).

        Bad data give a pose that says what is wrong; InputError is raised only where the arrays do not fit
        together. What this cycle teaches of the map is left to ``learn``.
        """
        self.learn()
        order = (localizations.cycle, localizations.frame_counter)
        if self._last_frame is not None and order <= self._last_frame:
            cycle, frame = self._last_frame
            when = "again" if order == self._last_frame else f"after cycle {cycle}, frame {frame}"
            reason = f"cycle {order[0]}, frame {order[1]} arrived {when}: ignored; reset to start anew"
            return self._lost(localizations, reason)
        view = usable(localizations, available, self.settings.beyond_calibration)
        self._last_frame = order
        if self.region is not None:
            view = view.only(self.region.contains(view.position))
        if self.constellation is None and self.reference is not None:
            self._adopt(self.reference, view)
        if self.constellation is None:
            return self._found(localizations, view)
        if len(view.of) < self.settings.min_particles:
            return self._lost(localizations, _too_few(localizations, view))
        return self._track(localizations, view, self.constellation)

    def learn(self) -> None:
        """Refine the map by the latest cycle: milliseconds now and then, so publish the pose first. The next
        update begins with it where nobody has called."""
        lesson, self._lesson = self._lesson, None
        if lesson is not None:
            lesson()

    def predict(self, cycle: int) -> tuple[Indices, Array] | None:
        """Identities (n,) and predicted positions (n, 3) m of the particles expected inside the field in
        ``cycle``; None while there is no pose to predict from."""
        self.learn()
        if self.constellation is None or self._last is None:
            return None
        pose, _, _ = self._predicted(self._last, cycle)
        position = pose.apply(self.constellation.position)
        expected = self.constellation.active & self._inside(position)
        return self.constellation.ids[expected], position[expected]

    def set_reference(self) -> int:
        """Make the last valid pose the reference, its origin the centre of rotation as known now; returns
        the new reference version. Raises InputError before the first pose."""
        if self._last is None:
            raise InputError("set_reference", "no valid pose yet", "a pose to refer to")
        self.learn()
        self._refer_to(self._last)
        return self._frame.version

    def snapshot(self) -> ReferenceConstellation:
        """The constellation as known now, in the body frame. Raises InputError where there is none."""
        self.learn()
        if self.constellation is None:
            raise InputError("constellation", "none yet", "at least one cycle")
        return ReferenceConstellation.of(self.body, self.constellation, self._frame)

    # ----------------------------------------------------------------------------- founding

    def _found(self, localizations: Localizations, view: Usable, reason: str = "") -> CyclePose:
        """Found the constellation on this cycle; its pose is the reference."""
        s = self.settings
        if (view.good & view.has_z).sum() < max(s.min_particles, 4):
            return self._no_pose(localizations, Status.INITIALIZING, _too_few(localizations, view))
        view = view.only(view.good)
        # The map frame is the microscope frame of this cycle, moved to the height of the particles.
        height = float(np.median(view.position[view.has_z, 2]))
        pose = RigidPose(np.eye(3), np.array([0.0, 0.0, height]))
        constellation = self._empty_constellation(view)
        position, ids = view.position - pose.translation, self._new_ids(len(view.of))
        solution = solve_pose(
            pose, position, view.covariance * 1e-6, view.position, view.covariance, view.has_z,
            np.zeros((len(ids), 3, 0)), np.zeros((len(ids), 3, 3)), s.gate_xy, s.gate_z,
        )  # fmt: skip
        if not solution.ok:
            return self._no_pose(localizations, Status.INITIALIZING, "the particles do not fix a pose")
        constellation.found(ids, position, view.covariance, constellation.modes.evaluate(view.position))
        self.constellation, self._in_solution = constellation, np.ones(len(ids), bool)
        self._frame = self._frame._replace(
            rotation=np.eye(3), origin=np.zeros(3), place=pose.translation.copy(), psi=0.0
        )
        self._last = State(localizations.cycle, pose, 0.0, solution.noise, solution.noise)
        self.centre.add(pose.rotation, pose.translation)
        return report(
            localizations, self.body, self._frame, self._last, None, solution, view, ids, len(ids), reason
        )

    def _found_anew(self, localizations: Localizations, view: Usable) -> CyclePose:
        """What the only cycle so far saw was not found again: nothing can be built on it."""
        version = self._frame.version
        self._forget()
        self._frame = self._frame._replace(version=version + 1)
        return self._found(
            localizations, view, "the first particles were not found again: reference founded anew"
        )

    def _adopt(self, reference: ReferenceConstellation, view: Usable) -> None:
        """Start from the constellation of an earlier session."""
        constellation = self._empty_constellation(view)
        constellation.adopt(reference.ids, reference.position, reference.covariance)
        self._next_id = max(self._next_id, int(reference.ids.max(initial=-1)) + 1)
        self.constellation = constellation

    def _empty_constellation(self, view: Usable) -> Constellation:
        s = self.settings
        if s.field_size is not None:
            self._half_field = np.array(s.field_size) / 2
        else:
            self._half_field = np.abs(view.position[:, :2]).max(axis=0, initial=1e-6)
        # A chain of micrographs has no map from which a field error could be told.
        field = self.field if s.reference == "map" and s.field_degree else None
        field = field or FieldError.assumed(s, self._half_field)
        return Constellation(field, self.body, s.retire_after, s.overlap)

    # ----------------------------------------------------------------------------- tracking

    def _track(self, localizations: Localizations, view: Usable, constellation: Constellation) -> CyclePose:
        self._recentre()
        s, last = self.settings, self._last
        if s.field_size is None:
            self._half_field = np.maximum(self._half_field, np.abs(view.position[:, :2]).max(axis=0))
        known = np.flatnonzero(constellation.active)
        predicted, psi_predicted, sd_psi = (
            self._predicted(last, localizations.cycle) if last else (None, 0.0, 0.0)
        )
        found = self._register(view, constellation, known, predicted, sd_psi)
        if found is None:
            if constellation.cycles == 1:
                return self._found_anew(localizations, view)
            reason = f"{len(view.of)} localizations do not fit the constellation of {len(known)} particles"
            return self._lost(localizations, reason)
        start, match = found
        part = np.flatnonzero((match >= 0) & view.good)
        rows, seen = match[part], view.only(part)
        ids = constellation.ids[rows]
        modes = constellation.modes.evaluate(seen.position)
        factor = constellation.noise_factor(rows) * (self._noise[0] / self._noise[1])
        noise = scaled(seen.covariance, factor)
        relative = constellation.relative(rows, start, noise, seen.has_z, modes)
        field = constellation.correction(start, seen.position, modes)
        solution = solve_pose(
            start, constellation.position[rows], relative.covariance, seen.position - field, noise,
            seen.has_z, relative.response, relative.spread, s.gate_xy, s.gate_z,
        )  # fmt: skip
        used, used_z = int((solution.use > UNUSED).sum()), int((solution.use == FULL).sum())
        if not solution.ok or used < s.min_particles:
            return self._lost(
                localizations, f"{used} particles agree, {used_z} also in z: too few for a pose"
            )
        implausible = self._implausible(solution.pose)
        if implausible:
            return self._lost(localizations, implausible)

        chained = self._chained
        covariance = solution.covariance + relative.of_pose(solution.pose.rotation, solution.gain)
        if s.reference == "previous":
            chained = chained + _exchanged(constellation, solution, rows, self._in_solution)
            covariance = chained + solution.noise
        if not (np.diag(covariance) > 0).all():
            return self._lost(localizations, "the particles do not fix a pose")
        self._chained = chained
        psi = unwrap_near(swing_twist(solution.pose.rotation)[2], psi_predicted)
        state = State(localizations.cycle, solution.pose, psi, covariance, solution.noise)
        inside = constellation.active & self._inside(state.pose.apply(constellation.position))
        expected = int(inside.sum())
        self._learn_noise(constellation, rows, solution)
        if s.reference == "previous":
            in_solution = np.zeros(len(view.of), bool)
            in_solution[part] = solution.use > UNUSED
            self._lesson = partial(self._follow, view, constellation, state.pose, match, in_solution)
        else:
            self._lesson = partial(
                self._learn, view, constellation, state, solution, match, part, noise, modes, inside
            )
        if last is None:
            # The first pose in an adopted constellation is the reference; its frame is at the centre.
            self._frame = BodyFrame(
                self._frame.version, state.pose.rotation, np.zeros(3), state.pose.translation.copy(), psi
            )
            self._place = state.pose.translation[:2].copy()
        elif localizations.cycle > last.cycle:
            self._steps.append((psi - last.psi) / (localizations.cycle - last.cycle))
        self.centre.add(state.pose.rotation, state.pose.translation)
        self._last = state
        doubt = self._doubt(used, expected, sd_psi)
        return report(
            localizations, self.body, self._frame, state, last, solution, seen, ids, expected, doubt
        )

    def _predicted(self, last: State, cycle: int) -> tuple[RigidPose, float, float]:
        """Predicted pose of the map frame, its psi, and the standard deviation of psi."""
        elapsed = cycle - last.cycle
        step = median(list(self._steps)[-5:]) if self._steps else 0.0
        # Without measured steps anything may happen; a degree per cycle lets the search begin.
        spread = math.radians(1)
        if len(self._steps) > 2:
            spread = 1.5 * median(abs(other - step) for other in self._steps) + 1e-4
        sd = spread * math.sqrt(max(elapsed, 0)) + 0.1 * abs(step) * math.sqrt(max(elapsed - 1, 0))
        turn = rotation_z(step * elapsed)
        place = np.zeros(3)
        centre = self.centre.estimate()
        if centre is not None and centre.sd < CENTRE_KNOWN:
            place[:2] = centre.microscope
        pose = RigidPose(turn @ last.pose.rotation, place + turn @ (last.pose.translation - place))
        return pose, last.psi + step * elapsed, sd

    def _register(
        self,
        view: Usable,
        constellation: Constellation,
        known: Indices,
        predicted: RigidPose | None,
        sd_psi: float,
    ) -> tuple[RigidPose, Indices] | None:
        """Start pose and, per localization, the row of its particle or -1; None: lost."""
        s = self.settings
        points = constellation.position[known]
        if predicted is not None:
            reach = 1e-6 + 3 * sd_psi * float(np.hypot(*self._half_field))
            found = self._closest(view, points, predicted, reach, tests=1.0)
            if found is not None:
                return found[0], np.where(found[1] >= 0, known[found[1]], -1)
        key = (constellation.cycles, len(known))
        if self._index is None or self._index[0] != key:
            self._index = (key, ConstellationIndex(points[:, :2]))
        enough = self._enough(len(view.of), len(known))
        measured = view.position[:, :2]
        guess = self._index[1].search(measured, PAIR_TOLERANCE, s.identity_gate, enough)
        if guess.inliers < 3:
            return None
        height = (
            predicted.translation[2] if predicted is not None else np.median(view.position[view.has_z, 2])
        )
        pose = RigidPose(rotation_z(guess.motion.angle), np.array([*guess.motion.shift, height]))
        found = self._closest(view, points, pose, 2 * s.identity_gate, tests=float(guess.tests))
        return None if found is None else (found[0], np.where(found[1] >= 0, known[found[1]], -1))

    def _closest(
        self, view: Usable, points: Array, predicted: RigidPose, reach: float, tests: float
    ) -> tuple[RigidPose, Indices] | None:
        """Closest points from ``predicted``, which is good to ``reach`` m; None where chance could do it."""
        s = self.settings
        wide = [gate for gate in s.gates if gate > reach]
        gates = np.array(wide[-1:] + [gate for gate in s.gates if gate <= reach])
        place = predicted.apply(points)
        motion, match = closest_points(place[:, :2], view.position[:, :2], gates, s.identity_gate)
        matched = int((match >= 0).sum())
        chance = self._chance(len(points))
        if (
            matched < s.min_particles
            or log10_false_alarms(matched, len(match), chance, tests) > s.max_false_alarms
        ):
            return None
        turn = rotation_z(motion.angle)
        translation = turn @ predicted.translation
        translation[:2] += motion.shift
        return RigidPose(turn @ predicted.rotation, translation), match

    def _chance(self, particles: int) -> float:
        """Probability that a random localization is taken for some particle."""
        area = float(4 * np.prod(self._half_field))
        return min(1.0, particles * math.pi * self.settings.identity_gate**2 / area)

    def _enough(self, points: int, particles: int) -> int:
        """Agreements that chance does not give in 1e5 hypotheses."""
        chance = self._chance(particles)
        for inliers in range(self.settings.min_particles, points):
            if log10_false_alarms(inliers, points, chance, 1e5) < self.settings.max_false_alarms:
                return inliers
        return points

    def _implausible(self, pose: RigidPose) -> str:
        """Why a well-matched pose is no motion of the body by itself, in words; empty: it may be one."""
        s = self.settings
        tilt_x, tilt_y, psi = swing_twist(pose.rotation)
        tilt = math.hypot(tilt_x, tilt_y)
        if tilt > s.max_tilt and self.reference is None:
            return f"tilt of {tilt * 1e3:.1f} mrad is beyond max_tilt ({s.max_tilt * 1e3:.1f} mrad)"
        centre = self.centre.estimate()
        if centre is not None and centre.sd < CENTRE_KNOWN:
            point, place, doubt = centre.body, centre.microscope, 3 * centre.sd
        elif self._last is not None:
            point, place, doubt = np.zeros(2), self._place, s.max_centre_distance
        else:
            return ""
        now = pose.apply(np.array([point[0], point[1], 0.0]))
        moved = math.hypot(now[0] - place[0], now[1] - place[1])
        if moved > s.max_displacement + 2 * abs(math.sin(psi / 2)) * doubt:
            return (
                f"centre displaced by {moved * 1e6:.1f} um, beyond max_displacement "
                f"({s.max_displacement * 1e6:.1f} um): the view was shifted"
            )
        return ""

    def _doubt(self, used: int, expected: int, sd_psi: float) -> str:
        """What makes a valid pose less than it should be, in words."""
        if sd_psi > math.radians(60):
            return "whole turns of psi uncertain after the cycles lost"
        if used < 0.5 * expected:
            return f"only {used} of {expected} expected particles agree"
        return ""

    def _inside(self, position: Array) -> Mask:
        """Where ``position`` (n, 3) m should be seen, away from the edges."""
        inside = np.asarray((np.abs(position[:, :2]) < self._half_field - EDGE).all(axis=1))
        if self.region is not None:
            inside = inside & self.region.contains(position)
        return inside

    # ----------------------------------------------------------------------------- learning

    def _learn(
        self, view: Usable, constellation: Constellation, state: State, solution: Solution, match: Indices,
        part: Indices, noise: Array, modes: Array, inside: Mask,
    ) -> None:  # fmt: skip
        """Refine the map and its membership by one cycle; ``part`` (n,): localizations in the solution, with
        ``noise`` (n, 3, 3)."""
        rows, good = match[part], solution.use > UNUSED
        seen = match[match >= 0]
        missed = inside.copy()
        missed[seen] = False
        outlying = np.column_stack([~good, view.has_z[part] & (solution.use == LATERAL)])
        retired = constellation.count(seen, np.flatnonzero(missed), rows, outlying)
        newcomers = view.only((match < 0) & view.good & view.has_z)
        joined, index = self._recruit(newcomers, constellation, state, rows, modes, solution)
        rows, position = rows[good], view.position[part[good]]
        weight, modes = weights(noise[good], solution.use[good] == FULL), modes[good]
        if len(joined):
            newcomers = newcomers.only(index)
            rows, position = np.r_[rows, joined], np.r_[position, newcomers.position]
            weight = np.r_[weight, np.linalg.inv(newcomers.covariance)]
            modes = np.r_[modes, constellation.modes.evaluate(newcomers.position)]
        offset = position - state.pose.apply(constellation.linearisation(rows))
        constellation.observe(rows, state.pose, offset, weight, modes)
        if len(retired):
            self.candidates.add(
                constellation.ids[retired], constellation.position[retired],
                constellation.covariance[retired], former=True,
            )  # fmt: skip
        if constellation.due:
            constellation.refine()

    def _learn_noise(self, constellation: Constellation, rows: Indices, solution: Solution) -> None:
        """Compare the residuals with what the covariances claim, over all particles and for each."""
        squares, freedom = solution.squares, solution.freedom
        constellation.learn_noise(rows, squares * constellation.noise_factor(rows), freedom)
        self._noise += squares.sum(axis=0) * (self._noise[0] / self._noise[1]), freedom.sum(axis=0)
        self._noise /= np.maximum(1.0, self._noise[1] / NOISE_MEMORY)

    def _recruit(
        self, newcomers: Usable, constellation: Constellation, state: State, rows: Indices, modes: Array,
        solution: Solution,
    ) -> tuple[Indices, Indices]:  # fmt: skip
        """Follow localizations of no known particle; what moves with the body joins the map. The ``solution``
        is by particles ``rows`` (n,) at ``modes`` (n, 3, k) of the field. Returns the rows (j,) of those that
        joined, and which of the ``newcomers`` they are."""
        pose, candidates, gate = state.pose, self.candidates, self.settings.identity_gate
        none = np.empty(0, np.int64)
        if not len(newcomers.of) and not len(candidates):
            return none, none
        field = constellation.correction(
            pose, newcomers.position, constellation.modes.evaluate(newcomers.position)
        )
        place = pose.inverse().apply(newcomers.position - field)
        jacobian = pose_jacobian(place, pose.rotation)
        covariance = newcomers.covariance + jacobian @ state.noise @ jacobian.transpose(0, 2, 1)
        covariance = pose.rotation.T @ covariance @ pose.rotation
        separation = _separation(place, candidates.position)
        again = np.flatnonzero(separation.min(axis=1, initial=np.inf) < gate)
        seen, first = np.unique(separation[again].argmin(axis=1) if len(again) else again, return_index=True)
        missed = self._inside(pose.apply(candidates.position))
        missed[seen] = False
        known = constellation.position[constellation.active]
        fresh = separation.min(axis=1, initial=np.inf) >= gate
        # No two spheres of a micrometre in one place.
        fresh &= _separation(place, known).min(axis=1, initial=np.inf) > 1e-6
        ids, new = candidates.ids[seen], self._new_ids(int(fresh.sum()))
        index = dict(zip([*ids, *new], [*again[first], *np.flatnonzero(fresh)], strict=True))
        candidates.count(seen, place[again[first]], covariance[again[first]], missed)
        candidates.add(new, place[fresh], covariance[fresh], former=False)
        ready = candidates.sightings >= self.settings.confirm_after
        if not ready.any():
            return none, none
        position, ids = candidates.position[ready], candidates.ids[ready]
        # They are where they are seen from this pose, and its errors are theirs.
        lever = pose.rotation.T @ pose_jacobian(position, pose.rotation) @ solution.gain
        response = modes + pose.rotation @ constellation.coupling[rows]
        response = response.reshape(3 * len(rows), modes.shape[2])
        coupling = lever @ response - pose.rotation.T @ constellation.modes.evaluate(pose.apply(position))
        share = (lever.reshape(-1, len(rows), 3) @ pose.rotation).reshape(-1, 3 * len(rows))
        joined = len(constellation) + np.arange(len(ids))
        constellation.add(ids, position, candidates.covariance[ready], coupling, (rows, share))
        candidates.keep(~ready)
        return joined, np.array([index[each] for each in ids])

    def _follow(
        self, view: Usable, constellation: Constellation, pose: RigidPose, match: Indices, in_solution: Mask
    ) -> None:
        """Chained registration: this cycle's localizations are the constellation of the next."""
        ids = np.where(match >= 0, constellation.ids[match], -1)
        ids[match < 0] = self._new_ids(int((match < 0).sum()))
        seen, ids = view.only(view.good), ids[view.good]
        successor = self._empty_constellation(seen)
        turned = pose.rotation.T @ seen.covariance @ pose.rotation
        coupling = -pose.rotation.T @ successor.modes.evaluate(seen.position)
        successor.add(ids, pose.inverse().apply(seen.position), turned, coupling)
        successor.cycles = constellation.cycles + 1
        self.constellation, self._in_solution = successor, in_solution[view.good]

    # ---------------------------------------------------------------------------- reference

    def _recentre(self) -> None:
        """Move the origin to the centre of rotation once the turns that the settings name are reached."""
        due, frame, last = self.settings.recentre_at, self._frame, self._last
        if last and self._recentred < len(due) and abs(last.psi - frame.psi) >= due[self._recentred]:
            self._recentred += 1
            pose = RigidPose(frame.rotation, frame.place - frame.rotation @ frame.origin)
            self._refer_to(last._replace(pose=pose, psi=frame.psi))

    def _refer_to(self, reference: State) -> None:
        """New version of the frames: the pose of ``reference``, origin at the centre as known now."""
        origin, centre, pose = self._frame.origin.copy(), self.centre.estimate(), reference.pose
        if centre is not None and centre.sd < self.settings.max_displacement:
            origin[:2] = centre.body
            if self._last is not None and self.constellation is not None:
                moved = self.constellation.define_frames(self._last.pose, centre.microscope)
                pose, self._last = moved(pose), self._last._replace(pose=moved(self._last.pose))
        self._frame = BodyFrame(
            self._frame.version + 1, pose.rotation, origin, pose.apply(origin), reference.psi
        )

    # ------------------------------------------------------------------------------ helpers

    def _new_ids(self, count: int) -> Indices:
        self._next_id += count
        return np.arange(self._next_id - count, self._next_id)

    def _lost(self, localizations: Localizations, reason: str) -> CyclePose:
        return self._no_pose(localizations, Status.LOST, reason)

    def _no_pose(self, localizations: Localizations, status: Status, reason: str) -> CyclePose:
        return no_pose(localizations, self.body, self._frame.version, status, reason)


def _exchanged(constellation: Constellation, solution: Solution, rows: Indices, before: Mask) -> Array:
    """Covariance (6, 6) that one link of a chain adds to all later poses.

    The noise n of the previous micrograph entered its own pose as P1 n, from the particles shared
    ``before``, and enters this one as -P2 n, from ``rows`` shared now: only (P1 - P2) n stays, nothing where
    all are the same.
    """
    rotation = solution.pose.rotation
    jacobian = pose_jacobian(constellation.position, rotation)
    weight = np.linalg.inv(rotation @ constellation.covariance @ rotation.T)
    information = jacobian.transpose(0, 2, 1) @ weight @ jacobian
    now = np.zeros(len(before), bool)
    now[rows[solution.use > UNUSED]] = True
    first, second = (np.linalg.pinv(information[part].sum(axis=0), hermitian=True) for part in (before, now))
    both = first @ information[before & now].sum(axis=0) @ second
    return np.asarray(first + second - both - both.T)


def _separation(one: Array, other: Array) -> Array:
    """Distances (n, m) in the plane between ``one`` (n, 3) and ``other`` (m, 3)."""
    return np.asarray(np.hypot(*(one[:, None, :2] - other[None, :, :2]).transpose(2, 0, 1)))


def _too_few(localizations: Localizations, view: Usable) -> str:
    if len(localizations) == 0:
        return "no particles seen"
    count = f"{len(view.of)} usable of {len(localizations)} localizations"
    return f"{count}, {int(view.has_z.sum())} with z: too few"
