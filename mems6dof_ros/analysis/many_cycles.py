"""A recording of many cycles, analysed as far as it reaches: what needs more cycles says so."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from mems6dof_ros.analysis import motion
from mems6dof_ros.analysis.recording import Recording
from mems6dof_ros.errors import InputError
from mems6dof_ros.pose.cycle_pose import DEGREES_OF_FREEDOM
from mems6dof_ros.recording.tables import Table

Array = NDArray[np.float64]
Result = TypeVar("Result")

#: Columns of the spectra; of psi the rotation per cycle, since a rotation without teeth to return to wanders.
SPECTRA = ("dx", "dy", "dz", "tilt_x", "tilt_y", "increment_psi")

_UNITS = dict(zip(DEGREES_OF_FREEDOM, ("m", "m", "m", "rad", "rad", "rad"), strict=True))


@dataclass(frozen=True)
class Quantity:
    """One result: ``value`` with standard uncertainty ``sd`` (NaN: none given) in SI ``unit``."""

    body: str
    name: str
    unit: str
    value: float
    sd: float = math.nan


_FLOATS = "dx_m dy_m dz_m tilt_x_rad tilt_y_rad increment_psi_rad"

#: One row per result and body.
MOTION = Table(
    "motion",
    {"body": str, "quantity": str, "unit": str, "value_si": float, "sd_si": float},
    lambda row: [row.body, row.name, row.unit, row.value, row.sd],
)

#: One row per body and order of its revolution.
SPECTRUM = Table(
    "spectrum", {"body": str, "order": float, **dict.fromkeys(_FLOATS.split(), float)}, lambda row: row
)

#: One row per body and motion cycle: what is neither mean nor drift nor turns with the body.
PLAY = Table(
    "play",
    {"body": str, "cycle": int, "psi_rad": float, "x_m": float, "y_m": float}
    | {"tilt_x_rad": float, "tilt_y_rad": float},
    lambda row: row,
)


@dataclass(frozen=True)
class ManyCycles:
    """Results of ``analysis.motion`` for the n valid ``poses`` of one body in one reference; None where the
    recording does not suffice, with the reason in ``missing`` by the name of the field.

    ``cycle`` (n,); ``displacement`` (n, 6); ``sd`` (n, 6); ``turns``: revolutions covered.
    """

    body: str
    cycle: NDArray[np.int64]
    displacement: Array
    sd: Array
    centre: motion.CircularMotion | None = None
    axis: motion.CircularMotion | None = None
    steps: motion.Steps | None = None
    spectrum: motion.OrderSpectrum | None = None
    repeatability: motion.Repeatability | None = None
    budget: motion.UncertaintyBudget | None = None
    missing: dict[str, str] = field(default_factory=dict)

    @property
    def turns(self) -> float:
        return float(np.ptp(self.displacement[:, 5]) / math.tau) if len(self.cycle) else 0.0

    def play_range_sd(self, part: motion.CircularMotion, first: int) -> Array:
        """Standard uncertainty (2,) of ``part.play_range``, whose components are the degrees of freedom from
        ``first``: that of the two extreme poses, and of what was separated from them. Not how the range
        would grow with more cycles."""
        variance = np.empty(2)
        for i in range(2):
            low, high = int(part.play[:, i].argmin()), int(part.play[:, i].argmax())
            turned = self.displacement[high, 5] - self.displacement[low, 5]
            apart = float(self.cycle[high] - self.cycle[low])
            variance[i] = (self.sd[[low, high], first + i] ** 2).sum()
            if part.turning_found:
                variance[i] += part.sd_turning**2 * (2 - 2 * math.cos(turned))
            if part.drift_found:
                variance[i] += (part.sd_drift * apart) ** 2
        return np.asarray(np.sqrt(variance))

    def quantities(self) -> list[Quantity]:
        """Every number, for the table."""
        rows: list[tuple[Any, ...]] = [("revolutions", "1", self.turns)]
        for name, part, unit, first in (("centre", self.centre, "m", 0), ("tilt", self.axis, "rad", 3)):
            if part is not None:
                rows += _of_circular(name, part, self.play_range_sd(part, first), unit)
        if (steps := self.steps) is not None:
            error = steps.sd / math.sqrt(len(steps.values))
            rows += [
                ("rotation per cycle, mean", "rad", steps.mean, error),
                ("rotation per cycle, median", "rad", steps.median),
                ("rotation per cycle, spread", "rad", steps.sd),
                ("rotation per cycle, spread by measurement noise alone", "rad", steps.noise),
                ("reversals", "1", steps.reversals),
                ("stalls", "1", steps.stalls),
            ]
        if self.spectrum is not None:
            for order in (1, motion.LOAD_GEAR_TEETH):
                image = ", image of a lower one" if order > len(self.cycle) / self.turns / 2 else ""
                for name, value in zip(SPECTRA, self.spectrum.at(order), strict=True):
                    rows.append(
                        (f"amplitude of {name} at order {order}{image}", _UNITS.get(name, "rad"), value)
                    )
        for i, (name, unit) in enumerate(_UNITS.items()):
            if (again := self.repeatability) is not None:
                rows.append((f"repeatability of {name} at equal psi", unit, again.rms[i]))
                rows.append((f"repeatability of {name} by measurement noise alone", unit, again.noise[i]))
            if (budget := self.budget) is not None:
                rows.append((f"uncertainty of {name}, noise", unit, budget.noise[i]))
                rows.append((f"uncertainty of {name}, map and field", unit, budget.common[i]))
                rows.append((f"uncertainty of {name}, total", unit, budget.total[i]))
                rows.append((f"motion of {name}, rms", unit, budget.motion[i]))
        return [Quantity(self.body, *row) for row in rows]

    def spectrum_rows(self) -> list[list[Any]]:
        """Rows of SPECTRUM; none below one revolution."""
        if self.spectrum is None:
            return []
        pairs = zip(self.spectrum.order, self.spectrum.amplitude, strict=True)
        return [[self.body, order, *amplitude] for order, amplitude in pairs]

    def play_rows(self) -> list[list[Any]]:
        """Rows of PLAY; none below one revolution."""
        if self.centre is None or self.axis is None:
            return []
        cycles = zip(self.cycle, self.displacement[:, 5], self.centre.play, self.axis.play, strict=True)
        return [[self.body, cycle, psi, *play, *tilt] for cycle, psi, play, tilt in cycles]


def analyse_cycles(recording: Recording, body: str) -> ManyCycles:
    """What the valid poses of ``body`` tell of its motion, all expressed in the last reference."""
    valid = [pose for pose in recording.in_last_reference(body) if pose.valid]
    cycle = np.array([pose.cycle for pose in valid], np.int64)
    displacement = np.array([pose.displacement for pose in valid]).reshape(-1, 6)
    covariance = np.array([pose.displacement_covariance for pose in valid]).reshape(-1, 6, 6)
    increment = np.array([pose.increment for pose in valid]).reshape(-1, 6)
    of_increment = np.array([pose.increment_covariance for pose in valid]).reshape(-1, 6, 6)
    span = np.array([pose.increment_cycles for pose in valid], np.int64)
    psi = displacement[:, 5]
    # Increments of earlier references are about another origin, which matters where it is far away.
    own = [pose for pose in recording.poses[body] if pose.reference_version == recording.last_version(body)]
    unmoved = np.isin(cycle, [pose.cycle for pose in own])
    missing: dict[str, str] = {}

    def attempt(name: str, function: Callable[..., Result], *arguments: Any) -> Result | None:
        try:
            return function(*arguments)
        except InputError as error:
            missing[name] = f"{error.expected} needed, found {error.found}"
            return None

    sd = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    return ManyCycles(
        body,
        cycle,
        displacement,
        sd,
        attempt("centre", _circular, displacement[:, :2], psi, cycle),
        attempt("axis", _circular, displacement[:, 3:5], psi, cycle),
        attempt("steps", motion.rotation_per_cycle, increment[:, 5], np.sqrt(of_increment[:, 5, 5]), span),
        attempt("spectrum", _spectrum, displacement, increment[:, 5], span),
        attempt("repeatability", motion.repeatability, displacement, covariance, psi, cycle),
        _budget(displacement, covariance, of_increment, cycle, unmoved),
        missing,
    )


def _circular(values: Array, psi: Array, cycle: NDArray[np.int64]) -> motion.CircularMotion:
    """From one revolution on: below it what turns and what does not are hardly told apart."""
    turns = float(np.ptp(psi) / math.tau) if len(psi) else 0.0
    if turns < 1:
        raise InputError("play", f"{turns:.2f} revolutions", "one or more")
    return motion.separate_turning(values, psi, cycle)


def _spectrum(displacement: Array, step: Array, span: NDArray[np.int64]) -> motion.OrderSpectrum:
    """Of the SPECTRA, over the cycles that follow the one before."""
    keep = span == 1
    if not keep.any():
        raise InputError("order spectrum", "no two cycles in a row", "one revolution or more")
    values = np.column_stack([displacement[keep, :5], step[keep]])
    return motion.order_spectrum(values, displacement[keep, 5])


def _budget(
    displacement: Array,
    covariance: Array,
    of_increment: Array,
    cycle: NDArray[np.int64],
    keep: NDArray[np.bool_],
) -> motion.UncertaintyBudget | None:
    if not keep.any():
        return None
    return motion.uncertainty_budget(displacement[keep], covariance[keep], of_increment[keep], cycle[keep])


def _of_circular(name: str, part: motion.CircularMotion, sd_range: Array, unit: str) -> list[tuple[Any, ...]]:
    sd = part.sd_turning
    rows: list[tuple[Any, ...]] = [
        (f"{name}: turning with the body, amplitude", unit, part.amplitude, sd),
        (f"{name}: turning with the body, x", unit, part.turning[0], sd),
        (f"{name}: turning with the body, y", unit, part.turning[1], sd),
    ]
    for i, axis in enumerate("xy"):
        rows += [
            (f"{name}: fixed in the field, {axis}", unit, part.mean[i]),
            (f"{name}: drift per cycle, {axis}", unit, part.drift[i], part.sd_drift),
            (f"{name}: play range, {axis}", unit, part.play_range[i], sd_range[i]),
            (f"{name}: play rms, {axis}", unit, part.play_rms[i]),
        ]
    return rows
