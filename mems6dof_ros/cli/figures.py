"""What every `mems6dof validate` ends with: a table of figures, a file of them, an exit status."""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from mems6dof_ros import __version__
from mems6dof_ros.figures import Figure


def add_json_option(parser: argparse.ArgumentParser) -> None:
    """``--json FILE``, for ``conclude``."""
    parser.add_argument("--json", type=Path, help="also write the figures to this file")


def print_table(figures: Sequence[Figure]) -> None:
    """One line a figure."""
    measurements = [row for row in figures if not math.isnan(row["measured"])]
    width = max((len(row["quantity"]) for row in measurements), default=0)
    wanted = max((len(row["required"]) for row in figures), default=0)
    for row in figures:
        verdict = {True: "pass", False: "FAIL", None: ""}[row["passed"]]
        measured = "" if math.isnan(row["measured"]) else f"{row['measured']:.4g}"
        print(f"{row['quantity']:<{width}}  {measured:>10}  {row['required']:<{wanted}}  {verdict}".rstrip())


def conclude(figures: Sequence[Figure], parameters: Mapping[str, Any], path: Path | None) -> int:
    """Count the verdicts, and the remarks, lest they be taken for passed; write the figures to ``path``, if
    any; returns the exit status: 1 where a figure missed its requirement, or nothing was measured."""
    passed, failed = (sum(row["passed"] is verdict for row in figures) for verdict in (True, False))
    remarks = sum(row["passed"] is None and math.isnan(row["measured"]) for row in figures)
    print(f"{passed} passed, {failed} failed" + (f", {remarks} not measured here" if remarks else ""))
    if path:
        record = {
            "format": "mems6dof validation 1",
            "software_version": __version__,
            "parameters": dict(parameters),
            "figures": list(figures),
        }
        path.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    return 1 if failed or not passed else 0
