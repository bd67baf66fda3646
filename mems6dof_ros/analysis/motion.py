"""What many cycles tell of the microsystem: play, eccentricity, run-out, steps, spectra, repeatability.

Pure functions on arrays of displacements (n, 6) in the order of DEGREES_OF_FREEDOM (m, rad) and psi
(n,) rad, unwrapped. Model (docs/definitions.md): ``c_k = c_0 + Rz(psi_k) e + play_k`` for the centre and
``tilt_k = t_0 + Rz(psi_k) t_b + play_k`` for the axis.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from mems6dof_ros.errors import InputError

Array = NDArray[np.float64]

#: Teeth of the load gear: its tooth-mesh order, per revolution.
LOAD_GEAR_TEETH = 80


@dataclass(frozen=True)
class CircularMotion:
    """A quantity in the plane that has a part turning with the body.

    ``mean`` (2,): fixed in the field; ``turning`` (2,): fixed to the body, at psi = 0 (eccentricity, or
    tilt of the body on its axis); ``drift`` (2,) per cycle; ``sd_turning``, ``sd_drift``: of each component;
    ``play`` (n, 2): what remains, with the part that turns and the drift left in it where they are not
    significant (``turning_found``, ``drift_found``), since removing what is not there adds to its range;
    ``turns``: revolutions covered. Below half a revolution ``mean`` and ``turning`` are hardly told apart:
    ``sd_turning`` says so.
    """

    mean: Array
    turning: Array
    drift: Array
    sd_turning: float
    sd_drift: float
    turning_found: bool
    drift_found: bool
    play: Array
    turns: float

    @property
    def amplitude(self) -> float:
        """Length of ``turning``: half the run-out, peak to valley."""
        return float(np.hypot(*self.turning))

    @property
    def play_range(self) -> Array:
        """Largest less smallest of ``play``, (2,): grows with the number of cycles."""
        return np.asarray(np.ptp(self.play, axis=0))

    @property
    def play_rms(self) -> Array:
        """Rms of ``play`` about its mean, (2,)."""
        return np.asarray(self.play.std(axis=0))


def separate_turning(
    values: Array, psi: Array, cycle: NDArray[np.int64] | None = None, significance: float = 3.0
) -> CircularMotion:
    """Least squares of ``values`` (n, 2) = mean + Rz(psi) turning + drift k + play; ``psi`` (n,); ``cycle``
    (n,), None: none is missing; ``significance``: standard deviations from which a part is one.

    Drift is left out below one revolution, where it cannot be told from the turning part. The standard
    deviations are those of play that remembers the cycle before. Raises InputError for fewer than 8 cycles.
    """
    n = len(psi)
    if n < 8:
        raise InputError("motion analysis", f"{n} cycles", "8 or more")
    turns = float(np.ptp(psi) / math.tau)
    c, s, one, zero, k = np.cos(psi), np.sin(psi), np.ones(n), np.zeros(n), _counted(cycle, n)
    x_rows = [one, zero, c, -s, k, zero]
    y_rows = [zero, one, s, c, zero, k]
    parts = 6 if turns >= 1 else 4
    design = np.concatenate([np.column_stack(x_rows), np.column_stack(y_rows)])[:, :parts]
    target = values.T.ravel()
    solution, _, rank, _ = np.linalg.lstsq(design, target, rcond=1e-9)
    left = target - design @ solution
    variance = float(left @ left) / max(2 * n - rank, 1) * memory_factor(left.reshape(2, n).T)
    sd = np.full(6, math.inf)
    if rank == parts:
        sd[:parts] = np.sqrt(variance * np.diag(np.linalg.inv(design.T @ design)))
    turning_found = bool(np.hypot(*solution[2:4]) > significance * sd[2])
    drift_found = parts == 6 and bool(np.hypot(*solution[4:6]) > significance * sd[4])
    removed = np.array([True, True, turning_found, turning_found, drift_found, drift_found])[:parts]
    play = (target - design @ (solution * removed)).reshape(2, n).T
    drift = solution[4:6] if parts == 6 else np.zeros(2)
    return CircularMotion(
        solution[:2],
        solution[2:4],
        drift,
        float(sd[2]),
        float(sd[4]),
        turning_found,
        drift_found,
        play,
        turns,
    )


def memory_factor(play: Array) -> float:
    """By how much the variance of slow quantities fitted to ``play`` (n, d) exceeds that of white noise.

    The power of a first-order autoregressive process at low frequency, (1 + r) / (1 - r), r being the
    correlation from one cycle to the next where that is positive (Bartlett 1946).
    """
    total = float((play**2).sum())
    r = float((play[1:] * play[:-1]).sum()) / total if total else 0.0
    return (1 + min(r, 0.95)) / (1 - min(r, 0.95)) if r > 0 else 1.0


def without_trend(values: Array, cycle: NDArray[np.int64] | None = None) -> Array:
    """``values`` (n,) less the straight line through them over ``cycle`` (n,), None: none is missing."""
    k = _counted(cycle, len(values))
    return np.asarray(values - np.polyval(np.polyfit(k, values, 1), k))


def _counted(cycle: NDArray[np.int64] | None, n: int) -> Array:
    """Cycles from the mean."""
    k = np.arange(n) if cycle is None else cycle
    return np.asarray(k - k.mean())


@dataclass(frozen=True)
class Steps:
    """Rotation per motion cycle, rad: ``values`` (m,), of the increments of one cycle; ``median``, ``mean``,
    ``sd``; ``noise``: what the uncertainties alone would scatter; ``reversals`` and ``stalls`` (less than a
    tenth of the median): how many."""

    values: Array
    median: float
    mean: float
    sd: float
    noise: float
    reversals: int
    stalls: int


def rotation_per_cycle(increment_psi: Array, increment_sd: Array, span: NDArray[np.int64]) -> Steps:
    """Distribution of the rotation per cycle from ``increment_psi`` (n,) rad with ``increment_sd`` (n,), each
    over ``span`` (n,) cycles; only those of one cycle count. Raises InputError where there is none."""
    keep = (span == 1) & np.isfinite(increment_psi)
    values = increment_psi[keep]
    if len(values) == 0:
        raise InputError("rotation per cycle", "no increments of one cycle", "at least one")
    median = float(np.median(values))
    return Steps(
        values,
        median,
        float(values.mean()),
        float(values.std(ddof=1)) if len(values) > 1 else math.nan,
        float(np.sqrt(np.mean(increment_sd[keep] ** 2))),
        int((values * median < -0.1 * median**2).sum()),
        int((np.abs(values) <= 0.1 * abs(median)).sum()),
    )


@dataclass(frozen=True)
class OrderSpectrum:
    """Amplitudes against orders of the revolution (cycles per turn of the body).

    ``order`` (m,); ``amplitude`` (m, d): of a sine of that order, in the unit of the values; ``threshold``
    (d,): amplitude that white noise of the same variance exceeds at *any* order with 5 %.
    """

    order: Array
    amplitude: Array
    threshold: Array

    def at(self, order: float) -> Array:
        """Amplitude (d,) at the nearest order."""
        return np.asarray(self.amplitude[int(np.argmin(np.abs(self.order - order)))])


def order_spectrum(values: Array, psi: Array, highest: float = 1.5 * LOAD_GEAR_TEETH) -> OrderSpectrum:
    """Least-squares spectrum (Lomb 1976) of ``values`` (n, d) against ``psi`` (n,) rad.

    Cycles need not be evenly spaced, so the drive's irregularity is no problem; but a body that
    is seen once per tooth shows the tooth-mesh order as a constant (aliasing): orders beyond half the
    number of cycles per revolution repeat lower ones, unless the steps scatter. Orders four times as dense
    as the revolutions covered resolve, so that no peak falls between two. Raises InputError below one
    revolution.
    """
    turns = float(np.ptp(psi) / math.tau)
    if turns < 1:
        raise InputError("order spectrum", f"{turns:.2f} revolutions", "one or more")
    values = values - values.mean(axis=0)
    order = np.arange(4, math.floor(4 * highest * turns) + 1) / (4 * turns)
    amplitude = np.empty((len(order), values.shape[1]))
    for row, each in enumerate(order):
        phase = each * psi
        # Lomb's shift makes sine and cosine orthogonal on these very samples.
        phase = phase - 0.5 * math.atan2(float(np.sin(2 * phase).sum()), float(np.cos(2 * phase).sum()))
        c, s = np.cos(phase), np.sin(phase)
        # By power: where all samples have one phase, one of the two coefficients is noise alone.
        power = sum(
            (values.T @ part) ** 2 / (part @ part) for part in (c, s) if part @ part > 1e-9 * len(psi)
        )
        amplitude[row] = np.sqrt(2 * power / len(psi))
    independent = max(min(len(order) // 4, len(psi) // 2), 1)
    # Between them the spectrum may be higher: the square root of the level times as likely (Baluev 2008).
    chances = independent * math.sqrt(math.log(independent / 0.05))
    # Power of white noise at one order: (variance / n) chi-square with 2 degrees of freedom, times 2.
    level = chi2.ppf(0.95 ** (1 / chances), 2)
    threshold = np.sqrt(2 * values.var(axis=0) / len(psi) * level)
    return OrderSpectrum(order, amplitude, threshold)


@dataclass(frozen=True)
class Repeatability:
    """Agreement of cycles at equal psi in different revolutions: ``rms`` (6,), of one cycle (pair differences
    over sqrt 2), what the uncertainties alone would give (``noise``, (6,)), and the number of ``pairs``."""

    rms: Array
    noise: Array
    pairs: int


def repeatability(
    displacement: Array,
    covariance: Array,
    psi: Array,
    cycle: NDArray[np.int64] | None = None,
    tolerance: float = math.radians(1),
) -> Repeatability:
    """Compare ``displacement`` (n, 6) one or more revolutions apart where psi agrees within ``tolerance``
    rad; psi itself is compared with its trend, a straight line over ``cycle`` (n,), None: none is missing.
    ``covariance`` (n, 6, 6). Raises InputError where no two cycles are that close."""
    if len(psi) < 2:
        raise InputError("repeatability", "no two cycles at equal psi", "two revolutions or more")
    values = displacement.copy()
    values[:, 5] = without_trend(psi, cycle)
    difference = psi[None, :] - psi[:, None]
    turn = np.rint(difference / math.tau)
    near = (np.abs(difference - math.tau * turn) < tolerance) & (turn >= 1)
    first, second = np.nonzero(near)
    if len(first) == 0:
        raise InputError("repeatability", "no two cycles at equal psi", "two revolutions or more")
    variance = np.diagonal(covariance, axis1=1, axis2=2)
    return Repeatability(
        np.sqrt(((values[second] - values[first]) ** 2).mean(axis=0) / 2),
        np.sqrt((variance[first] + variance[second]).mean(axis=0) / 2),
        len(first),
    )


@dataclass(frozen=True)
class UncertaintyBudget:
    """Where the uncertainty of each degree of freedom comes from, rms standard deviations (6,):
    ``noise`` of the cycle's own localizations, ``common`` the map and the field error, ``total``; and
    ``motion``, the rms of the displacement itself, for comparison."""

    noise: Array
    common: Array
    total: Array
    motion: Array


def uncertainty_budget(
    displacement: Array,
    covariance: Array,
    increment_covariance: Array,
    cycle: NDArray[np.int64] | None = None,
) -> UncertaintyBudget:
    """Budget from ``displacement`` (n, 6), its ``covariance`` (n, 6, 6) and that of the increments (n, 6, 6),
    which hold the noise of two cycles and nothing common (see docs/definitions.md); NaN without increments.
    The motion of psi is that about its trend over ``cycle`` (n,), None: none is missing."""
    total = np.diagonal(covariance, axis1=1, axis2=2)
    twice = np.diagonal(increment_covariance, axis1=1, axis2=2)
    known = np.isfinite(twice).all(axis=1)
    noise = twice[known].mean(axis=0) / 2 if known.any() else np.full(6, np.nan)
    values = displacement.copy()
    if len(values) > 1:
        values[:, 5] = without_trend(values[:, 5], cycle)
    mean = total.mean(axis=0)
    return UncertaintyBudget(
        np.sqrt(noise), np.sqrt(np.maximum(mean - noise, 0)), np.sqrt(mean), values.std(axis=0)
    )
