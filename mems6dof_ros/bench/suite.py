"""The rows of the bench by name, in the order in which they run."""

from __future__ import annotations

import importlib
import os
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

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
) -> Iterator[Row]:
    """Rows ``names`` (empty: all), each when it is measured; what fails becomes a row that says why.

    Raises InputError for a name that does not exist.
    """
    for name in names:
        if name not in ROWS:
            raise InputError("rows", f"'{name}'", f"of {', '.join(ROWS)}")
    return _rows([row for row in ROWS if row in names or not names], material, progress)


def _rows(names: Sequence[str], material: Material, progress: Callable[[str], None]) -> Iterator[Row]:
    for name in names:
        progress(name)
        module, function = ROWS[name].split(":")
        begin, load = time.monotonic(), os.getloadavg()[0]
        try:
            rows = getattr(importlib.import_module(f"mems6dof_ros.bench.{module}"), function)(material)
        except Exception as error:  # the other rows are worth having; the trace tells where
            traceback.print_exc()
            rows = [Row(name, 0.0, "rows", figure=0.0, least=1.0, note=f"not measured: {error!r}")]
        last = {**rows[-1].details, "s for these rows": time.monotonic() - begin, "load before": load}
        yield from (*rows[:-1], replace(rows[-1], details=last))
