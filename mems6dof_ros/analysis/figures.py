"""The figures of a report, each a function of what was measured. Lengths in nm, angles in mrad or urad."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import fields
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from mems6dof_ros.analysis.recording import Recording
from mems6dof_ros.analysis.truth import TruthComparison
from mems6dof_ros.localization.localizations import Latency
from mems6dof_ros.pose.cycle_pose import DEGREES_OF_FREEDOM, CyclePose

Array = NDArray[np.float64]

# Okabe and Ito's colours, told apart by everybody.
BLUE, ORANGE, GREEN, RED, GREY, BLACK = "#0072B2", "#E69F00", "#009E73", "#D55E00", "#8A8F98", "#1B1F24"

_STYLE: Any = {
    "font.family": "sans-serif",
    "font.size": 9,
    "axes.titlesize": 9.5,
    "axes.titlelocation": "left",
    "axes.labelsize": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#50565F",
    "axes.grid": True,
    "grid.color": "#E3E6EA",
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "lines.linewidth": 1.2,
    "lines.markersize": 3,
    "legend.frameon": False,
    "legend.fontsize": 8,
    "figure.constrained_layout.use": True,
    "savefig.dpi": 130,
}

#: Symbol, unit and units per SI unit for each degree of freedom.
DISPLAY = {
    "dx": ("Δx", "nm", 1e9),
    "dy": ("Δy", "nm", 1e9),
    "dz": ("Δz", "nm", 1e9),
    "tilt_x": ("tilt x", "mrad", 1e3),
    "tilt_y": ("tilt y", "mrad", 1e3),
    "psi": ("ψ", "mrad", 1e3),
}


@contextmanager
def style() -> Iterator[None]:
    """The look of all figures; create and save them within."""
    with matplotlib.rc_context(_STYLE):
        yield


def degrees_of_freedom(poses: Sequence[CyclePose], comparison: TruthComparison | None) -> Figure:
    """Six degrees of freedom against motion cycle, with bars of two standard deviations, and truth."""
    figure, axes = grid(3, 2, (10, 7.2))
    cycle, values, spread = _cycles(poses), _displacements(poses), _spreads(poses)
    true = _true_displacements(poses, comparison)
    for i, name in enumerate(DEGREES_OF_FREEDOM):
        axis = axes[i % 3][i // 3]
        symbol, unit, scale = DISPLAY[name]
        value, truth = values[:, i].copy(), true[:, i].copy()
        precision = f"1 sd: {quantity(np.nanmedian(spread[:, i]), unit)}"
        if comparison is not None:
            precision += f", error {quantity(comparison.rms[i], unit)} rms"
        if name == "psi":
            uniform, step = _uniform_rotation(poses)
            value, truth = value - uniform, truth - uniform
            symbol = f"{symbol} less {number(step * scale, 4)} mrad/cycle"
        if np.isfinite(truth).any():
            axis.plot(cycle, truth * scale, color=BLACK, lw=0.8, label="truth")
        else:
            axis.plot(cycle, value * scale, color=BLUE, lw=0.5, alpha=0.5)
        size = float(np.clip(40 / math.sqrt(len(poses)), 1.5, 4))
        bars = {"fmt": "o", "color": BLUE, "ms": size, "ecolor": BLUE, "elinewidth": 0.9, "zorder": 3}
        axis.errorbar(cycle, value * scale, 2 * spread[:, i] * scale, label="measured ± 2 sd", **bars)
        axis.set_title(f"{symbol}   {precision}")
        axis.set_ylabel(unit)
        _mark(axis, poses)
    for row in axes[-1]:
        row.set_xlabel("motion cycle")
    figure.legend(*axes[0][0].get_legend_handles_labels(), loc="outside upper right", ncols=2)
    return figure


def rotation(poses: Sequence[CyclePose]) -> Figure:
    """Rotation per motion cycle, its distribution, and the rotation in sum."""
    figure = Figure(figsize=(10, 4.8))
    grid = figure.add_gridspec(2, 2, width_ratios=(4, 1))
    above = figure.add_subplot(grid[0, 0])
    beside = figure.add_subplot(grid[0, 1], sharey=above)
    below = figure.add_subplot(grid[1, 0], sharex=above)
    cycle, value, spread = rotation_per_cycle(poses)
    above.errorbar(cycle, value * 1e3, 2 * spread * 1e3, fmt="o", color=BLUE, ecolor=GREY, elinewidth=0.8)
    above.set_ylabel("mrad per cycle")
    if len(value):
        title = f"Rotation per motion cycle (bars: 2 sd; 1 sd: {number(np.median(spread) * 1e6)} µrad)"
        above.set_title(title)
        beside.hist(value * 1e3, bins="auto", orientation="horizontal", color=BLUE, alpha=0.75)
    beside.set_xlabel("cycles")
    beside.tick_params(labelleft=False)
    _mark(above, poses)
    below.plot(_cycles(poses), _displacements(poses)[:, 5] / (2 * math.pi), color=BLUE)
    below.set_title("Rotation in sum")
    below.set_ylabel("revolutions")
    below.set_xlabel("motion cycle")
    if len(value) > 1:
        mean, sd = value.mean() * 1e3, value.std(ddof=1) * 1e3
        text = (
            f"mean {mean:.4f} mrad\n± {sd / math.sqrt(len(value)):.4f} mrad\n\nspread {sd:.3f} mrad (1 sd)\n"
            f"from {value.min() * 1e3:.2f}\nto {value.max() * 1e3:.2f} mrad\n\n"
            f"{2 * math.pi / abs(mean * 1e-3):.2f} cycles\nper revolution"
        )
        figure.text(0.835, 0.06, text, fontsize=9, va="bottom", linespacing=1.35)
    return figure


def paper_angles(poses: Sequence[CyclePose]) -> Figure:
    """Precession and nutation; what noise leaves undetermined is left out or pale."""
    figure, axes = grid(2, 1, (10, 4.6))
    cycle = _cycles(poses)
    beta = np.array([pose.angles.beta for pose in poses]) * 1e3
    sd_beta = np.array([pose.angles.sd_beta for pose in poses]) * 1e3
    detected = np.array([pose.angles.beta_valid for pose in poses], bool)
    axis = axes[0][0]
    axis.fill_between(cycle, beta - 2 * sd_beta, beta + 2 * sd_beta, color=BLUE, alpha=0.2, lw=0)
    axis.plot(cycle, beta, color=BLUE, lw=0.8)
    axis.plot(cycle[~detected], beta[~detected], "o", mfc="white", color=GREY, label="tilt not detected")
    axis.set_title("Nutation β (band: 2 sd)")
    axis.set_ylabel("mrad")
    if (~detected & np.isfinite(beta)).any():
        axis.legend()
    known = np.array([pose.angles.alpha_valid for pose in poses], bool)
    alpha = np.degrees([pose.angles.alpha for pose in poses])
    sd_alpha = np.degrees([pose.angles.sd_alpha for pose in poses])
    axis = axes[1][0]
    axis.errorbar(
        cycle[known], alpha[known], 2 * sd_alpha[known], fmt="o", color=BLUE, ecolor=GREY, elinewidth=0.8
    )
    share = f"{known.sum()} of {np.isfinite(alpha).sum()} cycles"
    axis.set_title(f"Precession α, where the tilt determines it: {share} (bars: 2 sd)")
    axis.set_ylabel("deg")
    axis.set_yticks([-180, -90, 0, 90, 180])
    axis.set_xlabel("motion cycle")
    for row in axes[:, 0]:
        _mark(row, poses)
    return figure


def residuals(poses: Sequence[CyclePose]) -> Figure:
    """Residuals of the rigid transform: by cycle, by particle, and against what was claimed.

    A cycle that founds a constellation agrees with itself, by definition, and is left out."""
    figure = Figure(figsize=(10, 6))
    grid = figure.add_gridspec(2, 6)
    cycle = _cycles(poses)
    founding = np.array([pose.valid and not np.nan_to_num(pose.residual).any() for pose in poses])
    panels = (
        ("Residual in x and y", "nm rms", [pose.residual_rms_xy * 1e9 for pose in poses]),
        ("Residual in z", "nm rms", [pose.residual_rms_z * 1e9 for pose in poses]),
        ("Reduced chi-square", "", [pose.chi_square for pose in poses]),
    )
    for k, (title, unit, values) in enumerate(panels):
        axis = figure.add_subplot(grid[0, 2 * k : 2 * k + 2])
        shown = np.where(founding, np.nan, values)
        axis.plot(cycle, shown, ".", color=BLUE)
        median = float(np.nanmedian(shown)) if np.isfinite(shown).any() else math.nan
        axis.axhline(median, color=GREY, lw=0.8)
        axis.set_title(f"{title}, median {number(median)}")
        axis.set_ylabel(unit)
        axis.set_xlabel("motion cycle")
        axis.set_ylim(bottom=0)
        _mark(axis, poses)
    parts = [pose.residual for pose, own in zip(poses, founding, strict=True) if pose.valid and not own]
    every = np.concatenate(parts or [np.zeros((0, 3))]) * 1e9
    for k, name in enumerate("xyz"):
        axis = figure.add_subplot(grid[1, 2 * k : 2 * k + 2])
        part = every[np.isfinite(every[:, k]), k]
        if len(part):
            robust = 1.4826 * np.median(np.abs(part - np.median(part)))
            span = 5 * max(robust, 1e-3)
            axis.hist(np.clip(part, -span, span), bins=61, range=(-span, span), color=BLUE, alpha=0.75)
            axis.set_yscale("log")
            axis.set_title(f"All residuals in {name}, rms {number(np.sqrt((part**2).mean()))} nm")
        axis.set_xlabel("nm")
    return figure


def constellation(recording: Recording, body: str) -> Figure:
    """The particles in the body frame with their heights, and the mean residuals over the field."""
    figure, axes = grid(1, 2, (10, 4.9), sharex=False)
    particles = recording.constellation(body, recording.last_version(body))
    x, y, z = particles.position.T * 1e6
    left, right = axes[0]
    size = 8 + 40 * particles.seen / max(particles.seen.max(initial=1), 1)
    plane = np.column_stack([np.ones_like(x), x, y])
    relief = (z - plane @ np.linalg.lstsq(plane, z, rcond=None)[0]) * 1e3
    limit = np.percentile(np.abs(relief), 98) if len(z) else 1.0
    points = left.scatter(x, y, s=size, c=relief, cmap="RdBu_r", vmin=-limit, vmax=limit, ec=BLACK, lw=0.4)
    figure.colorbar(points, ax=left, label="height above the mean plane (nm)", shrink=0.7)
    left.plot(0, 0, "+", color=BLACK, ms=10)
    left.set_title(f"{len(x)} particles in the body frame")
    place, vector = mean_residuals(recording, body)
    if len(place):
        lateral = np.hypot(*vector[:, :2].T) * 1e9
        arrows = right.quiver(*place.T * 1e6, *(vector[:, :2].T * 1e9), lateral, cmap="viridis", pivot="mid")
        figure.colorbar(arrows, ax=right, label="mean residual in x, y (nm)", shrink=0.7)
        half = 1.1e6 * float(np.abs(place).max())
        right.set(xlim=(-half, half), ylim=(-half, half))
    right.set_title("Residuals that stay in the field" if len(place) else "Too few residuals for a map")
    for axis in (left, right):
        axis.set_aspect("equal")
        axis.invert_yaxis()  # y runs down, as in the image
        axis.set_xlabel("x (µm)")
        axis.set_ylabel("y (µm)")
    return figure


def particles(poses: Sequence[CyclePose]) -> Figure:
    """Particles seen, expected and used, by cycle."""
    figure, axes = grid(1, 1, (10, 2.4))
    axis, cycle = axes[0][0], _cycles(poses)
    for name, color in (("seen", GREY), ("expected", ORANGE), ("used", BLUE)):
        counts = [getattr(pose, f"particles_{name}") for pose in poses]
        axis.step(cycle, counts, where="mid", color=color, label=name)
    axis.set_title("Particles")
    axis.set_ylim(bottom=0)
    axis.set_xlabel("motion cycle")
    axis.legend(ncols=3, loc="lower right")
    _mark(axis, poses)
    return figure


def truth_errors(poses: Sequence[CyclePose], comparison: TruthComparison) -> Figure:
    """Errors against truth with the claimed bands of two standard deviations."""
    figure, axes = grid(3, 2, (10, 7.2))
    rms, claimed = comparison.rms, comparison.claimed_rms
    for i, name in enumerate(DEGREES_OF_FREEDOM):
        axis = axes[i % 3][i // 3]
        symbol, unit, scale = DISPLAY[name]
        if unit == "mrad":
            unit, scale = "µrad", scale * 1e3
        band = 2 * comparison.claimed[:, i] * scale
        axis.fill_between(comparison.cycle, -band, band, color=BLUE, alpha=0.18, lw=0, label="claimed, 2 sd")
        axis.axhline(0, color=GREY, lw=0.8)
        axis.plot(comparison.cycle, comparison.error[:, i] * scale, ".", color=RED, label="error")
        axis.set_title(
            f"{symbol}    rms {number(rms[i] * scale)}, claimed {number(claimed[i] * scale)} {unit}"
        )
        axis.set_ylabel(unit)
        _mark(axis, poses)
    axes[0][0].legend(loc="upper right", ncols=2)
    for axis in axes[-1]:
        axis.set_xlabel("motion cycle")
    return figure


def latency(poses: Sequence[CyclePose]) -> Figure | None:
    """Time by stage from median to 99 %, None where nothing is known."""
    stages = [field.name for field in fields(Latency)]
    values = {name: 1e3 * _finite([getattr(pose.latency, name) for pose in poses]) for name in stages}
    known = {name: part for name, part in values.items() if len(part)}
    if not known:
        return None
    figure, axes = grid(1, 1, (10, 0.6 + 0.42 * len(known)))
    axis = axes[0][0]
    for row, (name, part) in enumerate(reversed(known.items())):
        median, most = np.percentile(part, [50, 99])
        axis.plot([median, most], [row, row], color=GREY, lw=5, alpha=0.4, solid_capstyle="butt")
        axis.plot(median, row, "o", color=BLACK if name == "total" else BLUE, ms=6)
        axis.annotate(f"{median:.2f}, 99 %: {most:.2f} ms", (most, row), (6, -3), textcoords="offset points")
    axis.set_yticks(range(len(known)), [name.replace("_", " ") for name in reversed(known)])
    axis.set_ylim(-0.6, len(known) - 0.4)
    axis.set_xlim(0, 1.35 * max(np.percentile(part, 99) for part in known.values()))
    axis.set_title("Latency by stage: median and 99 %")
    axis.set_xlabel("ms")
    return figure


# What the figures and the numbers of a report share ------------------------------------------------


def rotation_per_cycle(poses: Sequence[CyclePose]) -> tuple[Array, Array, Array]:
    """Cycle, rotation rad and its standard deviation, of every increment over one single cycle."""
    rows = [
        (pose.cycle, pose.increment[5], math.sqrt(pose.increment_covariance[5, 5]))
        for pose in poses
        if pose.valid and pose.increment_cycles == 1
    ]
    cycle, value, spread = np.array(rows, float).reshape(-1, 3).T
    return cycle, value, spread


def mean_residuals(recording: Recording, body: str, bins: int = 9) -> tuple[Array, Array]:
    """Places (n, 2) m on a grid over the field, and the mean (n, 3) m of 5 or more residuals about each."""
    places, vectors = [np.zeros((0, 2))], [np.zeros((0, 3))]
    for pose in recording.poses.get(body, ()):
        found = recording.localizations.get(pose.stamp_ns)
        if pose.valid and found is not None:
            used = pose.particle_id >= 0
            places.append(found.position[used, :2])
            vectors.append(pose.residual[used])
    place, vector = np.concatenate(places), np.nan_to_num(np.concatenate(vectors))
    half = np.abs(place).max(initial=1e-9) * 1.0001
    cell = np.floor((place + half) / (2 * half) * bins).astype(int)
    unique, which, count = np.unique(cell, axis=0, return_inverse=True, return_counts=True)
    total, centre = np.zeros((len(unique), 3)), np.zeros((len(unique), 2))
    np.add.at(total, which.reshape(-1), vector)
    np.add.at(centre, which.reshape(-1), place)
    enough = count >= 5
    return (centre / count[:, None])[enough], (total / count[:, None])[enough]


def grid(rows: int, columns: int, size: tuple[float, float], sharex: bool = True) -> tuple[Figure, Any]:
    """A figure of ``size`` inches and its axes (rows, columns)."""
    figure = Figure(figsize=size)
    return figure, figure.subplots(rows, columns, squeeze=False, sharex=sharex)


def _cycles(poses: Sequence[CyclePose]) -> Array:
    return np.array([pose.cycle for pose in poses], float)


def _displacements(poses: Sequence[CyclePose]) -> Array:
    return np.array([pose.displacement for pose in poses], float).reshape(-1, 6)


def _spreads(poses: Sequence[CyclePose]) -> Array:
    return np.array([np.sqrt(np.diag(pose.displacement_covariance)) for pose in poses]).reshape(-1, 6)


def _true_displacements(poses: Sequence[CyclePose], comparison: TruthComparison | None) -> Array:
    """Measured minus error, NaN without truth."""
    true = np.full((len(poses), 6), np.nan)
    if comparison is not None:
        error = dict(zip(comparison.cycle.tolist(), comparison.error, strict=True))
        for k, pose in enumerate(poses):
            if pose.cycle in error:
                true[k] = pose.displacement - error[pose.cycle]
    return true


def _uniform_rotation(poses: Sequence[CyclePose]) -> tuple[Array, float]:
    """The straight line through psi, and its slope in rad per cycle."""
    cycle, psi = _cycles(poses), _displacements(poses)[:, 5]
    known = np.isfinite(psi)
    if known.sum() < 2:
        return np.zeros(len(poses)), 0.0
    slope, intercept = np.polyfit(cycle[known], psi[known], 1)
    return intercept + slope * cycle, float(slope)


def _mark(axis: Axes, poses: Sequence[CyclePose]) -> None:
    """Where there is no pose, and where the reference changes."""
    before = None
    for pose in poses:
        if not pose.valid:
            axis.axvspan(pose.cycle - 0.5, pose.cycle + 0.5, color=RED, alpha=0.15, lw=0)
        elif before is not None and pose.reference_version != before:
            axis.axvline(pose.cycle - 0.5, color=GREY, lw=0.8, ls=":")
        before = pose.reference_version if pose.valid else before


def _finite(values: Sequence[float]) -> Array:
    array = np.array(values, float)
    return array[np.isfinite(array)]


def quantity(value: float, unit: str) -> str:
    """A value in SI units: a length where ``unit`` is nm, else an angle."""
    if unit == "nm":
        return f"{number(value * 1e9)} nm" if value < 1e-5 else f"{number(value * 1e6)} µm"
    return f"{number(value * 1e6)} µrad" if value < 1e-3 else f"{number(value * 1e3)} mrad"


def with_uncertainty(value: float, sd: float, unit: str = "") -> str:
    """Value and standard uncertainty to the same place, two digits of the uncertainty; without one that is
    not known."""
    if not (math.isfinite(sd) and sd > 0 and math.isfinite(value)):
        return f"{number(value)} {unit}".rstrip()
    places = max(0, 1 - math.floor(math.log10(sd)))
    return f"({value:.{places}f} ± {sd:.{places}f}) {unit}".rstrip()


def number(value: float, digits: int = 3) -> str:
    """To so many significant digits, without an exponent for what is large."""
    return f"{value:#.{digits}g}".rstrip(".") if abs(value) < 1e3 else f"{value:.0f}"
