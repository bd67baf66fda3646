"""What the pose is measured by, always against truth that nothing was fitted to: the table of the figures is
in ``validation_table.py``.

Here localizations are synthetic (``synthetic.py``): thousands of cycles in seconds, noise known exactly. The
whole way from rendered frames through calibration and fits is in ``validation_optics.py``.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from mems6dof_ros.analysis.truth import TruthComparison, compare
from mems6dof_ros.frame import GroundTruth
from mems6dof_ros.localization.localizations import Localizations
from mems6dof_ros.pose.angles import swing_twist, unwrap_near
from mems6dof_ros.pose.bodies import Bodies, relative_pose
from mems6dof_ros.pose.cycle_pose import CyclePose
from mems6dof_ros.pose.estimator import PoseEstimator, PoseSettings, Region
from mems6dof_ros.pose.rigid import RigidPose, exp_so3, log_so3
from mems6dof_ros.pose.solve import pose_jacobian
from mems6dof_ros.pose.synthetic import GearMotion, Scene, SyntheticGear, make_localizations, merged

Array = NDArray[np.float64]


#: A valid pose with a NEES beyond this is wrong: chance gives one in 1e10.
WRONG = 60.0


@dataclass
class Run:
    """Cycles of one body, with what is known to be true of them.

    ``wrong_identities``: sightings given an identity that belongs to another particle; ``seconds``:
    processor time of each update, ``learning``: of what it leaves to do after the pose is out.
    """

    poses: list[CyclePose] = field(default_factory=list)
    truths: list[GroundTruth] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    learning: list[float] = field(default_factory=list)
    wrong_identities: int = 0
    _owner: dict[int, int] = field(default_factory=dict)

    def update(
        self, estimator: PoseEstimator, gear: SyntheticGear, seen: Localizations, truth: GroundTruth
    ) -> CyclePose:
        """Feed one cycle and keep its outcome."""
        start = time.thread_time()  # other processes must not count
        pose = estimator.update(seen)
        out = time.thread_time()
        estimator.learn()
        self.seconds.append(out - start)
        self.learning.append(time.thread_time() - out)
        self.add(pose, truth, gear.last_identity)
        return pose

    def add(self, pose: CyclePose, truth: GroundTruth, identity: NDArray[np.int64]) -> None:
        """Keep one cycle; ``identity`` (n,): the true particle of each localization, -1 for none."""
        self.poses.append(pose)
        self.truths.append(truth)
        for claimed, true in zip(pose.particle_id.tolist(), identity.tolist(), strict=True):
            if claimed >= 0 and self._owner.setdefault(claimed, true) != true:
                self.wrong_identities += 1

    @property
    def lost(self) -> int:
        """Cycles without a valid pose."""
        return sum(not pose.valid for pose in self.poses)

    def comparison(self) -> TruthComparison:
        """Against truth; see analysis/truth.py for the constants that are fitted."""
        return compare(self.poses, self.truths)

    @property
    def wrong_poses(self) -> int:
        """Valid poses that are far off what they claim."""
        return int((self.comparison().nees > WRONG).sum())

    def turns_off(self) -> int:
        """Valid cycles whose unwrapped psi differs from truth by whole turns."""
        difference = [
            p.displacement[5] - t.psi for p, t in zip(self.poses, self.truths, strict=True) if p.valid
        ]
        return int((np.abs(np.array(difference) - difference[0]) > 0.1).sum())


def follow(
    scene: Scene,
    seed: int,
    cycles: int,
    settings: PoseSettings | None = None,
    steps: Iterable[tuple[float | None, int]] | None = None,
) -> Run:
    """Run an estimator over ``cycles`` observations; ``steps``: (rad per cycle, cycles) before each but the
    first, None for the motion's own."""
    gear, estimator, run = SyntheticGear(scene, seed), PoseEstimator(settings), Run()
    plan = iter(steps) if steps is not None else iter([(None, 1)] * cycles)
    for index in range(cycles):
        if index:
            gear.advance(*next(plan))
        run.update(estimator, gear, *gear.observe())
    return run


