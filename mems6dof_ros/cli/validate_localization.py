"""`mems6dof validate localization`: the acceptance figures of detection and fits, as a table."""

from __future__ import annotations

import argparse

from mems6dof_ros.cli.figures import add_json_option, conclude, print_table


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
    add_json_option(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    from mems6dof_ros.cli.progress import Progress
    from mems6dof_ros.errors import InputError
    from mems6dof_ros.localization.validation import figures

    if args.particles < 100:
        raise InputError("--particles", f"{args.particles}", "100 or more")
    with Progress("validate localization") as progress:
        table = figures(args.particles, args.seed, progress)
    print_table(table)
    return conclude(table, {"particles": args.particles, "seed": args.seed}, args.json)
