"""Tables as CSV, for people and other programs: units in the column names, provenance on top.

A file begins with lines ``# key: value`` (``table``, ``format``, ``mems6dof_ros`` and what the writer knows);
then come a line with the names of the columns and one line per row. Floating-point numbers are
written with the digits that bring back the same number; unknown is ``nan``.
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mems6dof_ros import __version__
from mems6dof_ros.errors import InputError
from mems6dof_ros.frame import Frame, GroundTruth
from mems6dof_ros.localization.localizations import Localizations
from mems6dof_ros.pose.cycle_pose import DEGREES_OF_FREEDOM, CyclePose

FORMAT = 1  # of all tables: counts changes to the meaning or the names of columns

_UNITS = ("m", "m", "m", "rad", "rad", "rad")  # of DEGREES_OF_FREEDOM
_TRIANGLE = np.triu_indices(6)
_ROTATION = " ".join(f"r{row}{column}" for row in "123" for column in "123")


@dataclass(frozen=True)
class Table:
    """One kind of table: its columns, name to int, float or str, and the row of one object."""

    name: str
    columns: Mapping[str, type]
    row: Callable[[Any], Sequence[Any]]


def sightings(found: Localizations, poses: Sequence[CyclePose]) -> list[list[Any]]:
    """Rows of LOCALIZATIONS for all of a frame, with their part in the pose of whichever body used them."""
    count, fits = len(found), found.fits
    body, particle_id, residual = [""] * count, np.full(count, -1), np.full((count, 3), np.nan)
    for pose in poses:
        used = np.flatnonzero(pose.particle_id >= 0)
        particle_id[used], residual[used] = pose.particle_id[used], pose.residual[used]
        for i in used:
            body[i] = pose.body
    upper = found.covariance.reshape(count, 9)[:, [0, 1, 2, 4, 5, 8]]
    quality = np.stack([fits.flux, fits.chi_square, found.z_gap], axis=1)
    # Lists of Python's own numbers: a hundred rows in a motion cycle are to be written.
    measured = np.concatenate([found.position, upper, fits.parameters, quality], axis=1).tolist()
    first = [found.cycle, found.frame_counter, found.stamp_ns]
    judged = zip(found.flags.tolist(), body, particle_id.tolist(), residual.tolist(), strict=True)
    return [
        [*first, i, *numbers, flags, name, identity, *left]
        for i, (numbers, (flags, name, identity, left)) in enumerate(zip(measured, judged, strict=True))
    ]


def _columns(*groups: tuple[type, str]) -> dict[str, type]:
    return {name: kind for kind, names in groups for name in names.split()}


def _freedoms(prefix: str) -> str:
    return " ".join(f"{prefix}{name}_{unit}" for name, unit in zip(DEGREES_OF_FREEDOM, _UNITS, strict=True))


def _covariances(prefix: str) -> str:
    """Names of the upper triangle of a 6 x 6 covariance."""
    names = []
    for i, j in zip(*_TRIANGLE, strict=True):
        unit = f"{_UNITS[i]}2" if _UNITS[i] == _UNITS[j] else "m_rad"
        names.append(f"{prefix}{DEGREES_OF_FREEDOM[i]}_{DEGREES_OF_FREEDOM[j]}_{unit}")
    return " ".join(names)


def _cycle_row(pose: CyclePose) -> list[Any]:
    angles, latency = pose.angles, pose.latency
    return [
        *(pose.cycle, pose.frame_counter, pose.stamp_ns),
        *(pose.body, pose.status.name.lower(), pose.reason),
        pose.reference_version,
        *pose.displacement,
        *np.sqrt(np.diag(pose.displacement_covariance)),
        *(angles.alpha, angles.beta, angles.gamma, angles.sd_alpha, angles.sd_beta, angles.sd_gamma),
        *(angles.alpha_valid, angles.beta_valid, pose.increment_cycles),
        *pose.increment,
        *(pose.residual_rms_xy, pose.residual_rms_z, pose.chi_square),
        *(pose.particles_used, pose.particles_seen, pose.particles_expected),
        *pose.translation,
        *pose.rotation.ravel(),
        *pose.displacement_covariance[_TRIANGLE],
        *pose.increment_covariance[_TRIANGLE],
        *(latency.localization, latency.pose, latency.total),
    ]


#: One row per motion cycle and body: what Pose6DOF says, the rotation as a matrix r11 ... r33.
CYCLES = Table(
    "cycles",
    _columns(
        (int, "cycle frame_counter stamp_ns"),
        (str, "body status reason"),
        (int, "reference_version"),
        (float, f"{_freedoms('')} {_freedoms('sd_')}"),
        (float, "alpha_rad beta_rad gamma_rad sd_alpha_rad sd_beta_rad sd_gamma_rad"),
        (int, "alpha_valid beta_valid increment_cycles"),
        (float, f"{_freedoms('increment_')} residual_rms_xy_m residual_rms_z_m chi_square"),
        (int, "particles_used particles_seen particles_expected"),
        (float, f"x_m y_m z_m {_ROTATION} {_covariances('cov_')} {_covariances('cov_increment_')}"),
        (float, "latency_localization_s latency_pose_s latency_total_s"),
    ),
    _cycle_row,
)


#: One row per localization: what Localizations says, and the body and particle it was taken for.
LOCALIZATIONS = Table(
    "localizations",
    _columns(
        (int, "cycle frame_counter stamp_ns index"),
        (float, "x_m y_m z_m cov_xx_m2 cov_xy_m2 cov_xz_m2 cov_yy_m2 cov_yz_m2 cov_zz_m2"),
        (float, "x_px y_px amplitude_electrons_per_px sigma_x_px sigma_y_px rho background_electrons_per_px"),
        (float, "flux_electrons chi_square z_gap"),
        (int, "flags"),
        (str, "body"),
        (int, "particle_id"),
        (float, "residual_x_m residual_y_m residual_z_m"),
    ),
    list,
)


def _frame_row(frame: Frame) -> list[Any]:
    return [
        *(frame.frame_counter, frame.cycle, frame.stamp_ns, frame.frames_dropped, frame.device_time_ns),
        *(frame.exposure_s, frame.stage_z, frame.pixel_size),
        *(frame.saturation_adu, frame.source),
    ]


#: One row per frame: what FrameInfo says.
FRAMES = Table(
    "frames",
    _columns(
        (int, "frame_counter cycle stamp_ns frames_dropped device_time_ns"),
        (float, "exposure_s stage_z_m pixel_size_m"),
        (int, "saturation_adu"),
        (str, "source"),
    ),
    _frame_row,
)


def _truth_row(pair: tuple[Frame, GroundTruth]) -> list[Any]:
    frame, truth = pair
    return [
        *(frame.frame_counter, frame.cycle, frame.stamp_ns, truth.body),
        *truth.translation,
        *truth.rotation.ravel(),
        *(truth.psi, len(truth.particle_id)),
    ]


#: One row per frame and simulated body: its true pose.
TRUTH = Table(
    "truth",
    _columns(
        (int, "frame_counter cycle stamp_ns"),
        (str, "body"),
        (float, f"x_m y_m z_m {_ROTATION} psi_rad"),
        (int, "particles"),
    ),
    _truth_row,
)


class TableWriter:
    """Writes a table row by row; a context manager. After ``flush`` the file is complete so far."""

    def __init__(self, path: Path, table: Table, provenance: Mapping[str, str] | None = None) -> None:
        self._table = table
        self._stream = path.open("w", newline="", encoding="utf-8")
        header = {"table": table.name, "format": FORMAT, "mems6dof_ros": __version__, **(provenance or {})}
        for key, value in header.items():
            self._stream.write(f"# {key}: {value}\n")
        self._writer = csv.writer(self._stream, lineterminator="\n")
        self._writer.writerow(table.columns)

    def __enter__(self) -> TableWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stream.close()

    def write(self, row: Any) -> None:
        """Append the row of one object of the table's kind."""
        kinds = self._table.columns.values()
        values = self._table.row(row)
        self._writer.writerow(
            [
                repr(value) if type(value) is float else _text(kind, value)
                for kind, value in zip(kinds, values, strict=True)
            ]
        )

    def write_rows(self, rows: Sequence[Sequence[Any]]) -> None:
        """Append rows whose values are of the columns' own types, which takes half the time."""
        self._writer.writerows(rows)  # writes the digits of repr

    def flush(self) -> None:
        """Hand everything to the operating system."""
        self._stream.flush()


