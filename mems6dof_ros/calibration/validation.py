"""The acceptance figures of the calibration, on particles, seeds and optics that nothing was fitted to.

One set of beads calibrates simulated optics; other beads of the same optics, at other heights, are
measured. The origin of z (where "in focus" is) and the tilt of the calibration substrate are conventions
that no single focus stack can tell, so one plane is taken off the z errors of each set of optics.
"""

from __future__ import annotations

import textwrap
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mems6dof_ros.calibration.calibrate import CalibrationSettings, calibrate
from mems6dof_ros.calibration.estimator import METHODS
from mems6dof_ros.calibration.field_curves import Array
from mems6dof_ros.calibration.field_validation import field_figures
from mems6dof_ros.calibration.file import Calibration
from mems6dof_ros.calibration.focus_stack import DEFAULT_WINDOW_PX, FocusStack, measure_stack
from mems6dof_ros.calibration.interface import Positions
from mems6dof_ros.calibration.real_stacks import (
    ASTIGMATIC,
    astigmatic_frames,
    astigmatic_stack,
    intrinsic_stack,
    one_bead_left_out,
    one_plane_left_out,
    plain_orders,
    stage_departures,
)
from mems6dof_ros.errors import InputError
from mems6dof_ros.figures import Figure, at_least, at_most, between, information
from mems6dof_ros.frame import Frame
from mems6dof_ros.localization.fitting import DEFAULT_WEIGHTING, fit_gaussians
from mems6dof_ros.localization.localizations import GaussianFits
from mems6dof_ros.simulation.aberrations import FieldAberrations
from mems6dof_ros.simulation.experiment import BeadSubstrate, focus_stack
from mems6dof_ros.simulation.optics import Objective, Optics
from mems6dof_ros.simulation.settings import SimulationSettings
from mems6dof_ros.sources.simulator import camera_noise

#: Says what is being measured.
Tell = Callable[[str], None]

#: The stacks reach beyond the range that the calibration declares valid.
STACK_REACH, STACK_STEP, VALID_RANGE = 6.6e-6, 0.2e-6, 4.2e-6
#: The range is counted from the local focus, which lies as far as this from z = 0 (field curvature), m.
FIELD_CURVATURE = 0.6e-6
#: As far as particles are, where those beyond the range are to be recognised.
FAR_REACH = 8.6e-6


@dataclass(frozen=True)
class Particles:
    """Held-out particles: true ``position`` (n, 3) m and ``electrons`` (n,), with their ``fits`` in the
    ``image`` that they were fitted in."""

    position: Array
    electrons: Array
    fits: GaussianFits
    image: NDArray[np.generic]


@dataclass(frozen=True)
class Errors:
    """Errors of particles without a flag: ``error`` and claimed ``sd`` (n, 3) m, true ``position``. Of the
    whole set ``z`` (m,) m as measured, NaN where flagged."""

    error: Array
    sd: Array
    position: Array
    z: Array

    @property
    def used(self) -> NDArray[np.bool_]:
        """Which of the whole set (m,) have no flag."""
        return np.isfinite(self.z)

    @property
    def kept(self) -> float:
        """The part of the whole set without a flag."""
        return float(np.mean(self.used))

    def rms(self, axis: int) -> float:
        """Rms error along ``axis``, m."""
        return float(np.sqrt(np.mean(self.error[:, axis] ** 2)))

    def claimed_over_actual(self, axis: int) -> float:
        """1 over the rms of error in units of its claimed standard deviation."""
        return float(1 / np.sqrt(np.mean((self.error[:, axis] / self.sd[:, axis]) ** 2)))

    def worst_z(self, chosen: NDArray[np.bool_] | slice = slice(None)) -> float:
        """The largest error of z in units of its claimed standard deviation, of the ``chosen`` ones."""
        return float(np.max(np.abs(self.error[chosen, 2] / self.sd[chosen, 2]), initial=0.0))


def simulated_stack(
    optics: str, seed: int, electrons: float, reach: float = STACK_REACH, **settings: Any
) -> FocusStack:
    """A full-field focus stack of about 100 beads through the optics number ``seed``, within ``reach`` m."""
    simulated = SimulationSettings(
        clumps=0, optics=optics, optics_seed=seed, electrons=electrons, seed=seed, **settings
    )
    frames = focus_stack(simulated, -reach, reach, STACK_STEP, beads=150, seed=10 + seed)
    return measure_stack(
        frames, camera_noise(simulated), DEFAULT_WEIGHTING, DEFAULT_WINDOW_PX, f"{optics} {seed}"
    )


