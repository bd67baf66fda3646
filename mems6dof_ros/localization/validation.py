"""The acceptance figures of detection and fits, each against truth that nothing was fitted to.

Matched images are Gaussians with Poisson noise, where the Cramer-Rao bound tells what is possible;
physical images come from the simulator's pupil model, for which a Gaussian is only an approximation.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mems6dof_ros.figures import Figure, at_most, between, information
from mems6dof_ros.localization.camera import CameraNoise
from mems6dof_ros.localization.fitting import DEFAULT_WEIGHTING, fit_gaussians
from mems6dof_ros.localization.gaussian import Array, cramer_rao, gaussian, pixel_grid
from mems6dof_ros.localization.localizations import FIT_PARAMETERS, Flag, GaussianFits
from mems6dof_ros.localization.localizer import Localizer
from mems6dof_ros.simulation.aberrations import FieldAberrations
from mems6dof_ros.simulation.experiment import motion_frames
from mems6dof_ros.simulation.optics import Objective, Optics
from mems6dof_ros.simulation.settings import SimulationSettings

OFFSET_ADU = 100.0


def matched_field(
    count: int,
    seed: int,
    window_px: int = 21,
    electrons: float = 2e4,
    background: float = 20.0,
    sigma: tuple[float, float] = (3.0, 3.3),
    rho: float = 0.1,
    gain: float = 2.0,
) -> tuple[NDArray[np.uint16], Array, CameraNoise]:
    """Image with ``count`` Gaussians, random within a pixel; their parameters (count, 7); the camera."""
    rng = np.random.default_rng([seed, 1])
    pitch = window_px + 4
    side = math.ceil(math.sqrt(count))
    amplitude = electrons / (2 * math.pi * sigma[0] * sigma[1] * math.sqrt(1 - rho**2))
    truth = np.empty((count, 7))
    truth[:, 0] = np.arange(count) % side * pitch + pitch // 2 + rng.uniform(-0.5, 0.5, count)
    truth[:, 1] = np.arange(count) // side * pitch + pitch // 2 + rng.uniform(-0.5, 0.5, count)
    truth[:, 2:] = amplitude, *sigma, rho, background
    mean = np.full((side * pitch, side * pitch), background)
    for n, parameters in enumerate(truth):
        rows = slice(n // side * pitch, (n // side + 1) * pitch)
        columns = slice(n % side * pitch, (n % side + 1) * pitch)
        grid = np.meshgrid(np.arange(columns.start, columns.stop), np.arange(rows.start, rows.stop))
        mean[rows, columns] = gaussian(parameters, *(axis.astype(float) for axis in grid))
    image = np.rint(OFFSET_ADU + gain * rng.poisson(mean)).astype(np.uint16)
    return image, truth, CameraNoise(OFFSET_ADU, gain, 0.0, 65535)


def physical_field(
    count: int, seed: int, electrons: float, defocus: float, optics_seed: int = 1, background: float = 10.0
) -> tuple[NDArray[np.uint16], Array, CameraNoise]:
    """Image with ``count`` renderings of a 1 um sphere at one place of the field, at ``defocus`` m.

    Returns image, start positions (count, 2) px with the sub-pixel part of the truth, camera.
    """
    rng = np.random.default_rng([seed, 2])
    objective = Objective()
    optics = Optics(objective, FieldAberrations.from_preset("smooth", optics_seed, objective.wavelength))
    place = np.array([60e-6, -40e-6])
    shift = np.random.default_rng(3).uniform(-0.5, 0.5, (count, 2))  # the same for every brightness
    position = np.column_stack([place + shift * objective.pixel_size, np.full(count, defocus)])
    rendered = optics.render(position, np.full(count, electrons), 1e-6, (2048, 2048))
    side, pitch = math.ceil(math.sqrt(count)), rendered.image.shape[1]
    mean = np.full((side * pitch, side * pitch), background)
    positions = np.empty((count, 2))
    for n in range(count):
        row, column = n // side * pitch, n % side * pitch
        mean[row : row + pitch, column : column + pitch] += rendered.image[n]
        true_px = position[n, :2] / objective.pixel_size + 2047 / 2
        positions[n] = true_px - rendered.corner[n] + (column, row)
    gain = min(2.0, 2e5 / electrons)  # keeps the brightest below saturation
    image = np.rint(OFFSET_ADU + gain * rng.poisson(mean)).astype(np.uint16)
    return image, positions, CameraNoise(OFFSET_ADU, gain, 0.0, 65535)


def figures(
    count: int = 10_000, seed: int = 1, progress: Callable[[int, int], None] | None = None
) -> list[Figure]:
    """All figures; ``count`` matched particles. Deterministic for a seed, but for the speeds."""
    parts: Sequence[Callable[[], list[Figure]]] = (
        lambda: matched_fits(count, seed),
        lambda: _weightings(count, seed),
        lambda: _brightness(max(count // 50, 20), seed),
        lambda: _honesty(max(count // 20, 50), seed),
        lambda: _detection(seed),
        lambda: _speed(seed),
    )
    table: list[Figure] = []
    for done, part in enumerate(parts):
        table += part()
        if progress:
            progress(done + 1, len(parts))
    return table


def _errors(fits: GaussianFits, truth: Array) -> tuple[Array, Array]:
    """Errors of the good fits and the mean standard deviations that they claim, (n, 7) and (7,)."""
    good = fits.flags == 0
    variance = np.einsum("nii->ni", fits.covariance[good])
    return (fits.parameters - truth)[good], np.sqrt(variance.mean(axis=0))


def matched_fits(count: int, seed: int) -> list[Figure]:
    """Gaussian truth, 21 px, 20 000 electrons, background 20."""
    table = []
    image, truth, camera = matched_field(count, seed)
    bound = np.sqrt(np.diag(cramer_rao(np.r_[0, 0, truth[0, 2:]], *pixel_grid(21))))
    start = truth[:, :2] + np.random.default_rng([seed, 4]).uniform(-1.5, 1.5, (count, 2))
    for weighting in (DEFAULT_WEIGHTING, "light_weighting"):
        fits = fit_gaussians(image, start, camera, weighting, 21)
        errors, claimed = _errors(fits, truth)
        name = f"matched fit, {weighting}"
        table.append(at_most(f"{name}: failures", np.sum(fits.flags != 0), 0))
        for k in (0, 1, 3, 4, 5):
            rms = math.sqrt(np.mean(errors[:, k] ** 2))
            table.append(at_most(f"{name}: rms({FIT_PARAMETERS[k]}) / Cramer-Rao", rms / bound[k], 1.05))
        for k, parameter in enumerate(FIT_PARAMETERS):
            ratio = claimed[k] / errors[:, k].std()
            table.append(between(f"{name}: claimed / actual sd({parameter})", ratio, 0.95, 1.05))
    return table


def _weightings(count: int, seed: int) -> list[Figure]:
    """Matched, 1e5 electrons, sigma 3 px, background 10: what distinguishes the weightings."""
    image, truth, camera = matched_field(count // 4, seed, 31, 1e5, 10.0, (3.0, 3.0), 0.0)
    errors = {
        weighting: _errors(fit_gaussians(image, truth[:, :2], camera, weighting, 31), truth)[0]
        for weighting in (DEFAULT_WEIGHTING, "light_weighting", "uniform", "poisson")
    }
    deviation = {weighting: error[:, :2].std() for weighting, error in errors.items()}
    best = deviation["poisson"]
    return [
        between("sd(x, y), light_weighting / poisson", deviation["light_weighting"] / best, 0.97, 1.03),
        between("sd(x, y), uniform / poisson", deviation["uniform"] / best, 1.25, 1.4),
        at_most("sd(x, y), default weighting / poisson", deviation[DEFAULT_WEIGHTING] / best, 1.1),
        between(
            "bias of B, light_weighting, electrons", errors["light_weighting"][:, 6].mean(), -0.35, -0.15
        ),
        between(
            "bias of B, default weighting, electrons", errors[DEFAULT_WEIGHTING][:, 6].mean(), -0.05, 0.05
        ),
        between("bias of B, poisson, electrons", errors["poisson"][:, 6].mean(), -0.05, 0.05),
    ]


def _brightness(count: int, seed: int) -> list[Figure]:
    """Physical images at 3e4 against 3e5 electrons: the shift of shapes, rms over defocus.

    What noise alone makes of this rms is subtracted.
    """
    table = []
    for weighting in (DEFAULT_WEIGHTING, "light_weighting"):
        shifts, noise = [], []
        for defocus in np.array([-2, -1, -0.5, 0, 0.5, 1, 2]) * 1e-6:
            shape = []
            for electrons in (3e4, 3e5):
                image, start, camera = physical_field(count, seed, electrons, defocus)
                fits = fit_gaussians(image, start, camera, weighting)
                values = _shape(fits, start)[fits.flags == 0]
                shape.append(values.mean(axis=0))
                noise.append(values.var(axis=0) / len(values))
            shifts.append(shape[0] - shape[1])
        square = np.mean(np.square(shifts), axis=0) - 2 * np.mean(noise, axis=0)
        x, y, ln_x, ln_y, rho = np.sqrt(np.maximum(square, 0))
        limited = weighting == DEFAULT_WEIGHTING
        name = f"brightness 3e4 against 3e5, {weighting}"
        nanometres = 1e9 * Objective().pixel_size
        table += [
            at_most(f"{name}: shift of x, y, nm", nanometres * max(x, y), 1.5 if limited else None),
            at_most(f"{name}: shift of ln sigma", max(ln_x, ln_y), 0.005 if limited else None),
            at_most(f"{name}: shift of rho", rho, 0.005 if limited else None),
        ]
    return table


def _honesty(count: int, seed: int) -> list[Figure]:
    """Physical images: claimed against actual scatter, pooled over defocus."""
    table = []
    for electrons in (1e4, 6e4, 3e5):
        claimed, actual = [], []
        for defocus in np.array([-2, -1, 0, 1, 2]) * 1e-6:
            image, start, camera = physical_field(count, seed, electrons, defocus)
            fits = fit_gaussians(image, start, camera)
            good = fits.flags == 0
            jacobian = np.ones((good.sum(), 5))
            jacobian[:, 2:4] = 1 / fits.parameters[good, 3:5]
            variance = np.einsum("nii->ni", fits.covariance[good])[:, [0, 1, 3, 4, 5]] * jacobian**2
            claimed.append(variance.mean(axis=0))
            actual.append(_shape(fits, start)[good].var(axis=0))
        ratio = np.sqrt(np.mean(np.divide(claimed, actual), axis=0))
        for k, name in enumerate(("x", "y", "ln sigma_x", "ln sigma_y", "rho")):
            quantity = f"physical images, {electrons:.0e} electrons: claimed / actual sd({name})"
            table.append(between(quantity, ratio[k], 0.93, 1.07))
    return table


def _shape(fits: GaussianFits, start: Array) -> Array:
    """Columns x, y (relative to the truth, px), ln sigma_x, ln sigma_y, rho."""
    p = fits.parameters
    return np.column_stack([p[:, :2] - start, np.log(p[:, 3]), np.log(p[:, 4]), p[:, 5]])


def _detection(seed: int) -> list[Figure]:
    """Whole frames of the simulated gear at several heights: particles missed and invented.

    Counted are isolated particles (none within 4 um) whose windows lie inside the image.
    """
    missed, invented, expected = 0, 0, 0
    for number, height in enumerate((-3e-6, -1.5e-6, 0.0, 1.5e-6, 3e-6)):
        settings = SimulationSettings(seed=seed + number, gear_z=height)
        frame = next(iter(motion_frames(settings, 1)))
        localizations = _localizer(settings).localize(frame)
        truth = frame.truth[0].position[:, :2]
        tree = cKDTree(truth)
        margin = 0.5 * 2048 * settings.pixel_size - 3e-6
        isolated = tree.query(truth, k=2)[0][:, 1] > 4e-6
        wanted = isolated & (np.abs(truth).max(axis=1) < margin)
        trusted = localizations.position[localizations.flags == Flag.NO_Z, :2]
        missed += int((cKDTree(trusted).query(truth[wanted])[0] > 0.5e-6).sum())
        invented += int((tree.query(trusted)[0] > 1e-6).sum())
        expected += int(wanted.sum())
    return [
        at_most(f"isolated particles missed, of {expected}, at heights of -3 to 3 um", missed, 0),
        at_most("trusted localizations without a particle within 1 um", invented, 0),
    ]


def _localizer(settings: SimulationSettings) -> Localizer:
    camera = CameraNoise(settings.offset_adu, settings.gain, settings.read_noise, settings.saturation_adu)
    return Localizer(camera, None)


def _speed(seed: int) -> list[Figure]:
    """Rates on one core; for information, since they belong to the machine."""
    table = []
    for window_px in (21, 31):
        image, truth, camera = matched_field(2500, seed, window_px)
        for weighting in (DEFAULT_WEIGHTING, "light_weighting", "uniform", "poisson"):
            fit = partial(fit_gaussians, image, truth[:, :2], camera, weighting, window_px)
            rate = len(truth) / _seconds(fit)
            table.append(information(f"fits per second, {window_px} px, {weighting}", round(rate, -2)))
    settings = SimulationSettings(seed=seed)
    frame = next(iter(motion_frames(settings, 1)))
    localizer = _localizer(settings)
    rate = 1 / _seconds(lambda: localizer.localize(frame), 15)
    table.append(
        information(
            f"frames per second, 2048 x 2048, {len(localizer.localize(frame))} particles", round(rate)
        )
    )
    return table


def _seconds(work: Callable[[], object], repeats: int = 3) -> float:
    """Least processor time of ``work``, all threads, after a first run that may compile."""
    work()
    times = []
    for _ in range(repeats):
        start = time.process_time()
        work()
        times.append(time.process_time() - start)
    return min(times)
