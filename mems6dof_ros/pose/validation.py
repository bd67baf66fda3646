"""The acceptance figures of the pose, each against truth that nothing was fitted to.

Most use synthetic localizations (``synthetic.py``): thousands of cycles in seconds, noise known exactly. The
whole way from rendered frames through calibration and fits is in ``validation_optics.py``.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from mems6dof_ros.analysis.truth import TruthComparison, compare
from mems6dof_ros.figures import Figure, at_most, between, information
from mems6dof_ros.frame import GroundTruth
from mems6dof_ros.localization.localizations import Localizations
from mems6dof_ros.pose.bodies import Bodies, relative_pose
from mems6dof_ros.pose.cycle_pose import DEGREES_OF_FREEDOM, CyclePose
from mems6dof_ros.pose.estimator import PoseEstimator, PoseSettings, Region
from mems6dof_ros.pose.rigid import RigidPose, log_so3
from mems6dof_ros.pose.solve import pose_jacobian
from mems6dof_ros.pose.synthetic import GearMotion, Scene, SyntheticGear, make_localizations, merged
from mems6dof_ros.pose.validation_optics import OpticalRun, optical_chain

Array = NDArray[np.float64]


#: Limits of issue and demonstration alike: m, m, m, rad, rad, rad.
LIMITS = np.array([0.26e-9, 0.26e-9, 8e-9, 100e-6, 100e-6, 2.5e-6])
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


def precision(counts: Sequence[int], seeds: Sequence[int], cycles: int) -> dict[int, Array]:
    """Rms error over the theoretical precision, (6,), for each number of particles, all of them always in
    view and noise alone acting, once the map has settled (the second half of ``cycles``)."""
    ratios = {}
    for count in counts:
        scene = Scene(particles=count, radius=125e-6, motion=GearMotion(centre=(0.0, 0.0)))
        squares = []
        for seed in seeds:
            run = follow(scene, seed, cycles, PoseSettings(field_degree=0, recentre_at=()))
            late = run.comparison().between(cycles // 2, cycles)
            expected = np.array(
                [theory(truth, scene.sd_xy, scene.sd_z) for truth in run.truths[cycles // 2 :]]
            )
            squares.append((late.rms**2) / (expected**2).mean(axis=0))
        ratios[count] = np.sqrt(np.mean(squares, axis=0))
    return ratios


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


def solve_time(seed: int, cycles: int = 300) -> tuple[Array, Array]:
    """Processor times s of ``cycles`` updates with about 100 particles in view and a map that has seen a
    revolution: until the pose is out (cycles,), and of the learning after it (cycles,)."""
    run = follow(Scene().with_visible(100), seed, 100 + cycles)
    return np.array(run.seconds[100:]), np.array(run.learning[100:])


# ------------------------------------------------------------------------------------ the table


def figures(
    seeds: Sequence[int],
    progress: Callable[[int, int], None] = lambda done, total: None,
    drift_cycles: int = 2000,
    optical_cycles: int = 0,
) -> list[Figure]:
    """The table: everything above on all ``seeds``, rendered frames (``optical_cycles`` > 0) on three."""
    parts: list[Callable[[], list[Figure]]] = [
        lambda: _accuracy(seeds),
        lambda: _drift(seeds[:2], drift_cycles),
        lambda: _clutter(seeds),
        lambda: _unsteady(seeds),
        lambda: _interruptions(seeds),
        lambda: _precision(seeds),
        lambda: _bodies(seeds),
        lambda: _ring_gear(seeds),
        lambda: _chained(seeds),
        lambda: _small(seeds),
        lambda: _time(seeds),
    ]
    if optical_cycles:
        optical: list[OpticalRun] = []
        parts += [lambda seed=seed: _optics(seed, optical_cycles, optical) for seed in seeds[:3]]  # type: ignore[misc]
        parts.append(lambda: _all_optics(optical))
    table = []
    for done, part in enumerate(parts):
        progress(done, len(parts))
        table += part()
    progress(len(parts), len(parts))
    return table


_SCALES = {"dx": ("nm", 1e9), "dy": ("nm", 1e9), "dz": ("nm", 1e9)}


def _freedoms(what: str, rms: Array, limits: Array | None = None) -> list[Figure]:
    rows = []
    for index, name in enumerate(DEGREES_OF_FREEDOM):
        unit, scale = _SCALES.get(name, ("urad", 1e6))
        limit = None if limits is None else limits[index] * scale
        rows.append(at_most(f"{what}: {name} rms, {unit}", rms[index] * scale, limit))
    return rows


def _accuracy(seeds: Sequence[int]) -> list[Figure]:
    """Noise as of 6e4 electrons, with field errors of 5 nm and 30 nm that the covariances do not claim."""
    rows = []
    scene = Scene(field_error_xy=5e-9, field_error_z=30e-9)
    for name, settings in (
        ("field error 5, 30 nm", PoseSettings()),
        ("same, not estimated", PoseSettings(field_degree=0)),
    ):
        comparisons = [follow(scene, seed, 240, settings).comparison() for seed in seeds]
        rms = np.sqrt(np.mean([c.rms**2 for c in comparisons], axis=0))
        honest = name.startswith("field")
        rows += _freedoms(name, rms)
        for first, last in ((0, 79), (80, 239)) if honest else ((0, 239),):
            nees = float(np.mean([c.between(first, last).nees_per_dof for c in comparisons]))
            label = f"{name}: NEES/6, cycles {first} to {last}"
            rows.append(between(label, nees, 0.8, 1.3) if honest else information(label, nees))
    return rows


def _drift(seeds: Sequence[int], cycles: int) -> list[Figure]:
    rows = []
    for seed in seeds:
        run = follow(
            Scene(field_error_xy=5e-9, field_error_z=30e-9, missing=0.03, spurious=0.03), seed, cycles
        )
        result = run.comparison()
        first, last = result.between(0, 99), result.between(cycles - 100, cycles)
        ratio = float(np.sqrt(np.mean((last.rms / first.rms) ** 2)))
        where = f"{cycles} cycles, seed {seed}"
        rows.append(at_most(f"{where}: error of the last 100 over the first 100", ratio, 1.15))
        rows.append(at_most(f"{where}: wrong identities", run.wrong_identities, 0))
        rows.append(at_most(f"{where}: cycles lost", run.lost, 0))
    return rows


def _clutter(seeds: Sequence[int]) -> list[Figure]:
    rows = []
    clean = [follow(Scene(), seed, 160) for seed in seeds]
    for fraction, limit in ((0.1, 1.1), (0.3, 1.3)):
        runs = [follow(Scene(missing=fraction, spurious=fraction), seed, 160) for seed in seeds]
        ratio = error_ratio(runs, clean)
        what = f"{fraction:.0%} missing, {fraction:.0%} spurious"
        rows.append(at_most(f"{what}: error over clean", ratio, limit))
        rows.append(at_most(f"{what}: wrong poses", sum(run.wrong_poses for run in runs), 0))
        rows.append(at_most(f"{what}: cycles lost", sum(run.lost for run in runs), 0))
        rows.append(at_most(f"{what}: wrong identities", sum(run.wrong_identities for run in runs), 0))
    return rows


def _unsteady(seeds: Sequence[int]) -> list[Figure]:
    runs = [
        follow(Scene(missing=0.1, spurious=0.1), seed, 200, steps=unsteady_steps(seed, 200)) for seed in seeds
    ]
    what = "0-30 degrees, stall, reverse, skip, 10 lost"
    return [
        at_most(f"{what}: cycles lost", sum(run.lost for run in runs), 0),
        at_most(f"{what}: wrong poses", sum(run.wrong_poses for run in runs), 0),
        at_most(f"{what}: wrong identities", sum(run.wrong_identities for run in runs), 0),
        at_most(f"{what}: whole turns wrong", sum(run.turns_off() for run in runs), 0),
    ]


def _interruptions(seeds: Sequence[int]) -> list[Figure]:
    rows = []
    for kind in ("covered", "shifted", "another"):
        results = [interrupt(kind, seed) for seed in seeds]
        rows.append(at_most(f"view {kind}: poses claimed meanwhile", sum(r.claimed for r in results), 0))
        rows.append(
            at_most(f"view {kind}: cycles to recover, at most", max(r.cycles_to_return for r in results), 1)
        )
        rows.append(at_most(f"view {kind}: wrong after return", sum(not r.right for r in results), 0))
    return rows


def _precision(seeds: Sequence[int]) -> list[Figure]:
    rows = []
    for count, ratio in precision((5, 10, 20, 50, 100, 200), seeds, 400).items():
        worst = int(np.argmax(ratio))
        rows.append(
            at_most(
                f"{count} particles: error over theory, worst ({DEGREES_OF_FREEDOM[worst]})",
                ratio[worst],
                1.15,
            )
        )
    return rows


def _bodies(seeds: Sequence[int]) -> list[Figure]:
    rows = []
    for particles in (40, 15):
        runs = [two_bodies(seed, 200, particles) for seed in seeds]
        what = f"two bodies of {particles} particles, field error 5, 30 nm"
        for body in range(2):
            ratio = error_ratio([joint[body] for joint, _ in runs], [single[body] for _, single in runs])
            rows.append(at_most(f"{what}: error of body {body + 1} over alone", ratio, 1.05))
            nees = float(np.mean([joint[body].comparison().nees_per_dof for joint, _ in runs]))
            rows.append(between(f"{what}: NEES/6 of body {body + 1}", nees, 0.8, 1.3))
        nees = float(np.mean([nees_once_recentred(run) for joint, _ in runs for run in joint]))
        rows.append(between(f"{what}: NEES/6 of 12 cycles once recentred", nees, 0.8, 1.3))
        nees = float(np.mean([relative_nees(*reversed(joint)) for joint, _ in runs]))
        rows.append(between(f"{what}: NEES/6 of one relative to the other", nees, 0.8, 1.3))
        wrong = sum(run.wrong_identities + run.lost for joint, _ in runs for run in joint)
        rows.append(at_most(f"{what}: particles of the other body used, cycles lost", wrong, 0))
    return rows


def _ring_gear(seeds: Sequence[int]) -> list[Figure]:
    """A body of which the field shows an arc only: what the first particles knew is handed on by those that
    come after, for good. One pose a run tells, hence many runs."""
    rows = []
    settings = PoseSettings(field_size=RING_GEAR.field, field_degree=0, recentre_at=())
    runs = [follow(RING_GEAR, seed, 81, settings) for seed in range(1, 4 * len(seeds) + 1)]
    for cycle in (20, 80):
        nees = float(np.mean([nees_since_first(run, cycle) for run in runs]))
        rows.append(between(f"ring gear, arc of 36 degrees in view: NEES/6 at cycle {cycle}", nees, 0.8, 1.3))
    wrong = sum(run.wrong_identities + run.lost for run in runs)
    rows.append(at_most("ring gear, arc of 36 degrees in view: identities wrong, cycles lost", wrong, 0))
    scene = replace(RING_GEAR, field_error_xy=5e-9, field_error_z=30e-9)
    settings = replace(settings, field_degree=4)
    runs = [follow(scene, seed, 81, settings) for seed in range(1, 4 * len(seeds) + 1)]
    for cycle in (20, 40, 80):
        found = [nees_since_first(run, cycle) for run in runs]
        what = f"ring gear, field error 5, 30 nm: NEES/6 at cycle {cycle}"
        if cycle < 80:
            rows.append(between(what, float(np.mean(found)), 0.8, 1.3))
        else:
            # After 144 degrees, four generations of particles on, the claim is somewhat small: 1.2 to 1.3.
            rows.append(information(what, float(np.mean(found))))
            rows.append(information(f"{what}, median", float(np.median(found))))
    return rows


def _chained(seeds: Sequence[int]) -> list[Figure]:
    """What the paper's chained registration costs after two revolutions, for comparison."""
    last = []
    for reference in ("previous", "map"):
        settings = PoseSettings(reference=reference)
        ends = [follow(Scene(), seed, 161, settings).comparison().error[-20:, 5] for seed in seeds]
        last.append(float(np.sqrt(np.mean(np.square(ends)))))
    nees = np.mean([chained_nees(seed) for seed in range(1, 4 * len(seeds) + 1)])
    return [
        information(
            "reference previous: psi error after two revolutions over that of map", last[0] / last[1]
        ),
        between("reference previous: NEES/6 from the first micrograph on", float(nees), 0.8, 1.3),
    ]


