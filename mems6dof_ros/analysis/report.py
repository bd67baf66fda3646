"""A recording as a page: figures as PNG, tables of numbers, and one HTML file that needs nothing else."""

from __future__ import annotations

import base64
import io
import json
import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jinja2 import Environment, PackageLoader
from matplotlib.figure import Figure

from mems6dof_ros import __version__
from mems6dof_ros.analysis import figures, motion_figures
from mems6dof_ros.analysis.many_cycles import MOTION, PLAY, SPECTRUM, ManyCycles, analyse_cycles
from mems6dof_ros.analysis.motion import CircularMotion
from mems6dof_ros.analysis.recording import CONSTELLATION, Recording, load_recording
from mems6dof_ros.analysis.relative import RELATIVE, RelativeMotion, relative_motion
from mems6dof_ros.analysis.truth import TruthComparison, compare
from mems6dof_ros.errors import InputError
from mems6dof_ros.pose.cycle_pose import DEGREES_OF_FREEDOM, CyclePose
from mems6dof_ros.recording.tables import CYCLES, LOCALIZATIONS, Table, TableWriter, sightings


class Picture(NamedTuple):
    """One figure of the page: file name without suffix, what it shows, PNG."""

    name: str
    caption: str
    png: bytes

    @property
    def data_url(self) -> str:
        """The image within the page."""
        return "data:image/png;base64," + base64.b64encode(self.png).decode()


@dataclass(frozen=True)
class BodyReport:
    """What the page says of one body, or of one relative to another.

    ``name``: of its files; ``summary``: names and values; ``columns`` and ``freedoms``: of the table with one
    row for each degree of freedom.
    """

    title: str
    name: str
    summary: Sequence[tuple[str, str]]
    columns: Sequence[str]
    freedoms: Sequence[Sequence[str]]
    pictures: Sequence[Picture]


def write_report(bag: Path, out: Path) -> Path:
    """Write ``report.html``, its figures and tables; returns the page's path.

    Files of an earlier report in ``out`` are replaced. Raises InputError for a bag without poses.
    """
    recording = load_recording(bag)
    if out.exists() and not out.is_dir():
        raise InputError(str(out), "a file", "a directory, which may exist")
    out.mkdir(parents=True, exist_ok=True)
    analysed = {body: analyse_cycles(recording, body) for body in recording.poses}
    truths = {body: compare_with_truth(recording, body) for body in recording.poses}
    relatives, bodies = [], [describe(recording, cycles, truths[body]) for body, cycles in analysed.items()]
    first, *others = recording.poses
    for body in others:
        try:
            relatives.append(relative_motion(recording, body, first))
        except InputError:  # never both in view
            continue
        bodies.append(describe_relative(relatives[-1]))
    for section in bodies:
        for picture in section.pictures:
            (out / f"{section.name}_{picture.name}.png").write_bytes(picture.png)
    _write_tables(recording, list(analysed.values()), relatives, out)
    environment = Environment(loader=PackageLoader("mems6dof_ros.analysis", "."), autoescape=True)
    page = environment.get_template("report.html").render(
        recording=recording,
        bodies=bodies,
        provenance=_readable(recording.provenance),
        version=__version__,
    )
    path = out / "report.html"
    path.write_text(page, encoding="utf-8")
    return path


def describe(recording: Recording, cycles: ManyCycles, comparison: TruthComparison | None) -> BodyReport:
    """Numbers and figures of one body."""
    body = cycles.body
    measured = recording.poses[body]
    drawn: dict[str, tuple[str, Figure | None]] = {}
    with figures.style():
        if len(cycles.cycle):
            drawn |= _of_motion(recording, cycles, comparison)
        drawn["particles"] = ("Particles by cycle.", figures.particles(measured))
        drawn["latency"] = ("Latency by stage, host clocks.", figures.latency(measured))
        pictures = _pictures(drawn)
    columns, rows = _freedoms(cycles, comparison)
    return BodyReport(body, body, _summary(measured, cycles, comparison), columns, rows, pictures)


def describe_relative(motion: RelativeMotion) -> BodyReport:
    """Numbers and figure of one body relative to another."""
    summary = [("motion cycles with both", f"{len(motion.poses)}")]
    if math.isfinite(motion.ratio):
        summary.append(("ratio of the rotations", figures.with_uncertainty(motion.ratio, motion.sd_ratio)))
    columns = ["spread, 1 sd", "claimed, 1 sd"] + ["rms error", "error / claimed"] * (
        motion.error is not None
    )
    rows = []
    for i, name in enumerate(DEGREES_OF_FREEDOM):
        symbol, unit, _ = figures.DISPLAY[name]
        claimed = math.sqrt((motion.sd[:, i] ** 2).mean())
        spread = float(motion.displacement[:, i].std(ddof=1))
        row = [symbol, figures.quantity(spread, unit), figures.quantity(claimed, unit)]
        if motion.error is not None:
            rms = math.sqrt(np.nanmean(motion.error[:, i] ** 2))
            row += [figures.quantity(rms, unit), f"{rms / claimed:.2f}"]
        rows.append(row)
    caption = (
        f"Displacement of {motion.of} less that of {motion.to}, about the mean, in the microscope's axes; of "
        "ψ what departs from a constant ratio of the rotations. Bars: two standard deviations."
    )
    with figures.style():
        pictures = _pictures({"relative": (caption, motion_figures.relative(motion))})
    title = f"{motion.of} relative to {motion.to}"
    return BodyReport(title, f"{motion.of}_to_{motion.to}", summary, columns, rows, pictures)


