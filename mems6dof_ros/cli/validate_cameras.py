"""`mems6dof validate cameras`: what the drivers lose, miscount or mis-stamp, as a table."""

from __future__ import annotations

import argparse

from mems6dof_ros.cli.figures import add_json_option, conclude, print_table


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
    add_json_option(parser)
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
    print_table(table)
    return conclude(table, {"seconds": args.seconds, "size": args.size, "rate": args.rate}, args.json)