def chained_nees(seed: int, cycles: int = 60) -> float:
    """NEES/6 of the last of ``cycles`` poses registered each to the micrograph before, against truth since
    the first micrograph. Constants fitted to all of a random walk would swallow a good part of it."""
    settings = PoseSettings(reference="previous", recentre_at=())
    return nees_since_first(follow(Scene(particles=60), seed, cycles, settings), cycles - 1)


#: A ring gear, of which the field shows an arc of 36 degrees: after 20 cycles all particles are others.
RING_GEAR = Scene(
    particles=400, radius=410e-6, inner_radius=310e-6,
    motion=GearMotion(centre=(474e-6, 0.0), step=math.radians(-1.8), step_sd=math.radians(0.04)),
)  # fmt: skip


def nees_since_first(run: Run, index: int) -> float:
    """NEES/6 of one pose of ``run`` against truth since the first, which alone ties the frames together."""
    first, last, true_first, true_last = run.poses[0], run.poses[index], run.truths[0], run.truths[index]
    body = RigidPose(first.rotation, first.translation).then(
        RigidPose(true_first.rotation, true_first.translation).inverse()
    )
    true = body.then(RigidPose(true_last.rotation, true_last.translation))
    error = np.r_[last.translation - true.translation, log_so3(last.rotation @ true.rotation.T)]
    # The first micrograph's own noise is in the frame that its particles define.
    return float(error @ np.linalg.solve(last.covariance + first.covariance, error)) / 6


def theory(truth: GroundTruth, sd_xy: float, sd_z: float) -> Array:
    """Standard deviations (6,) that noise alone allows about the body's origin, the constellation being
    known: ``(sum J^T S^-1 J)^-1`` over the particles of ``truth`` ."""
    body = (truth.position - truth.translation) @ truth.rotation
    jacobian = pose_jacobian(body, truth.rotation)
    weight = np.array([sd_xy, sd_xy, sd_z]) ** -2.0
    return np.sqrt(np.diag(np.linalg.inv(np.einsum("nia,i,nib->ab", jacobian, weight, jacobian))))