def calibrated(
    optics: str, seed: int, electrons: float, reach: float = STACK_REACH, **settings: Any
) -> Calibration:
    """Calibration of the optics number ``seed`` for all methods from a stack within ``reach`` m, valid within
    VALID_RANGE of focus."""
    stack = simulated_stack(optics, seed, electrons, reach, **settings)
    known = SimulationSettings()
    return calibrate(
        [stack],
        CalibrationSettings(
            axial_range=VALID_RANGE,
            numerical_aperture=known.numerical_aperture,
            wavelength=known.wavelength,
            bead_diameter=known.diameter,
        ),
    ).calibration


def held_out(
    calibration: Calibration,
    optics: str,
    seed: int,
    electrons: float,
    reach: float,
    frames: int = 6,
    **settings: Any,
) -> list[Particles]:
    """Other beads of the same optics, evenly within ``reach`` m of focus; about 80 in each frame."""
    simulated = SimulationSettings(
        clumps=0, optics=optics, optics_seed=seed, electrons=electrons, seed=500 + seed, **settings
    )
    rng = np.random.default_rng([seed, 30])
    size = np.array(simulated.image_size)
    found = []
    for number in range(frames):
        stage_z = reach * (2 * (number + rng.uniform()) / frames - 1)
        frame = BeadSubstrate(simulated, beads=150, seed=1000 * seed + number + 500).frame(float(stage_z))
        truth = frame.truth[0]
        px = truth.position[:, :2] / simulated.pixel_size + (size - 1) / 2
        inside = ((px > DEFAULT_WINDOW_PX // 2) & (px < size - DEFAULT_WINDOW_PX // 2)).all(axis=1)
        guess = px[inside] + rng.uniform(-1, 1, (int(inside.sum()), 2))
        fits = fit_gaussians(
            frame.image, guess, calibration.camera, calibration.weighting, calibration.window_px
        )
        found.append(Particles(truth.position[inside], truth.electrons[inside], fits, frame.image))
    return found


def located(calibration: Calibration, particles: Particles) -> Positions:
    """Positions of ``particles``, one for each."""
    found = calibration.locate(particles.fits, particles.image)
    # Where the pixels show two in what one Gaussian was fitted to, the second comes after all others.
    n = len(particles.fits)
    return Positions(found.position[:n], found.covariance[:n], found.z_gap[:n], found.flags[:n])


def errors(calibration: Calibration, particles: Sequence[Particles], reach: float = np.inf) -> Errors:
    """Locate ``particles`` and compare those within ``reach`` m of focus with truth."""
    found = [located(calibration, p) for p in particles]
    position = np.concatenate([p.position for p in particles])
    near = np.abs(position[:, 2]) <= reach
    flags = np.concatenate([f.flags | p.fits.flags for f, p in zip(found, particles, strict=True)])
    good = near & (flags == 0)
    measured = np.concatenate([f.position for f in found])
    error = measured[good] - position[good]
    variance = np.concatenate([np.einsum("nkk->nk", f.covariance) for f in found])[good]
    plane = np.column_stack([np.ones(len(error)), position[good, :2]])

    def about_plane(values: Array) -> Array:
        return np.asarray(values - plane @ np.linalg.lstsq(plane, values, rcond=None)[0])

    error[:, 2] = about_plane(error[:, 2])
    # The plane takes with it what the height of the focus surface is uncertain by.
    psf = calibration.psf if calibration.method == "psf" else None
    focus = (psf or calibration.model).focus.scaled_influence(*position[good, :2].T)
    variance[:, 2] += np.sum(about_plane(focus) ** 2 - focus**2, axis=1)
    sd = np.sqrt(variance)
    error[:, :2] -= error[:, :2].mean(axis=0)
    return Errors(error, sd, position[good], np.where(good, measured[:, 2], np.nan)[near])


def pooled(parts: Sequence[Errors]) -> Errors:
    """All particles of several sets of optics."""
    return Errors(
        np.concatenate([p.error for p in parts]),
        np.concatenate([p.sd for p in parts]),
        np.concatenate([p.position for p in parts]),
        np.concatenate([p.z for p in parts]),
    )


def axial_bound(particles: Sequence[Particles], seed: int, background: float, read_noise: float) -> Array:
    """Cramer-Rao bound (n,) m of z for every particle of smooth optics number ``seed``.

    From the Fisher information of the expected image about x, y, z, electrons and background, with
    derivatives by central differences of the simulator's own images: all known but these five.
    """
    objective = Objective()
    optics = Optics(objective, FieldAberrations.from_preset("smooth", seed, objective.wavelength))
    step = 20e-9
    size = (2048, 2048)
    bounds = []
    for p in particles:

        def images(shift: Sequence[float], p: Particles = p) -> Array:
            return optics.render(p.position + np.array(shift), p.electrons, 1e-6, size).image.astype(float)

        middle = images((0, 0, 0))
        half = middle.shape[1] // 2
        centre = slice(half - DEFAULT_WINDOW_PX // 2, half + DEFAULT_WINDOW_PX // 2 + 1)
        derivatives = []
        for axis in range(3):
            shift = [step * (axis == k) for k in range(3)]
            # A window jumps by whole pixels; a shift across its border would not be a derivative.
            forth, back = images(shift), images([-s for s in shift])
            derivatives.append((forth - back) / (2 * step))
        derivatives += [middle / p.electrons[:, None, None], np.ones_like(middle)]
        jacobian = np.stack([d[:, centre, centre].reshape(len(middle), -1) for d in derivatives], axis=1)
        variance = middle[:, centre, centre].reshape(len(middle), 1, -1) + background + read_noise**2
        fisher = (jacobian / variance) @ jacobian.transpose(0, 2, 1)
        bounds.append(np.sqrt(np.linalg.inv(fisher)[:, 2, 2]))
    return np.concatenate(bounds)


@cache
def _calibration(optics: str, seed: int, electrons: float, reach: float = STACK_REACH) -> Calibration:
    return calibrated(optics, seed, electrons, reach)


def accuracy_figures(seeds: Sequence[int], tell: Tell) -> list[Figure]:
    """z with local aberration, within 1.5 um of focus, calibrated at 1e5 electrons."""
    limits = {
        ("rho_amp", 3e4): 80,
        ("joint", 3e4): 40,
        ("joint", 1e5): 30,
        ("psf", 3e4): 40,
        ("psf", 1e5): 20,
    }
    table = []
    for electrons in (3e4, 1e5):
        sets = {}
        for seed in seeds:
            tell(f"optics {seed}, {electrons:.0e} electrons")
            calibration = _calibration("paper", seed, 1e5)
            sets[seed] = held_out(calibration, "paper", seed, electrons, 1.5e-6)
        for method in METHODS:
            chosen = {seed: _calibration("paper", seed, 1e5).with_method(method) for seed in seeds}
            for seed in seeds:
                errors(chosen[seed], sets[seed][:1])  # compiles and prepares
            start = time.process_time()
            found = pooled([errors(chosen[seed], sets[seed]) for seed in seeds])
            spent = (time.process_time() - start) / len(found.z)
            name = f"{method}, {electrons:.0e} electrons"
            table.append(at_most(f"z rms, {name}, nm", found.rms(2) * 1e9, limits.get((method, electrons))))
            table.append(between(f"claimed over actual z, {name}", found.claimed_over_actual(2), 0.9, 1.15))
            table.append(information(f"particles without a flag, {name}", found.kept))
            table.append(information(f"processor time per particle, {name}, ms", spent * 1e3))
    return table


def bound_figures(seeds: Sequence[int], tell: Tell) -> list[Figure]:
    """z over the Cramer-Rao bound: smooth aberrations, equal spheres, 1e5 electrons."""
    equal: dict[str, Any] = {"diameter_spread": 0.0, "brightness_spread": 0.0}
    limits = {"joint": 1.5, "psf": 1.15}
    found: dict[str, list[Errors]] = {method: [] for method in limits}
    bound = []
    for seed in seeds:
        tell(f"smooth optics {seed}")
        calibration = calibrated("smooth", seed, 1e5, **equal)
        particles = held_out(calibration, "smooth", seed, 1e5, 1.5e-6, **equal)
        for method, parts in found.items():
            parts.append(errors(calibration.with_method(method), particles))
        bound.append(axial_bound(particles, seed, 10.0, 1.6))
    least = np.concatenate(bound)
    table = [information("Cramer-Rao bound of z, 1e5 electrons, nm", np.sqrt(np.mean(least**2)) * 1e9)]
    for method, limit in limits.items():
        measured = pooled(found[method])
        ratio = measured.rms(2) / float(np.sqrt(np.mean(least[measured.used] ** 2)))
        table += [
            at_most(f"z rms over Cramer-Rao bound, {method}, 1e5 electrons", ratio, limit),
            information(f"particles without a flag, {method}, smooth optics", measured.kept),
            between(
                f"claimed over actual z, {method}, smooth optics", measured.claimed_over_actual(2), 0.9, 1.15
            ),
        ]
    return table


def brightness_figures(seeds: Sequence[int], tell: Tell) -> list[Figure]:
    """Calibrated at 3e5 electrons, measured dimmer and brighter; then calibrated 30 times too bright or dim.

    The bias is by how much z of the same particles, in the same calibration, changes with brightness in the
    mean. Nothing is taken off, and nothing allowed for the standard error of the mean, which is stated.
    """
    cases = ((3e5, 3e4), (3e5, 1e6), (1e6, 3e4), (3e4, 1e6))
    found: dict[tuple[str, float, float], list[Errors]] = {}
    truth = []
    for seed in seeds:
        calibration, particles = {}, {}
        for electrons in (3e4, 3e5, 1e6):
            tell(f"optics {seed}, {electrons:.0e} electrons")
            calibration[electrons] = _calibration("paper", seed, electrons)
            particles[electrons] = held_out(
                calibration[electrons], "paper", seed, electrons, 1.5e-6, frames=12
            )
        truth.append(np.concatenate([p.position[:, 2] for p in particles[3e5]]))
        for method in METHODS:
            chosen = {electrons: each.with_method(method) for electrons, each in calibration.items()}
            for at, of in {*cases, *((electrons, electrons) for electrons in chosen)}:
                found.setdefault((method, at, of), []).append(errors(chosen[at], particles[of]))
    table = []
    for at, of in cases:
        for method in METHODS:
            crossed, same = pooled(found[method, at, of]), pooled(found[method, of, of])
            name = f"{method}, calibrated at {at:.0e}, measured at {of:.0e}"
            # As bright as the particles a calibration has other random errors, too: judged as was asked.
            limit = 1.1 if at == 3e5 else None
            table += [
                at_most(f"z rms over calibrated in kind, {name}", crossed.rms(2) / same.rms(2), limit),
                information(f"claimed over actual z, {name}", crossed.claimed_over_actual(2)),
                information(f"particles without a flag, {name}", crossed.kept),
                *brightness_bias(name, found[method, at, of], found[method, at, at], truth),
            ]
    return table


def brightness_bias(
    name: str, there: Sequence[Errors], here: Sequence[Errors], truth: Sequence[Array]
) -> list[Figure]:
    """Mean change of z from ``here`` to ``there``, of one set of optics each, in the worst of them; and in
    the worst third of the true z, in the mean of all."""
    change = [p.z - q.z for p, q in zip(there, here, strict=True)]
    mean = np.array([np.nanmean(each) for each in change]) * 1e9
    error = max(np.nanstd(each) / np.sqrt(np.count_nonzero(np.isfinite(each))) for each in change) * 1e9
    every, z = np.concatenate(change), np.concatenate(truth)
    third = np.digitize(z, np.quantile(z, [1 / 3, 2 / 3]))
    worst = max(abs(float(np.nanmean(every[third == k]))) for k in range(3)) * 1e9
    return [
        at_most(f"bias of z, worst optics (standard error {error:.1f}), {name}, nm", np.abs(mean).max(), 5),
        at_most(f"bias of z, worst third of the range, {name}, nm", worst, 5),
    ]


def sign_change_figures(seeds: Sequence[int], tell: Tell) -> list[Figure]:
    """Optics whose 45-degree astigmatism changes sign inside the field, 1e5 electrons, +/-4 um."""
    return _unflagged("sign_change", "sign change", seeds, tell)


def range_figures(seeds: Sequence[int], tell: Tell) -> list[Figure]:
    """Right or flagged to 4 um of focus and from there to the end of the range; beyond it flagged."""
    table = _unflagged("paper", "within 4 um", seeds, tell, FAR_REACH)
    end = VALID_RANGE + FIELD_CURVATURE
    near: dict[str, list[Errors]] = {method: [] for method in METHODS}
    missed = dict.fromkeys(METHODS, 0)
    for seed in seeds:
        tell(f"optics {seed}, to 8 um")
        calibration = _calibration("paper", seed, 1e5, FAR_REACH)
        particles = held_out(calibration, "paper", seed, 1e5, 8e-6, frames=16)
        for method in METHODS:
            chosen = calibration.with_method(method)
            near[method].append(errors(chosen, particles, end))
            for p in particles:
                good = (located(chosen, p).flags | p.fits.flags) == 0
                missed[method] += int(np.count_nonzero(good & (np.abs(p.position[:, 2]) > end)))
    for method, parts in near.items():
        every = pooled(parts)
        edge = np.abs(every.position[:, 2]) > 4e-6
        name = f"4 um to the end of the range, {method}"
        table.append(at_most(f"worst unflagged z, {name}, claimed sd", every.worst_z(edge), 5))
        table.append(information(f"particles without a flag, {name}, number", int(edge.sum())))
    return table + [at_most(f"unflagged beyond the range, {m}, particles", n, 0) for m, n in missed.items()]


def _unflagged(
    optics: str, name: str, seeds: Sequence[int], tell: Tell, reach: float = STACK_REACH
) -> list[Figure]:
    """The worst z without a flag within 4 um of focus, and how many have none."""
    found: dict[str, list[Errors]] = {method: [] for method in METHODS}
    for seed in seeds:
        tell(f"optics {seed}, {name}")
        calibration = _calibration(optics, seed, 1e5, reach)
        particles = held_out(calibration, optics, seed, 1e5, 4e-6, frames=10)
        for method, parts in found.items():
            parts.append(errors(calibration.with_method(method), particles))
    table = []
    for method, parts in found.items():
        every = pooled(parts)
        table.append(at_most(f"worst unflagged z, {name}, {method}, claimed sd", every.worst_z(), 5))
        table.append(information(f"particles without a flag, {name}, {method}", every.kept))
    return table


def bad_stack_figures(seeds: Sequence[int], tell: Tell) -> list[Figure]:
    """Stacks that must be refused or warned about: 1 where they are."""
    settings = SimulationSettings(
        clumps=0, width_px=640, height_px=640, optics_seed=seeds[0], electrons=1e5, seed=seeds[0]
    )
    camera = camera_noise(settings)
    frames = list(focus_stack(settings, -4.5e-6, 4.5e-6, 0.25e-6, beads=60, seed=3))
    aperture = settings.numerical_aperture

    def outcome(stack: Sequence[Frame], compare: Calibration | None = None) -> str:
        try:
            measured = measure_stack(stack, camera, DEFAULT_WEIGHTING, DEFAULT_WINDOW_PX, "stack")
            result = calibrate(
                [measured], CalibrationSettings(numerical_aperture=aperture, reference=compare)
            )
        except InputError as error:
            return str(error)
        return "; ".join(result.warnings)

    # The reference is of other beads.
    earlier = list(focus_stack(settings, -4.5e-6, 4.5e-6, 0.25e-6, beads=60, seed=5))
    reference = calibrate(
        [measure_stack(earlier, camera, DEFAULT_WEIGHTING, DEFAULT_WINDOW_PX, "stack")]
    ).calibration

    def stretched(factor: float) -> list[Frame]:
        return [replace(f, stage_z=factor * f.stage_z) for f in frames]

    drifting = [replace(f, image=np.roll(f.image, round(0.4 * k), axis=1)) for k, f in enumerate(frames)]
    ceiling = int(0.3 * max(f.image.max() for f in frames))
    saturated = [replace(f, image=np.minimum(f.image, np.uint16(ceiling))) for f in frames]
    few = list(focus_stack(settings, -4.5e-6, 4.5e-6, 0.25e-6, beads=8, seed=4))
    cases = {
        "a good stack": (frames, None, ""),
        "a good stack, with a reference": (frames, reference, ""),
        "step wrong by 2": (stretched(2), None, "the stage step seems wrong"),
        "step wrong by 1.2, with a reference": (stretched(1.2), reference, "the stage step differs"),
        "reversed direction": (stretched(-1), reference, "the direction of the stage is reversed"),
        "too few beads": (few, None, "the scatter between particles is poorly known"),
        "drift": (drifting, None, "drift: all beads move sideways"),
    }
    table = []
    for name, (stack, compare, words) in cases.items():
        tell(name)
        table.append(_complaint(name, outcome(stack, compare), words))
    camera = replace(camera, saturation_adu=ceiling)
    table.append(_complaint("saturation", outcome(saturated), "saturated in"))
    return table


def _complaint(name: str, said: str, words: str) -> Figure:
    """1 where ``words`` are in what was ``said`` of a stack; without words, where nothing was said."""
    passed = (words in said) if words else not said
    return at_least(f"{name}: {textwrap.shorten(said or 'no complaint', 90)}", float(passed), 1)


def real_figures(folder: Path, tell: Tell) -> list[Figure]:
    """Real micrographs (see the README of the data), which have no truth but the stage.

    The astigmatic stage did not make the steps that are stated: two methods that share no feature
    see the same departures in all beads. Against the stage as stated no method can be better than that,
    unless by a map of z that the other beads show (see stage_scale).
    """
    planes = astigmatic_frames(folder)
    stack, methods = astigmatic_stack(planes), ("joint", "psf")
    settings = replace(ASTIGMATIC, orders=plain_orders(0, 6))
    reach = 500e-9
    tell("what all beads say of the stage")
    seen = stage_departures(stack, planes, reach, settings, methods)
    steps = np.diff([seen[method] for method in methods])
    steps = steps[:, np.isfinite(steps).all(axis=0)]
    table = [
        *(
            information(
                f"real astigmatic stage, steps against 100 nm, as all beads see them, {m}, nm rms", rms
            )
            for m, rms in zip(methods, np.std(steps, axis=1) * 1e9, strict=True)
        ),
        information("correlation of the steps that the two methods see", np.corrcoef(steps)[0, 1]),
    ]
    tell("one bead after another left out")
    found = one_bead_left_out(stack, planes, reach, settings, methods)
    for method, (stated, others, scaled) in found.items():
        name = f"real astigmatic bead left out, {method}"
        # What a method adds itself is judged for both, against stated positions the better one.
        rms, median = (30, 18) if method == "psf" else (None, None)
        scaled = np.abs(scaled) * 1e9
        mapped = "z mapped to the stage as stated by what the other beads show"
        table += [
            at_most(f"{mapped}, {name}, nm rms", float(np.sqrt(np.mean(scaled**2))), rms),
            at_most(f"{mapped}, {name}, nm median", float(np.median(scaled)), median),
            at_most(f"z against the other beads, {name}, nm rms", others.rms * 1e9, 30),
            at_most(f"z against the other beads, {name}, nm median", others.median * 1e9, 18),
            between(f"claimed over actual, {name}", others.claimed_over_actual, 0.9, 1.15),
            information(f"z against the stage as stated, {name}, nm rms", stated.rms * 1e9),
            information(f"z against the stage as stated, {name}, nm median", stated.median * 1e9),
            information(f"flagged, {name}", others.flagged),
        ]
    tell("one plane after another left out")
    intrinsic = one_plane_left_out(intrinsic_stack(folder), 1.05e-6, plain_orders(0, 6))
    return [
        *table,
        information("stage steps, real intrinsic bead, one plane left out, nm rms", intrinsic.rms * 1e9),
        information("planes without a flag, real intrinsic bead", len(intrinsic.error)),
        information("flagged, real intrinsic bead", intrinsic.flagged),
        between("claimed over actual, real intrinsic bead", intrinsic.claimed_over_actual, 0.9, 1.15),
    ]


def learnt_field_figures(seeds: Sequence[int], tell: Tell) -> list[Figure]:
    """x and y after field self-calibration, see field_validation."""
    return field_figures(seeds, lambda seed: _calibration("paper", seed, 1e5), tell=tell)


#: Parts of the table from simulated optics, of the numbers ``seeds``; then come ``real_figures``.
PARTS: dict[str, Callable[[Sequence[int], Tell], list[Figure]]] = {
    "accuracy": accuracy_figures,
    "bound": bound_figures,
    "brightness": brightness_figures,
    "sign_change": sign_change_figures,
    "range": range_figures,
    "bad_stacks": bad_stack_figures,
    "field": learnt_field_figures,
}
