"""The rows of the bench by name, in the order in which they run."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence

from mems6dof_ros.bench.material import Material
from mems6dof_ros.bench.table import Row
from mems6dof_ros.errors import InputError

#: Name on the command line to the function that measures it.
ROWS = {
    "fits": "kernels:fits",
    "detection": "kernels:detection",
    "memory": "chain:in_memory",
    "file": "chain:from_file",
    "tracking": "chain:tracking",
    "scaling": "chain:scaling",
    "start": "starting:second_start",
    "analyze": "offline:workers",
    "nodes": "nodes:four_processes",
    "pipeline": "nodes:one_process",
    "recorder": "nodes:recorder",
    "endurance": "nodes:endurance",
}


def measure(
    names: Sequence[str], material: Material, progress: Callable[[str], None] = lambda name: None
) -> list[Row]:
    """Rows ``names`` (empty: all). Raises InputError for a name that does not exist."""
    for name in names:
        if name not in ROWS:
            raise InputError("rows", f"'{name}'", f"of {', '.join(ROWS)}")
    rows = []
    for name in [row for row in ROWS if row in names or not names]:
        progress(name)
        module, function = ROWS[name].split(":")
        rows += getattr(importlib.import_module(f"mems6dof_ros.bench.{module}"), function)(material)
    return rows