def read_table(path: Path, table: Table) -> tuple[dict[str, str], dict[str, NDArray[Any]]]:
    """Provenance and columns of a file; InputError where it is not such a table of a known format."""
    provenance: dict[str, str] = {}
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(str(path), str(error), f"a table of {table.name}") from None
    while lines and lines[0].startswith("# "):
        key, _, value = lines.pop(0)[2:].partition(": ")
        provenance[key] = value
    if (provenance.get("table"), provenance.get("format")) != (table.name, str(FORMAT)):
        found = f"table '{provenance.get('table')}' of format {provenance.get('format')}"
        raise InputError(str(path), found, f"table '{table.name}' of format {FORMAT}")
    rows = list(csv.reader(lines))
    names = list(table.columns)
    if not rows or rows[0] != names:
        raise InputError(str(path), "other columns", ", ".join(names[:3]) + ", ...")
    columns: dict[str, NDArray[Any]] = {}
    for i, (name, kind) in enumerate(table.columns.items()):
        try:
            columns[name] = np.array([kind(row[i]) for row in rows[1:]], dtype=kind)
        except (ValueError, IndexError) as error:
            raise InputError(f"{path}, column {name}", str(error), kind.__name__) from None
    return provenance, columns


def _text(kind: type, value: Any) -> str:
    return repr(float(value)) if kind is float else str(int(value)) if kind is int else str(value)
