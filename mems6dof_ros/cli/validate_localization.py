"""`mems6dof validate localization`: the acceptance figures of detection and fits, as a table."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from mems6dof_ros import __version__


def add_parser(subparsers: argparse._SubParsersAction) -> None:
    parser = subparsers.add_parser(
        "localization",
        help="accuracy of detection and image fits against truth",
        description="Measure detection and image fits against simulated truth and print the figures. "
        "The exit status is 1 when one misses its requirement.",
    )
    parser.add_argument(
        "--particles", type=int, default=10_000, help="matched particles (default: %(default)s)"
    )
    parser.add_argument("--seed", type=int, default=1, help="of all noise (default: %(default)s)")
    parser.add_argument("--json", type=Path, help="also write the figures to this file")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    from mems6dof_ros.cli.progress import Progress
    from mems6dof_ros.errors import InputError
    from mems6dof_ros.localization.validation import figures

    if args.particles < 100:
        raise InputError("--particles", f"{args.particles}", "100 or more")
    with Progress("validate localization") as progress:
        table = figures(args.particles, args.seed, progress)
    width = max(len(row["quantity"]) for row in table)
    for row in table:
        verdict = {True: "pass", False: "FAIL", None: ""}[row["passed"]]
        print(
            f"{row['quantity']:<{width}}  {row['measured']:>10.4g}  {row['required']:<16}  {verdict}".rstrip()
        )
    failed = sum(row["passed"] is False for row in table)
    print(f"{sum(row['passed'] is True for row in table)} passed, {failed} failed")
    if args.json:
        record = {
            "format": "mems6dof validation 1",
            "software_version": __version__,
            "parameters": {"particles": args.particles, "seed": args.seed},
            "figures": table,
        }
        args.json.write_text(json.dumps(record, indent=1) + "\n")
    return 1 if failed else 0
