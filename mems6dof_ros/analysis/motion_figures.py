"""Figures of many cycles and of several bodies, in the style of ``figures``."""

from __future__ import annotations

import math

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Ellipse, Rectangle
from numpy.typing import NDArray

from mems6dof_ros.analysis.figures import (
    BLACK,
    BLUE,
    DISPLAY,
    GREEN,
    GREY,
    ORANGE,
    RED,
    grid,
    number,
    quantity,
    with_uncertainty,
)
from mems6dof_ros.analysis.many_cycles import SPECTRA, ManyCycles
from mems6dof_ros.analysis.motion import LOAD_GEAR_TEETH, CircularMotion, without_trend
from mems6dof_ros.analysis.relative import RelativeMotion
from mems6dof_ros.analysis.truth import TruthComparison
from mems6dof_ros.pose.cycle_pose import DEGREES_OF_FREEDOM

Array = NDArray[np.float64]

_PHASE = "twilight_shifted"
#: Of more places, neither lines between them nor ellipses can be told apart.
FOLLOWED = 100


def paths(cycles: ManyCycles) -> Figure:
    """Path of the centre and of the tilt as measured and, from one revolution on, the play in them."""
    parts = [(cycles.centre, 0, "centre"), (cycles.axis, 3, "tilt")]
    with_play = cycles.centre is not None and cycles.axis is not None
    figure, axes = grid(2 if with_play else 1, 2, (10, 9.4 if with_play else 4.8), sharex=False)
    phase = np.degrees(cycles.displacement[:, 5]) % 360
    for column, (part, first, what) in enumerate(parts):
        symbols, unit, scale = _pair(first)
        measured = cycles.displacement[:, first : first + 2] * scale
        sd = np.median(cycles.sd[:, first : first + 2], axis=0)
        axis = axes[0][column]
        points = _cloud(axis, measured, phase)
        few = len(measured) <= FOLLOWED
        for place in measured if few else ():
            axis.add_patch(Ellipse(place, *(4 * sd * scale), fill=False, color=GREY, lw=0.5))
        ellipses = "; ellipses: 2 sd" if few else ""
        axis.set_title(f"Path of the {what} (1 sd: {quantity(float(sd.mean()), unit)}{ellipses})")
        axis.set_xlabel(f"{symbols[0]} ({unit})")
        axis.set_ylabel(f"{symbols[1]} ({unit})")
        if part is None or not with_play:
            continue
        _circle(axis, part, scale)
        below = axes[1][column]
        _cloud(below, part.play * scale, phase)
        below.add_patch(
            Rectangle(
                part.play.min(axis=0) * scale, *(part.play_range * scale), fill=False, color=RED, ls="--"
            )
        )
        below.set_title(f"Play: the same less {_removed(part, unit)}")
        span, error = part.play_range * scale, cycles.play_range_sd(part, first) * scale
        below.set_xlabel(f"play in {symbols[0]} ({unit}): range {with_uncertainty(span[0], error[0], unit)}")
        below.set_ylabel(f"play in {symbols[1]} ({unit}): range {with_uncertainty(span[1], error[1], unit)}")
    colours = axes[:, 1].tolist()
    figure.colorbar(points, ax=colours, label="ψ (deg)", ticks=[0, 90, 180, 270, 360], shrink=0.5)
    return figure