def _pictures(drawn: Mapping[str, tuple[str, Figure | None]]) -> list[Picture]:
    return [Picture(name, text, _png(figure)) for name, (text, figure) in drawn.items() if figure is not None]


def _of_motion(
    recording: Recording, cycles: ManyCycles, comparison: TruthComparison | None
) -> dict[str, tuple[str, Figure | None]]:
    """Caption and figure by name."""
    body = cycles.body
    measured, poses = recording.poses[body], recording.in_last_reference(body)
    drawn: dict[str, tuple[str, Figure | None]] = {
        "degrees_of_freedom": (
            "Displacement from the reference in six degrees of freedom. Bars of two standard deviations, "
            "often smaller than the dots. Cycles before the last reference are expressed in it.",
            figures.degrees_of_freedom(poses, comparison),
        ),
        "angles": ("The paper's nutation and precession.", figures.paper_angles(poses)),
        "rotation": ("Rotation per motion cycle and in sum.", figures.rotation(poses)),
        "paths": (
            "Paths of the centre and of the tilt, by rotation, and the play in them. What turns with "
            "the body depends on which point is the origin and which pose the reference; the play does not. "
            "Parts are removed that exceed three standard deviations.",
            motion_figures.paths(cycles),
        ),
        "by_angle": (
            "What repeats at equal ψ in each revolution, and what does not.",
            motion_figures.by_angle(cycles),
        ),
        "spectra": (
            "Amplitudes by order: 1 is the revolution, 80 the mesh of the teeth. Seen once per cycle, orders "
            "in the grey part are images of lower ones, unless the steps scatter.",
            motion_figures.spectra(cycles),
        ),
        "budget": (
            "Where the uncertainty comes from, in the last reference, beside the motion itself.",
            motion_figures.budget(cycles, comparison),
        ),
    }
    if comparison is not None:
        drawn["truth"] = (
            "Errors against truth; 95 of 100 should lie inside the claimed band.",
            figures.truth_errors(measured, comparison),
        )
    drawn["residuals"] = ("Residuals of the rigid transform.", figures.residuals(measured))
    drawn["constellation"] = (
        "Left: the particles, size by how often seen. Right: means of residuals over squares of the field; a "
        "pattern would be an error that the calibration left.",
        figures.constellation(recording, body),
    )
    return drawn


def compare_with_truth(recording: Recording, body: str) -> TruthComparison | None:
    """Errors of the valid poses of ``body``, None where the recording has no truth of it."""
    poses = [pose for pose in recording.poses[body] if pose.valid]
    truths = recording.truth_of(poses)
    return compare(poses, truths) if any(truth is not None for truth in truths) else None


def _summary(
    measured: Sequence[CyclePose], cycles: ManyCycles, comparison: TruthComparison | None
) -> list[tuple[str, str]]:
    valid = [pose for pose in measured if pose.valid]
    statuses = Counter(pose.status.name.lower() for pose in measured)
    rows = [
        ("poses", ", ".join(f"{count} {status}" for status, count in statuses.items())),
        ("motion cycles", f"{measured[0].cycle} to {measured[-1].cycle}, {cycles.turns:.3f} revolutions"),
    ]
    if not valid:
        return rows
    used = [pose.particles_used for pose in valid]
    rows.append(("particles used", f"median {np.median(used):.0f}, least {min(used)}, most {max(used)}"))
    xy = np.nanmedian([pose.residual_rms_xy for pose in valid]) * 1e9
    z = np.nanmedian([pose.residual_rms_z for pose in valid]) * 1e9
    rows.append(("residual of the rigid transform, median rms", f"{xy:.2f} nm in x and y, {z:.1f} nm in z"))
    if (steps := cycles.steps) is not None:
        mean, error, spread = (
            1e3 * v for v in (steps.mean, steps.sd / math.sqrt(len(steps.values)), steps.sd)
        )
        rows.append(("rotation per cycle, mean", figures.with_uncertainty(mean, error, "mrad")))
        rows.append(
            (
                "rotation per cycle, spread",
                f"{spread:.4g} mrad, of which measurement {steps.noise * 1e6:.2f} µrad; "
                f"{steps.reversals or 'no'} reversals, {steps.stalls or 'no'} stalls",
            )
        )
    rows += _play(cycles, "play of the centre", cycles.centre, 0)
    rows += _play(cycles, "play of the tilt", cycles.axis, 3)
    absent = {"centre": "play", "spectrum": "spectra by order", "repeatability": "repeatability at equal ψ"}
    rows += [(absent[name], why) for name, why in cycles.missing.items() if name in absent]
    if comparison is not None:
        rows.append(("normalised estimation error squared / 6", f"{comparison.nees_per_dof:.2f} (honest: 1)"))
    return rows


