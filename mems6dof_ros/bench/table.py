"""One row per figure: what was measured, against what, and whether that is enough."""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Row:
    """``measured`` and ``reference`` in ``unit``; ``reference`` None: there is none, or it is not installed.

    ``figure``: what is required, usually their ratio, with the limits ``least`` and ``most``; None: for
    information. ``details``: everything else worth keeping; the command prints ``note`` and ``details``.
    """

    name: str
    measured: float
    unit: str
    against: str = ""
    reference: float | None = None
    figure: float | None = None
    least: float | None = None
    most: float | None = None
    note: str = ""
    details: Mapping[str, Any] = field(default_factory=dict)

    @property
    def passed(self) -> bool | None:
        """Whether the figure is within its limits; None where there are none, or no figure."""
        if self.figure is None or (self.least is None and self.most is None):
            return None
        high_enough = self.least is None or self.figure >= self.least
        return bool(high_enough and (self.most is None or self.figure <= self.most))

    @property
    def required(self) -> str:
        """The limits in words."""
        if self.least is not None:
            return f"at least {self.least:g}"
        return f"at most {self.most:g}" if self.most is not None else ""


def lines(rows: Iterable[Row]) -> list[str]:
    """The rows as an aligned table, their details below each."""
    titles = ("what", "measured", "against", "reference", "figure", "required", "")
    table = [titles, *map(_cells, rows)]
    widths = [max(len(line[k]) for line in table) for k in range(len(titles))]
    out = []
    for line, row in zip(table, (None, *rows), strict=True):
        out.append("  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip())
        if row is None:
            continue
        if row.note:
            out.append(f"    {row.note}")
        if row.details:
            out.append("    " + ", ".join(f"{name} {_value(value)}" for name, value in row.details.items()))
    return out


def _cells(row: Row) -> tuple[str, ...]:
    verdict = {True: "pass", False: "FAIL", None: ""}[row.passed]
    reference = "" if row.reference is None else f"{_value(row.reference)} {row.unit}"
    figure = "" if row.figure is None else _value(row.figure)
    return (
        row.name,
        f"{_value(row.measured)} {row.unit}",
        row.against,
        reference,
        figure,
        row.required,
        verdict,
    )


def _value(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def record(rows: Sequence[Row], parameters: Mapping[str, Any], version: str) -> dict[str, Any]:
    """What the JSON file holds."""
    return {
        "format": "mems6dof bench 1",
        "software_version": version,
        "parameters": dict(parameters),
        "machine": machine(),
        "rows": [{**asdict(row), "required": row.required, "passed": row.passed} for row in rows],
    }


def machine() -> dict[str, Any]:
    """What the figures were measured on, and how busy it was."""
    model = next(
        (line.partition(":")[2].strip() for line in _read("/proc/cpuinfo") if line.startswith("model name")),
        platform.processor(),
    )
    return {
        "processor": model,
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "load_average_1_min": os.getloadavg()[0],
    }


def _read(path: str) -> list[str]:
    try:
        with open(path, encoding="utf-8") as stream:
            return stream.read().splitlines()
    except OSError:
        return []


def processor_seconds(*works: Callable[[], object], repeats: int = 5) -> list[float]:
    """Least processor time of this thread for each of ``works``, after a first run that may compile.

    They take turns, so that a busy machine slows all alike.
    """
    times = np.full((repeats, len(works)), np.inf)
    for work in works:
        work()
    for repeat in range(repeats):
        for k, work in enumerate(works):
            start = time.thread_time()
            work()
            times[repeat, k] = time.thread_time() - start
    return [float(best) for best in times.min(axis=0)]
