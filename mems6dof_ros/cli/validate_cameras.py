"""`mems6dof validate cameras`: what the drivers lose, miscount or mis-stamp, as a table."""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path

from mems6dof_ros import __version__


def add_parser(subparsers: argparse._SubParsersAction) -> None:
    parser = subparsers.add_parser(
        "cameras",
        help="camera drivers against emulated cameras",
        description="Run the real drivers against emulated cameras (those that are installed) and print the "
        "figures. The exit status is 1 when one misses its requirement or none could be measured.",
    )
    parser.add_argument("--seconds", type=float, default=30.0, help="of stream (default: %(default)s)")
    parser.add_argument("--size", type=int, default=2048, help="px, width and height (default: %(default)s)")
    parser.add_argument("--rate", type=float, default=90.0, help="Hz to ask for (default: %(default)s)")
    parser.add_argument("--json", type=Path, help="also write the figures to this file")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    from mems6dof_ros.cli.progress import Progress
    from mems6dof_ros.errors import InputError
    from mems6dof_ros.sources.cameras.validation import figures

    for name, value, most in (
        ("seconds", args.seconds, 600),
        ("size", args.size, 2048),
        ("rate", args.rate, 1e3),
    ):
        if not 1 <= value <= most:
            raise InputError(f"--{name}", f"{value}", f"1 to {most:g}")
    with Progress("validate cameras") as progress:
        table = figures(args.seconds, args.size, args.rate, progress)
    width = max((len(row["quantity"]) for row in table if not math.isnan(row["measured"])), default=0)
    for row in table:
        verdict = {True: "pass", False: "FAIL", None: ""}[row["passed"]]
        measured = "" if math.isnan(row["measured"]) else f"{row['measured']:.5g}"
        print(f"{row['quantity']:<{width}}  {measured:>10}  {row['required']:<8}  {verdict}".rstrip())
    passed, failed = (sum(row["passed"] is verdict for row in table) for verdict in (True, False))
    print(f"{passed} passed, {failed} failed")
    if args.json:
        record = {
            "format": "mems6dof validation 1",
            "software_version": __version__,
            "parameters": {"seconds": args.seconds, "size": args.size, "rate": args.rate},
            "figures": table,
        }
        args.json.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    return 1 if failed or not passed else 0
