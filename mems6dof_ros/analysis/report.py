"""A recording as a page: figures as PNG, tables of numbers, and one HTML file that needs nothing else."""

from __future__ import annotations

import base64
import io
import json
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jinja2 import Environment, PackageLoader
from matplotlib.figure import Figure

from mems6dof_ros import __version__
from mems6dof_ros.analysis import figures
from mems6dof_ros.analysis.recording import Recording, load_recording
from mems6dof_ros.analysis.truth import TruthComparison, compare
from mems6dof_ros.errors import InputError
from mems6dof_ros.pose.cycle_pose import DEGREES_OF_FREEDOM, CyclePose
from mems6dof_ros.recording.tables import CYCLES, LOCALIZATIONS, TableWriter, sightings


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
    """What the page says of one body. ``summary``: names and values; ``freedoms``: one row each."""

    body: str
    summary: Sequence[tuple[str, str]]
    freedoms: Sequence[Mapping[str, str]]
    pictures: Sequence[Picture]
    with_truth: bool


def write_report(bag: Path, out: Path) -> Path:
    """Write ``report.html``, its figures, ``cycles.csv`` and ``localizations.csv``; returns the page's path.

    Files of an earlier report in ``out`` are replaced. Raises InputError for a bag without poses.
    """
    recording = load_recording(bag)
    if out.exists() and not out.is_dir():
        raise InputError(str(out), "a file", "a directory, which may exist")
    out.mkdir(parents=True, exist_ok=True)
    bodies = [describe(recording, body) for body in recording.poses]
    for body in bodies:
        for picture in body.pictures:
            (out / f"{body.body}_{picture.name}.png").write_bytes(picture.png)
    _write_tables(recording, out)
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


def describe(recording: Recording, body: str) -> BodyReport:
    """Numbers and figures of one body."""
    measured = recording.poses[body]
    poses = recording.in_last_reference(body)
    comparison = compare_with_truth(recording, body)
    drawn: dict[str, tuple[str, Figure | None]] = {}
    with figures.style():
        if any(pose.valid for pose in measured):
            drawn |= _of_motion(recording, body, poses, comparison)
        drawn["particles"] = ("Particles by cycle.", figures.particles(measured))
        drawn["latency"] = ("Latency by stage, host clocks.", figures.latency(measured))
        pictures = [
            Picture(name, caption, _png(figure))
            for name, (caption, figure) in drawn.items()
            if figure is not None
        ]
    return BodyReport(
        body,
        _summary(measured, poses, comparison),
        _freedoms(poses, comparison),
        pictures,
        comparison is not None,
    )


def _of_motion(
    recording: Recording, body: str, poses: Sequence[CyclePose], comparison: TruthComparison | None
) -> dict[str, tuple[str, Figure]]:
    """Caption and figure by name; ``poses`` in one reference."""
    measured = recording.poses[body]
    drawn = {
        "degrees_of_freedom": (
            "Displacement from the reference in six degrees of freedom. Bands: two standard deviations, "
            "often thinner than the line. Cycles before the last reference are expressed in it.",
            figures.degrees_of_freedom(poses, comparison),
        ),
        "paths": ("Paths of the centre and of the tilt, by rotation.", figures.paths(poses)),
        "rotation": ("Rotation per motion cycle and in sum.", figures.rotation(poses)),
        "angles": ("The paper's nutation and precession.", figures.paper_angles(poses)),
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
    poses = recording.poses[body]
    pairs = [
        (p, t) for p, t in zip(poses, recording.truth_of(poses), strict=True) if p.valid and t is not None
    ]
    return compare([pose for pose, _ in pairs], [truth for _, truth in pairs]) if pairs else None


def _summary(
    measured: Sequence[CyclePose], poses: Sequence[CyclePose], comparison: TruthComparison | None
) -> list[tuple[str, str]]:
    valid = [pose for pose in measured if pose.valid]
    statuses = Counter(pose.status.name.lower() for pose in measured)
    rows = [
        ("poses", ", ".join(f"{count} {status}" for status, count in statuses.items())),
        ("motion cycles", f"{measured[0].cycle} to {measured[-1].cycle}"),
    ]
    if not valid:
        return rows
    used = [pose.particles_used for pose in valid]
    rows.append(("particles used", f"median {np.median(used):.0f}, least {min(used)}, most {max(used)}"))
    xy = np.nanmedian([pose.residual_rms_xy for pose in valid]) * 1e9
    z = np.nanmedian([pose.residual_rms_z for pose in valid]) * 1e9
    rows.append(("residual of the rigid transform, median rms", f"{xy:.2f} nm in x and y, {z:.1f} nm in z"))
    _, step, spread = figures.rotation_per_cycle(poses)
    if len(step) > 1:
        mean, error = step.mean() * 1e3, step.std(ddof=1) / math.sqrt(len(step)) * 1e3
        rows.append(("rotation per cycle, mean", f"({mean:.3f} ± {error:.3f}) mrad"))
        rows.append(("rotation per cycle, spread", f"{step.std(ddof=1) * 1e3:.3f} mrad"))
        rows.append(("rotation per cycle, uncertainty of one", f"{np.median(spread) * 1e6:.2f} µrad"))
    if comparison is not None:
        rows.append(("normalised estimation error squared / 6", f"{comparison.nees_per_dof:.2f} (honest: 1)"))
    return rows


def _freedoms(poses: Sequence[CyclePose], comparison: TruthComparison | None) -> list[dict[str, str]]:
    """Per degree of freedom: range of the motion with its uncertainty, and claimed and true precision."""
    valid = [pose for pose in poses if pose.valid]
    if not valid:
        return []
    values = np.array([pose.displacement for pose in valid])
    spreads = np.sqrt([np.diag(pose.displacement_covariance) for pose in valid])
    rows = []
    for i, name in enumerate(DEGREES_OF_FREEDOM):
        symbol, unit, scale = figures.DISPLAY[name]
        fine, fine_scale = ("nm", 1e9) if unit == "nm" else ("µrad", 1e6)
        low, high = int(values[:, i].argmin()), int(values[:, i].argmax())
        span = (values[high, i] - values[low, i]) * scale
        of_span = math.hypot(spreads[high, i], spreads[low, i]) * scale
        row = {
            "name": symbol,
            "range": f"{span:.4g} ± {of_span:.2g} {unit}",
            "sd": f"{values[:, i].std(ddof=1) * scale:.3g} {unit}" if len(values) > 1 else "",
            "claimed": f"{np.sqrt((spreads[:, i] ** 2).mean()) * fine_scale:.3g} {fine}",
        }
        if name == "psi":
            row |= {"range": f"{span / scale / (2 * math.pi):.4f} revolutions", "sd": ""}
        if comparison is not None:
            row["error"] = f"{comparison.rms[i] * fine_scale:.3g} {fine}"
            row["ratio"] = f"{comparison.rms[i] / comparison.claimed_rms[i]:.2f}"
        rows.append(row)
    return rows


def _write_tables(recording: Recording, out: Path) -> None:
    provenance = {**recording.provenance, "made_by": "mems6dof report", "bag": recording.name}
    by_stamp: dict[int, list[CyclePose]] = {}
    with TableWriter(out / "cycles.csv", CYCLES, provenance) as table:
        for poses in recording.poses.values():
            for pose in poses:
                table.write(pose)
                by_stamp.setdefault(pose.stamp_ns, []).append(pose)
    with TableWriter(out / "localizations.csv", LOCALIZATIONS, provenance) as table:
        for stamp, found in recording.localizations.items():
            for sighting in sightings(found, by_stamp.get(stamp, [])):
                table.write(sighting)


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