def _play(cycles: ManyCycles, name: str, part: CircularMotion | None, first: int) -> list[tuple[str, str]]:
    """Play and what was told apart from it; nothing below one revolution."""
    if part is None:
        return []
    _, unit, scale = figures.DISPLAY[DEGREES_OF_FREEDOM[first]]
    span, sd = part.play_range * scale, cycles.play_range_sd(part, first) * scale
    ranges = ", ".join(
        f"{axis} {figures.with_uncertainty(value, error, unit)}"
        for axis, value, error in zip("xy", span, sd, strict=True)
    )
    turning = figures.with_uncertainty(part.amplitude * scale, part.sd_turning * scale, unit)
    drift = figures.with_uncertainty(float(np.hypot(*part.drift)) * scale, part.sd_drift * scale, unit)
    rms = ", ".join(
        f"{axis} {value * scale:.3g} {unit}" for axis, value in zip("xy", part.play_rms, strict=True)
    )
    return [
        (f"{name}, range", ranges),
        (f"{name}, rms", rms),
        (f"{name}, told from", f"turning with the body {turning}; drift per cycle {drift}"),
    ]


def _freedoms(cycles: ManyCycles, comparison: TruthComparison | None) -> tuple[list[str], list[list[str]]]:
    """Columns and rows: range of the motion with its uncertainty, repeatability, budget, true precision."""
    columns = ["range of motion", "spread, 1 sd", "repeats to", "noise", "map and field", "claimed, 1 sd"]
    columns += ["rms error", "error / claimed"] if comparison is not None else []
    values, spreads, rows = cycles.displacement, cycles.sd, []
    for i, name in enumerate(DEGREES_OF_FREEDOM if len(values) else ()):
        symbol, unit, scale = figures.DISPLAY[name]
        low, high = int(values[:, i].argmin()), int(values[:, i].argmax())
        span = (values[high, i] - values[low, i]) * scale
        of_span = math.hypot(spreads[high, i], spreads[low, i]) * scale
        row = [symbol, figures.with_uncertainty(span, of_span, unit)]
        row.append(figures.quantity(values[:, i].std(ddof=1), unit) if len(values) > 1 else "")
        if name == "psi":
            row[1:] = [f"{cycles.turns:.4f} revolutions", ""]
        row.append(figures.quantity(cycles.repeatability.rms[i], unit) if cycles.repeatability else "")
        parts = (cycles.budget.noise[i], cycles.budget.common[i]) if cycles.budget else ()
        row += [figures.quantity(part, unit) if math.isfinite(part) else "" for part in parts]
        row.append(figures.quantity(math.sqrt((spreads[:, i] ** 2).mean()), unit))
        if comparison is not None:
            row.append(figures.quantity(comparison.rms[i], unit))
            row.append(f"{comparison.rms[i] / comparison.claimed_rms[i]:.2f}")
        rows.append(row)
    return columns, rows


def _write_tables(
    recording: Recording, analysed: Sequence[ManyCycles], relatives: Sequence[RelativeMotion], out: Path
) -> None:
    provenance = {**recording.provenance, "made_by": "mems6dof report", "bag": recording.name}
    by_stamp: dict[int, list[CyclePose]] = {}
    for poses in recording.poses.values():
        for pose in poses:
            by_stamp.setdefault(pose.stamp_ns, []).append(pose)
    tables: list[tuple[Table, Iterable[Any]]] = [
        (CYCLES, chain.from_iterable(recording.poses.values())),
        (
            LOCALIZATIONS,
            chain.from_iterable(
                sightings(found, by_stamp.get(stamp, [])) for stamp, found in recording.localizations.items()
            ),
        ),
        (MOTION, chain.from_iterable(cycles.quantities() for cycles in analysed)),
        (PLAY, chain.from_iterable(cycles.play_rows() for cycles in analysed)),
        (SPECTRUM, chain.from_iterable(cycles.spectrum_rows() for cycles in analysed)),
        (RELATIVE, chain.from_iterable(motion.rows() for motion in relatives)),
        (CONSTELLATION, chain.from_iterable(map(recording.constellation_rows, recording.poses))),
    ]
    for table, rows in tables:
        with TableWriter(out / f"{table.name}.csv", table, provenance) as writer:
            for row in rows:
                writer.write(row)


def _png(figure: Figure) -> bytes:
    stream = io.BytesIO()
    figure.savefig(stream, format="png", metadata={"Software": f"mems6dof_ros {__version__}"})
    return stream.getvalue()


def _readable(provenance: Mapping[str, str]) -> list[tuple[str, str]]:
    """Provenance by key, JSON unfolded."""
    rows = []
    for key, text in provenance.items():
        try:
            value = json.loads(text)
        except ValueError:
            value = text
        if isinstance(value, dict):
            text = ", ".join(f"{name} {item}" for name, item in value.items())
        rows.append((key.replace("_", " "), text))
    return rows