def precision(count: int, seeds: Sequence[int], cycles: int) -> tuple[Array, Array]:
    """Rms error (6,) and theoretical precision (6,) of ``count`` particles, all of them always in view and
    noise alone acting, once the map has settled (the second half of ``cycles``)."""
    scene = Scene(particles=count, radius=125e-6, motion=GearMotion(centre=(0.0, 0.0)))
    measured, allowed = [], []
    for seed in seeds:
        run = follow(scene, seed, cycles, PoseSettings(field_degree=0, recentre_at=()))
        measured.append(run.comparison().between(cycles // 2, cycles).rms)
        allowed += [theory(truth, scene.sd_xy, scene.sd_z) for truth in run.truths[cycles // 2 :]]
    return np.sqrt(np.mean(np.square(measured), axis=0)), np.sqrt(np.mean(np.square(allowed), axis=0))


def error_ratio(runs: Sequence[Run], others: Sequence[Run]) -> float:
    """Error of ``runs`` over that of ``others``: mean squares pooled over the runs (a mean of ratios would be
    biased up), rms over the degrees of freedom."""
    squares, other = (np.mean([run.comparison().rms ** 2 for run in each], axis=0) for each in (runs, others))
    return float(np.sqrt(np.mean(squares / other)))


def unsteady_steps(seed: int, cycles: int) -> list[tuple[float | None, int]]:
    """A drive at its worst: regular steps, stalls, reversals, any step to 30 degrees, skipped teeth, and
    ten frames lost, in random order."""
    random = np.random.default_rng([seed, 5])
    tooth = GearMotion().step
    steps: list[tuple[float | None, int]] = []
    for kind in random.integers(6, size=cycles):
        anything = float(random.uniform(0, math.radians(30)))
        steps.append(((None, 1), (0.0, 1), (-tooth, 1), (anything, 1), (2 * tooth, 1), (None, 11))[kind])
    return steps


@dataclass(frozen=True)
class Interruption:
    """Outcome of a view that was taken away: cycles that claimed a pose meanwhile, cycles after its
    return until a valid pose, and whether that pose was right."""

    claimed: int
    cycles_to_return: int
    right: bool


def interrupt(kind: str, seed: int, cycles: int = 5) -> Interruption:
    """Take the view away for ``cycles``: ``covered`` (nothing, or a few false spots), ``shifted``, or
    ``another`` constellation in its place."""
    scene = Scene(missing=0.05, spurious=0.05)
    gear, other, estimator, run = (
        SyntheticGear(scene, seed),
        SyntheticGear(scene, seed + 1000),
        PoseEstimator(),
        Run(),
    )
    claimed = 0
    random = np.random.default_rng([seed, 6])
    for index in range(30 + cycles + 10):
        if index:
            gear.advance()
        away = 30 <= index < 30 + cycles
        seen, truth = gear.observe(shift=(60e-6, -35e-6) if away and kind == "shifted" else (0.0, 0.0))
        if not away:
            run.update(estimator, gear, seen, truth)
            continue
        if kind == "covered":
            count = 6 * (index % 2)
            ghosts = np.c_[random.uniform(-120e-6, 120e-6, (count, 2)), np.zeros(count)]
            seen = make_localizations(ghosts, np.full((count, 3), 1e-17), gear.cycle)
        elif kind == "another":
            other.cycle = gear.cycle
            seen, _ = other.observe()
        claimed += estimator.update(seen).valid
    after = run.poses[30:]
    back = next((i for i, pose in enumerate(after, 1) if pose.valid), len(after) + 1)
    return Interruption(claimed, back, run.wrong_poses == 0 and run.turns_off() == 0)


def two_bodies(seed: int, cycles: int, particles: int = 40) -> tuple[list[Run], list[Run]]:
    """Two discs turning differently in one field, whose error neither claims: measured together, and each
    alone."""
    disc = Scene(particles=particles, radius=55e-6, field_error_xy=5e-9, field_error_z=30e-9)
    other = GearMotion(centre=(63e-6, -2e-6), step=math.radians(-7.1), step_sd=math.radians(0.3))
    scenes = [replace(disc, motion=GearMotion(centre=(-62e-6, 3e-6))), replace(disc, motion=other)]
    regions = [Region(centre=scene.motion.centre, outer_radius=62e-6) for scene in scenes]
    settings = PoseSettings(field_size=disc.field)
    names = ["load_gear", "coupler"]
    gears = [
        SyntheticGear(scene, seed + 100 * i, name, optics=seed)
        for i, (scene, name) in enumerate(zip(scenes, names, strict=True))
    ]
    together = Bodies(
        [PoseEstimator(settings, name, region) for name, region in zip(names, regions, strict=True)]
    )
    alone = [PoseEstimator(settings, name) for name in names]
    joint, single = [Run(), Run()], [Run(), Run()]
    for index in range(cycles):
        if index:
            for gear in gears:
                gear.advance()
        views = [gear.observe() for gear in gears]
        seen, order = merged([view for view, _ in views], seed + index)
        for body, pose in enumerate(together.update(seen)):
            # Identities of the other body count as none: taking one of them is an error.
            sizes = [len(view) for view, _ in views]
            identity = np.full(sum(sizes), -1)
            start = sum(sizes[:body])
            identity[start : start + sizes[body]] = gears[body].last_identity
            joint[body].add(pose, views[body][1], identity[order])
        for body, estimator in enumerate(alone):
            single[body].update(estimator, gears[body], *views[body])
    return joint, single


def relative_nees(of: Run, to: Run) -> float:
    """NEES/6 of the pose of one body in the frame of another, over the cycles of both."""
    errors, values = (of.comparison().error, to.comparison().error), []
    for pose, other, error, of_other in zip(of.poses, to.poses, *errors, strict=True):
        _, covariance = relative_pose(pose, other)
        moved = np.cross(of_other[3:], pose.translation - other.translation)
        apart = np.stack([error[:3] - of_other[:3] - moved, error[3:] - of_other[3:]]) @ other.rotation
        values.append(apart.ravel() @ np.linalg.solve(covariance, apart.ravel()) / 6)
    return float(np.mean(values))


def nees_once_recentred(run: Run, cycles: int = 12) -> float:
    """NEES/6 of the first ``cycles`` of reference version 2: little is known then of the field error, but the
    constants fitted are those of all its poses."""
    nees, version = run.comparison().nees, run.comparison().reference_version
    return float(nees[version == 2][:cycles].mean()) / 6


@dataclass(frozen=True)
class Angles:
    """Published angles of the n cycles after the first beside the true ones of the same body frame.

    ``not_finite``: numbers among them that are none; ``tilt`` (n,): true tilt over its standard deviation;
    ``alpha``, ``beta`` (n,): whether they are claimed to be determined; over their standard deviations,
    ``alpha_error`` (n,) and ``psi_jump`` (n,): change of psi from the cycle before less the true one.
    """

    not_finite: int
    tilt: Array
    alpha: NDArray[np.bool_]
    beta: NDArray[np.bool_]
    alpha_error: Array
    psi_jump: Array


def angles(play_tilt: float, seed: int, cycles: int) -> Angles:
    """The angles of a body whose axis has no tilt but ``play_tilt``, rad, over ``cycles``.

    An axis has no tilt where it is parallel to that of the reference pose, whose own noise would tilt all
    cycles by one standard deviation: here the first micrograph is exposed long enough not to.
    """
    scene = Scene(motion=GearMotion(nutation=0.0, play_tilt=play_tilt))
    gear, estimator, run = SyntheticGear(scene, seed), PoseEstimator(), Run()
    gear.scene = replace(scene, sd_xy=0.01 * scene.sd_xy, sd_z=0.01 * scene.sd_z)
    run.update(estimator, gear, *gear.observe())
    gear.scene = scene
    for _ in range(cycles):
        gear.advance()
        run.update(estimator, gear, *gear.observe())
    numbers = np.array([[*vars(pose.angles).values(), *pose.displacement] for pose in run.poses])
    valid = [(pose, truth) for pose, truth in zip(run.poses, run.truths, strict=True) if pose.valid]
    true = []
    for (pose, truth), error in zip(valid, run.comparison().error, strict=True):
        tilt_x, tilt_y, psi = swing_twist(exp_so3(-error[3:]) @ pose.rotation)
        true.append((tilt_x, tilt_y, unwrap_near(psi, truth.psi - run.truths[0].psi)))
    psi_error = np.array([pose.displacement[5] for pose, _ in valid]) - np.array(true)[:, 2]
    tilt, later = np.array(true)[1:, :2], [pose for pose, _ in valid[1:]]
    covariance = np.array([pose.displacement_covariance[3:5, 3:5] for pose in later])
    claims = [pose.angles for pose in later]
    off = np.array([claim.alpha for claim in claims]) - np.arctan2(-tilt[:, 0], tilt[:, 1])
    return Angles(
        int((~np.isfinite(numbers)).sum()),
        np.sqrt(np.einsum("ni,nij,nj->n", tilt, np.linalg.inv(covariance), tilt)),
        np.array([claim.alpha_valid for claim in claims]),
        np.array([claim.beta_valid for claim in claims]),
        (off - math.tau * np.round(off / math.tau)) / [claim.sd_alpha for claim in claims],
        np.diff(psi_error) / np.sqrt([pose.increment_covariance[5, 5] for pose in later]),
    )


def solve_time(seed: int, cycles: int = 300) -> tuple[Array, Array]:
    """Processor times s of ``cycles`` updates with about 100 particles in view and a map that has seen a
    revolution: until the pose is out (cycles,), and of the learning after it (cycles,)."""
    run = follow(Scene().with_visible(100), seed, 100 + cycles)
    return np.array(run.seconds[100:]), np.array(run.learning[100:])
