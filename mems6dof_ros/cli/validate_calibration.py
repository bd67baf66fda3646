"""`mems6dof validate calibration`: the acceptance figures of the calibration, as a table."""

from __future__ import annotations

import argparse
from pathlib import Path

from mems6dof_ros.cli.figures import add_json_option, conclude, print_table


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
    add_json_option(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Measure, print the table; 1 where a figure misses its requirement."""
    from mems6dof_ros.calibration.validation import figures
    from mems6dof_ros.cli.progress import Progress

    with Progress("validate calibration") as progress:
        table = figures(args.seeds, args.real_data, progress)
    print_table(table)
    return conclude(table, {"seeds": args.seeds}, args.json)