def spectra(cycles: ManyCycles) -> Figure | None:
    """Amplitude by order of the revolution, None below one revolution."""
    spectrum = cycles.spectrum
    if spectrum is None:
        return None
    figure, axes = grid(3, 2, (10, 7.2))
    per_turn = len(cycles.cycle) / cycles.turns
    for i, name in enumerate(SPECTRA):
        axis = axes[i % 3][i // 3]
        symbol, unit, scale = DISPLAY.get(name, ("rotation per cycle", "mrad", 1e3))
        if unit == "mrad":
            unit, scale = "µrad", scale * 1e3
        amplitude = spectrum.amplitude[:, i] * scale
        threshold = spectrum.threshold[i] * scale
        axis.semilogy(spectrum.order, amplitude, color=BLUE, lw=0.8)
        axis.axhline(threshold, color=GREY, lw=0.9, ls="--", label="white noise: largest beyond in 5 %")
        low = float(np.percentile(amplitude, 2)) / 1.5
        axis.set_ylim(low, 4 * max(float(amplitude.max()), threshold))
        for order, colour in ((1, ORANGE), (LOAD_GEAR_TEETH, GREEN)):
            value = float(spectrum.at(order)[i]) * scale
            axis.axvline(order, color=colour, lw=1, alpha=0.8, zorder=0)
            axis.plot(order, value, "o", color=colour, ms=4)
            image = " (image)" if order > per_turn / 2 else ""
            axis.annotate(
                f"{order}: {number(value)}{image}", (order, 1), (3, -10), xycoords=("data", "axes fraction"),
                textcoords="offset points", fontsize=8, color=colour,
            )  # fmt: skip
        if per_turn / 2 < spectrum.order[-1]:
            axis.axvspan(per_turn / 2, spectrum.order[-1], color=GREY, alpha=0.1, lw=0)
        axis.set_xlim(0, spectrum.order[-1])
        axis.set_title(f"{symbol}: amplitude ({unit})")
        axis.set_ylabel(unit)
    for axis in axes[-1]:
        axis.set_xlabel("order (cycles per revolution)")
    figure.legend(*axes[0][0].get_legend_handles_labels(), loc="outside upper right")
    return figure


def by_angle(cycles: ManyCycles) -> Figure | None:
    """Displacement against psi, one colour for each revolution; None where no psi comes again."""
    again = cycles.repeatability
    if again is None:
        return None
    figure, axes = grid(3, 2, (10, 7.2))
    values = cycles.displacement.copy()
    psi = values[:, 5].copy()
    values[:, 5] = without_trend(psi, cycles.cycle)
    turn = np.floor((psi - psi[0]) / math.tau)
    angle = np.degrees(psi) % 360
    for i, name in enumerate(DEGREES_OF_FREEDOM):
        axis = axes[i % 3][i // 3]
        symbol, unit, scale = DISPLAY[name]
        points = axis.scatter(angle, values[:, i] * scale, c=turn, cmap="viridis", s=7)
        beyond = " less its trend" if name == "psi" else ""
        rms, noise = quantity(again.rms[i], unit), quantity(again.noise[i], unit)
        axis.set_title(f"{symbol}{beyond}    repeats to {rms}, noise {noise}")
        axis.set_ylabel(unit)
        axis.set_xlim(0, 360)
        axis.set_xticks(range(0, 361, 90))
    for axis in axes[-1]:
        axis.set_xlabel("ψ (deg)")
    ticks = np.unique(np.round(np.linspace(turn.min(), turn.max(), 6)))
    figure.colorbar(points, ax=axes.ravel().tolist(), label="revolution", ticks=ticks, shrink=0.5)
    return figure


def budget(cycles: ManyCycles, comparison: TruthComparison | None) -> Figure | None:
    """Uncertainty of each degree of freedom by its sources, beside the motion; None without a pose."""
    if (parts := cycles.budget) is None:
        return None
    figure, axes = grid(1, 2, (10, 2.6), sharex=False)
    for axis, names, unit, scale in (
        (axes[0][0], DEGREES_OF_FREEDOM[:3], "nm", 1e9),
        (axes[0][1], DEGREES_OF_FREEDOM[3:], "µrad", 1e6),
    ):
        first = DEGREES_OF_FREEDOM.index(names[0])
        rows = np.arange(3)[::-1]
        here = slice(first, first + 3)
        marks = [
            ("noise of the cycle", parts.noise, "s", BLUE, 0.16),
            ("map and field error", parts.common, "D", ORANGE, 0.0),
            ("claimed in all", parts.total, "|", BLACK, 0.0),
            ("motion, rms", parts.motion, "o", GREY, 0.0),
        ]
        if comparison is not None:
            marks.insert(3, ("error against truth, rms", comparison.rms, "x", RED, -0.16))
        for label, values, marker, colour, shift in marks:
            shown = np.where(values[here] > 0, values[here], np.nan) * scale
            size = 12 if marker == "|" else 5
            axis.plot(shown, rows + shift, marker, color=colour, ms=size, mew=1.6, label=label)
        axis.set_xscale("log")
        axis.set_yticks(rows, [DISPLAY[name][0] for name in names])
        axis.set_ylim(-0.6, 2.6)
        axis.set_xlabel(unit)
    handles, labels = axes[0][0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=5)
    return figure


def relative(motion: RelativeMotion) -> Figure:
    """Difference of the displacements of two bodies, with bars of two standard deviations, and truth."""
    figure, axes = grid(3, 2, (10, 7.2))
    cycle = np.array([pose.cycle for pose in motion.poses])
    for i, name in enumerate(DEGREES_OF_FREEDOM):
        axis = axes[i % 3][i // 3]
        symbol, unit, scale = DISPLAY[name]
        if name == "psi" and math.isfinite(motion.ratio):
            sign = "+" if motion.ratio < 0 else "−"
            symbol = f"ψ {sign} {abs(motion.ratio):.6f} ψ of {motion.to}"
            unit, scale = "µrad", 1e6
        value, sd = motion.displacement[:, i] * scale, motion.sd[:, i] * scale
        axis.errorbar(
            cycle,
            value,
            2 * sd,
            fmt="o",
            color=BLUE,
            ecolor=GREY,
            elinewidth=0.8,
            ms=2.5,
            label="measured ± 2 sd",
        )
        if motion.error is not None:
            true = value - motion.error[:, i] * scale
            axis.plot(cycle, true, color=BLACK, lw=0.8, label="truth", zorder=4)
        axis.set_title(f"{symbol}    1 sd: {quantity(float(np.median(motion.sd[:, i])), unit)}")
        axis.set_ylabel(unit)
    for axis in axes[-1]:
        axis.set_xlabel("motion cycle")
    if motion.error is not None:
        figure.legend(*axes[0][0].get_legend_handles_labels(), loc="outside upper right", ncols=2)
    return figure


def _pair(first: int) -> tuple[tuple[str, str], str, float]:
    """Symbols, unit and scale of the degrees of freedom ``first`` and the next."""
    (one, unit, scale), (other, _, _) = (DISPLAY[DEGREES_OF_FREEDOM[first + k]] for k in (0, 1))
    return (one, other), unit, scale


def _cloud(axis: Axes, places: Array, phase: Array) -> PathCollection:
    """Places in order, coloured by psi; the lines between them only while they can be followed."""
    if len(places) <= FOLLOWED:
        axis.plot(*places.T, color="#C9CDD3", lw=0.6, zorder=1)
    axis.set_aspect("equal", "datalim")
    return axis.scatter(places[:, 0], places[:, 1], c=phase, cmap=_PHASE, vmin=0, vmax=360, s=12, zorder=2)


def _circle(axis: Axes, part: CircularMotion, scale: float) -> None:
    """What was fitted: the part that turns, about the part that does not."""
    centre = float(part.mean[0]) * scale, float(part.mean[1]) * scale
    axis.plot(*centre, "+", color=RED, ms=9, mew=1.5, zorder=3)
    if part.turning_found:
        axis.add_patch(Circle(centre, part.amplitude * scale, fill=False, color=RED, lw=1.2))


def _removed(part: CircularMotion, unit: str) -> str:
    names = ["the mean"]
    if part.turning_found:
        names.append(f"a circle of {quantity(part.amplitude, unit)}")
    if part.drift_found:
        names.append("drift")
    return " and ".join(names)
