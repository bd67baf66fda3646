"""The acceptance figures of the pose: the table of `mems6dof validate pose`."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mems6dof_ros.figures import Figure, at_least, at_most, between, figure, information
from mems6dof_ros.pose.angles import ALPHA_DETECTION, BETA_DETECTION
from mems6dof_ros.pose.cycle_pose import DEGREES_OF_FREEDOM
from mems6dof_ros.pose.estimator import PoseSettings
from mems6dof_ros.pose.synthetic import Scene
from mems6dof_ros.pose.validation import (
    RING_GEAR,
    Angles,
    angles,
    chained_nees,
    error_ratio,
    follow,
    interrupt,
    nees_once_recentred,
    nees_since_first,
    precision,
    relative_nees,
    solve_time,
    two_bodies,
    unsteady_steps,
)
from mems6dof_ros.pose.validation_optics import OpticalRun, optical_chain

Array = NDArray[np.float64]

#: Limits of issue and demonstration alike: m, m, m, rad, rad, rad.
LIMITS = np.array([0.26e-9, 0.26e-9, 8e-9, 100e-6, 100e-6, 2.5e-6])
#: What the calibration leaves of the field's error, which no covariance claims.
FIELD_ERRORS = Scene(field_error_xy=5e-9, field_error_z=30e-9)
#: The same, and particles of unequal precision.
UNEVEN = replace(FIELD_ERRORS, spread=0.3)


def figures(
    seeds: Sequence[int],
    progress: Callable[[int, int], None] = lambda done, total: None,
    drift_cycles: int = 2000,
    optical_cycles: int = 0,
    optics: Sequence[int] = (),
) -> list[Figure]:
    """The table: synthetic localizations of ``seeds``, and ``optical_cycles`` (0: none) of rendered frames
    through each of ``optics``."""
    parts: list[Callable[[], list[Figure]]] = [
        lambda: _accuracy(seeds),
        lambda: _drift(seeds[:4], drift_cycles),
        lambda: _clutter(seeds),
        lambda: _unsteady(seeds),
        lambda: _interruptions(seeds),
        lambda: _precision(seeds),
        lambda: _angles(seeds),
        lambda: _bodies(seeds),
        lambda: _ring_gear(seeds),
        lambda: _chained(seeds),
        lambda: _small(seeds),
        lambda: _time(seeds),
    ]
    if optical_cycles and optics:
        runs: list[OpticalRun] = []
        parts += [lambda seed=seed: _optics(seed, optical_cycles, runs) for seed in optics]  # type: ignore[misc]
        parts.append(lambda: _all_optics(runs))
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
    for name, settings in (
        ("field error 5, 30 nm", PoseSettings()),
        ("same, not estimated", PoseSettings(field_degree=0)),
    ):
        comparisons = [follow(FIELD_ERRORS, seed, 240, settings).comparison() for seed in seeds]
        rms = np.sqrt(np.mean([c.rms**2 for c in comparisons], axis=0))
        honest = name.startswith("field")
        rows += _freedoms(name, rms)
        for first, last in ((0, 79), (80, 239)) if honest else ((0, 239),):
            nees = float(np.mean([c.between(first, last).nees_per_dof for c in comparisons]))
            label = f"{name}: NEES/6, cycles {first} to {last}"
            rows.append(between(label, nees, 0.8, 1.3) if honest else information(label, nees))
    return rows


def _drift(seeds: Sequence[int], cycles: int) -> list[Figure]:
    rows, ends = [], []
    for seed in seeds:
        run = follow(replace(FIELD_ERRORS, missing=0.03, spurious=0.03), seed, cycles)
        result = run.comparison()
        first, learnt, last = (
            result.between(*span) for span in ((0, 99), (80, 179), (cycles - 100, cycles - 1))
        )
        ends.append((learnt.rms**2, last.rms**2))
        ratio = float(np.sqrt(np.mean((last.rms / first.rms) ** 2)))
        where = f"{cycles} cycles, seed {seed}"
        rows.append(at_most(f"{where}: error of the last 100 over the first 100", ratio, 1.15))
        rows.append(at_most(f"{where}: wrong identities", run.wrong_identities, 0))
        rows.append(at_most(f"{where}: cycles lost", run.lost, 0))
    learnt, last = np.mean(ends, axis=0)
    # The ratio of two rms of 100 cycles each scatters by a tenth: three standard deviations.
    limit = 1 + 3 * 0.1 / math.sqrt(len(seeds))
    what = f"{cycles} cycles, {len(seeds)} seeds: error of the last 100 over cycles 80 to 179"
    for name, ratio in zip(DEGREES_OF_FREEDOM, np.sqrt(last / learnt).tolist(), strict=True):
        rows.append(at_most(f"{what}, {name}", ratio, limit))
    return rows


def _clutter(seeds: Sequence[int]) -> list[Figure]:
    rows = []
    clean = [follow(UNEVEN, seed, 160) for seed in seeds]
    for fraction, limit in ((0.1, 1.1), (0.3, 1.3)):
        runs = [follow(replace(UNEVEN, missing=fraction, spurious=fraction), seed, 160) for seed in seeds]
        what = f"{fraction:.0%} missing, {fraction:.0%} spurious"
        rows.append(at_most(f"{what}: error over clean", error_ratio(runs, clean), limit))
        nees = float(np.mean([run.comparison().nees_per_dof for run in runs]))
        if fraction < 0.3:
            rows.append(between(f"{what}: NEES/6", nees, 0.8, 1.3))
        else:
            # Honest or too modest: standard deviations are claimed some 13 % too large.
            rows.append(information(f"{what}: NEES/6", nees))
        rows.append(at_most(f"{what}: wrong poses", sum(run.wrong_poses for run in runs), 0))
        rows.append(at_most(f"{what}: cycles lost", sum(run.lost for run in runs), 0))
        rows.append(at_most(f"{what}: wrong identities", sum(run.wrong_identities for run in runs), 0))
    return rows


def _unsteady(seeds: Sequence[int]) -> list[Figure]:
    scene = replace(UNEVEN, missing=0.1, spurious=0.1)
    runs = [follow(scene, seed, 200, steps=unsteady_steps(seed, 200)) for seed in seeds]
    what = "0-30 degrees, stall, reverse, skip, 10 lost"
    nees = float(np.mean([run.comparison().nees_per_dof for run in runs]))
    return [
        at_most(f"{what}: cycles lost", sum(run.lost for run in runs), 0),
        at_most(f"{what}: wrong poses", sum(run.wrong_poses for run in runs), 0),
        at_most(f"{what}: wrong identities", sum(run.wrong_identities for run in runs), 0),
        at_most(f"{what}: whole turns wrong", sum(run.turns_off() for run in runs), 0),
        between(f"{what}: NEES/6", nees, 0.8, 1.3),
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
    for count in (5, 10, 20, 50, 100, 200):
        measured, allowed = precision(count, seeds, 400)
        for name, rms, sd in zip(DEGREES_OF_FREEDOM, measured.tolist(), allowed.tolist(), strict=True):
            unit, scale = _SCALES.get(name, ("urad", 1e6))
            required = f"<= 1.15 x {sd * scale:.4g}, theory"
            rows.append(
                figure(f"{count} particles: {name} rms, {unit}", rms * scale, required, rms <= 1.15 * sd)
            )
    return rows


def _angles(seeds: Sequence[int], cycles: int = 240) -> list[Figure]:
    """Three revolutions without any tilt, and with 1 mrad of it."""
    still, tilted = ([angles(tilt, seed, cycles) for seed in seeds] for tilt in (0.0, 1e-3))

    def all_of(runs: Sequence[Angles], name: str) -> Array:
        return np.concatenate([getattr(run, name) for run in runs])

    rows = []
    for what, runs in (("no tilt", still), ("tilts of 1 mrad rms", tilted)):
        jump = all_of(runs, "psi_jump")
        rows.append(
            at_most(f"{what}, psi through three turns: angles not finite", sum(r.not_finite for r in runs), 0)
        )
        # Chance goes beyond 5 once in 1.7 million.
        rows.append(at_most(f"{what}: largest jump of psi less the true step, sd", np.abs(jump).max(), 5))
        rows.append(
            information(f"{what}: jumps of psi less the true step, rms, sd", np.sqrt(np.mean(jump**2)))
        )
    rows.append(information("no tilt: true tilt, rms, sd", np.sqrt(np.mean(all_of(still, "tilt") ** 2))))
    for name, threshold in (("alpha", ALPHA_DETECTION), ("beta", BETA_DETECTION)):
        claimed = all_of(still, name)
        chance = math.exp(-(threshold**2) / 2)  # Rayleigh
        limit = chance + 3 * math.sqrt(chance * (1 - chance) / len(claimed))
        what = f"no tilt: {name} claimed in so many cycles, {100 * chance:.2g} % by chance, %"
        rows.append(at_most(what, 100 * claimed.mean(), 100 * limit))
    # A tilt of 6 sd is measured below the 3 that alpha needs once in 740.
    clear = all_of(tilted, "tilt") > 2 * ALPHA_DETECTION
    what = f"tilts beyond {2 * ALPHA_DETECTION:g} sd ({clear.sum()} cycles)"
    rows.append(at_least(f"{what}: alpha claimed in, %", 100 * all_of(tilted, "alpha")[clear].mean(), 99.5))
    error = all_of(tilted, "alpha_error")[clear]
    rows.append(between(f"{what}: NEES of alpha", float(np.mean(error**2)), 0.8, 1.3))
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
    runs = [follow(scene, seed, 81, settings) for seed in range(1, 16 * len(seeds) + 1)]
    for cycle in (20, 40, 80):
        found = [nees_since_first(run, cycle) for run in runs]
        what = f"ring gear, field error 5, 30 nm: NEES/6 at cycle {cycle}"
        if cycle < 80:
            rows.append(between(what, float(np.mean(found)), 0.8, 1.3))
        else:
            # After 144 degrees, four generations of particles on, the claim is too small, just as the limit:
            # 1.29, standard error 0.08, of 96 runs. Fewer fall on either side of it.
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
    for name, scene in (
        ("field of 130 um, 25 visible", replace(FIELD_ERRORS, field=(130e-6, 130e-6)).with_visible(25)),
        ("16 visible", FIELD_ERRORS.with_visible(16)),
        ("9 visible", FIELD_ERRORS.with_visible(9)),
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
    what = f"rendered frames, optics {seed}"
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