def _small(seeds: Sequence[int]) -> list[Figure]:
    """Few particles, which tell little of the field error, and cannot average anything."""
    rows = []
    errors = Scene(field_error_xy=5e-9, field_error_z=30e-9)
    for name, scene in (
        ("field of 130 um, 25 visible", replace(errors, field=(130e-6, 130e-6)).with_visible(25)),
        ("16 visible", errors.with_visible(16)),
        ("9 visible", errors.with_visible(9)),
    ):
        comparisons = [follow(scene, seed, 160).comparison() for seed in seeds]
        nees = float(np.mean([c.nees_per_dof for c in comparisons]))
        rows.append(between(f"{name}, field error 5, 30 nm: NEES/6", nees, 0.8, 1.3))
        tilt = [((c.error / c.claimed)[:, 3:5] ** 2).mean() for c in comparisons]
        rows.append(between(f"{name}, field error 5, 30 nm: the same of the tilt", np.mean(tilt), 0.8, 1.3))
    return rows


def _time(seeds: Sequence[int]) -> list[Figure]:
    pose, learning = (np.concatenate(part) * 1e3 for part in zip(*map(solve_time, seeds[:2]), strict=True))
    return [
        at_most(
            "100 particles: solve, association and map included, median, ms", np.median(pose + learning), 1
        ),
        information("100 particles: until the pose is out, median, ms", float(np.median(pose))),
        information("100 particles: until the pose is out, slowest, ms", pose.max()),
        information("100 particles: learning after it, slowest (map solved), ms", learning.max()),
    ]


