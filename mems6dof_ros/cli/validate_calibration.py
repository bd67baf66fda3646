"""`mems6dof validate calibration`: the acceptance figures of the calibration, as a table."""

from __future__ import annotations

import argparse
import time
from pathlib import Path

from mems6dof_ros.cli.figures import add_json_option, conclude, print_table

#: In the order of the table. ``real`` wants ``--real-data``.
PARTS = ("accuracy", "bound", "brightness", "sign_change", "range", "bad_stacks", "field", "real")


def add_parser(subparsers: argparse._SubParsersAction) -> None:
    """Options: which parts, which optics, where real micrographs are."""
    parser = subparsers.add_parser(
        "calibration",
        help="accuracy of calibrated z against truth",
        description="Calibrate simulated optics, measure other particles through them, print the figures part"
        " by part. The exit status is 1 when one misses its requirement.",
    )
    parser.add_argument(
        "--only", choices=PARTS, action="append", help="this part only; may be repeated (default: all)"
    )
    parser.add_argument(
        "--seeds", type=int, nargs="+", default=[10, 11, 12], help="optics to measure (default: 10 11 12)"
    )
    parser.add_argument("--real-data", type=Path, help="folder of the real focus stacks")
    add_json_option(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Measure part by part and print each; 1 where a figure misses its requirement."""
    from mems6dof_ros.calibration import validation
    from mems6dof_ros.errors import InputError

    parts = args.only or [part for part in PARTS if part != "real" or args.real_data]
    if "real" in parts and not args.real_data:
        raise InputError("--real-data", "nothing", "the folder of the real focus stacks")
    table = []
    start = time.monotonic()
    for part in parts:

        def tell(text: str, part: str = part) -> None:
            print(f"... {time.monotonic() - start:.0f} s: {part}, {text}", flush=True)

        if part == "real":
            rows = validation.real_figures(args.real_data, tell)
        else:
            rows = validation.PARTS[part](args.seeds, tell)
        print_table(rows)
        table += rows
    return conclude(table, {"seeds": args.seeds, "parts": parts}, args.json)
