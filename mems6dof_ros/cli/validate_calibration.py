"""`mems6dof validate calibration`: the acceptance figures of the calibration, as a table."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from textwrap import shorten

from mems6dof_ros import __version__

_WIDTH = 78


def add_parser(subparsers: argparse._SubParsersAction) -> None:
    """Options: which optics to average over, where real micrographs are."""
    parser = subparsers.add_parser(
        "calibration",
        help="accuracy of calibrated z against truth",
        description="Calibrate simulated optics, measure other particles through them, print the figures. "
        "The exit status is 1 when one misses its requirement.",
    )
    parser.add_argument(
        "--seeds", type=int, nargs="+", default=[1, 2, 3], help="optics to average over (default: 1 2 3)"
    )
    parser.add_argument("--real-data", type=Path, help="folder of the real focus stacks")
    parser.add_argument("--json", type=Path, help="also write the figures to this file")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Measure, print the table; 1 where a figure misses its requirement."""
    from mems6dof_ros.calibration.validation import figures
    from mems6dof_ros.cli.progress import Progress

    with Progress("validate calibration") as progress:
        table = figures(args.seeds, args.real_data, progress)
    for row in table:
        verdict = {True: "pass", False: "FAIL", None: ""}[row["passed"]]
        quantity = shorten(row["quantity"], _WIDTH)
        print(f"{quantity:<{_WIDTH}}  {row['measured']:>8.4g}  {row['required']:<12}  {verdict}".rstrip())
    failed = sum(row["passed"] is False for row in table)
    print(f"{sum(row['passed'] is True for row in table)} passed, {failed} failed")
    if args.json:
        record = {
            "format": "mems6dof validation 1",
            "software_version": __version__,
            "parameters": {"seeds": args.seeds},
            "figures": table,
        }
        args.json.write_text(json.dumps(record, indent=1) + "\n")
    return 1 if failed else 0