def _optics(seed: int, cycles: int, runs: list[OpticalRun]) -> list[Figure]:
    """One optics; the rms over 640 cycles scatter by 3 %."""
    runs.append(result := optical_chain(seed, cycles))
    what = f"rendered frames, seed {seed}"
    rows = _freedoms(f"{what}, after self-calibration", result.settled.rms, LIMITS)
    rows.append(between(f"{what}, after self-calibration: NEES/6", result.settled.nees_per_dof, 0.8, 1.3))
    rows.append(between(f"{what}, all cycles: NEES/6", result.comparison.nees_per_dof, 0.8, 1.3))
    rows += _freedoms(f"{what}, all cycles", result.comparison.rms)
    rows += _freedoms(f"{what}, Cramer-Rao bound of all visible", result.bound)
    tilt = np.hypot(*result.comparison.microscope.rotation[:2, 2])
    rows.append(information(f"{what}: tilt of the calibrated plane, urad", tilt * 1e6))
    rows.append(information(f"{what}: particles visible, mean", result.visible))
    rows.append(information(f"{what}: particles used, mean", result.used))
    rows.append(information(f"{what}: electrons of a visible particle, mean", result.electrons))
    return rows


def _all_optics(runs: Sequence[OpticalRun]) -> list[Figure]:
    what = f"rendered frames, {len(runs)} optics"
    rms = np.sqrt(np.mean([run.settled.rms**2 for run in runs], axis=0))
    bound = np.sqrt(np.mean([run.bound**2 for run in runs], axis=0))
    return _freedoms(f"{what}, after self-calibration", rms, LIMITS) + _freedoms(
        f"{what}, Cramer-Rao bound of all visible", bound
    )
