"""`mems6dof validate pose`: the acceptance figures of the pose, as a table."""

from __future__ import annotations

import argparse

from mems6dof_ros.cli.figures import add_json_option, conclude, print_table


def add_parser(subparsers: argparse._SubParsersAction) -> None:
    """Options: seeds, cycles, whether to render frames."""
    parser = subparsers.add_parser(
        "pose",
        help="accuracy and honesty of the pose against truth",
        description="Measure the pose estimator against simulated truth and print the figures. "
        "The exit status is 1 when one misses its requirement.",
    )
    parser.add_argument(
        "--seeds",
        type=int,
        nargs="+",
        default=[1, 2, 3, 4, 5, 6],
        help="of all but the rendered frames; default: 1 to 6",
    )
    parser.add_argument(
        "--drift-cycles", type=int, default=2000, help="cycles of the test for drift (default: %(default)s)"
    )
    parser.add_argument(
        "--optical-cycles",
        type=int,
        default=720,
        help="cycles from rendered frames, calibration included, through each of the optics;"
        " after the first revolution, 80 cycles, they count; 0: none (default: %(default)s)",
    )
    parser.add_argument(
        "--optics",
        type=int,
        nargs="+",
        default=[13, 14, 15],
        help="seeds of the rendered optics, cameras, gears and noise; default: 13 to 15, never tuned on",
    )
    add_json_option(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Print the table; 1 where a figure misses its requirement."""
    from mems6dof_ros.cli.progress import Progress
    from mems6dof_ros.errors import InputError
    from mems6dof_ros.pose.validation_table import figures

    if args.drift_cycles < 200:
        raise InputError("--drift-cycles", f"{args.drift_cycles}", "200 or more")
    if 0 != args.optical_cycles < 120:
        raise InputError("--optical-cycles", f"{args.optical_cycles}", "0 or 120 or more")
    with Progress("validate pose") as progress:
        table = figures(args.seeds, progress, args.drift_cycles, args.optical_cycles, args.optics)
    parameters = {
        "seeds": args.seeds,
        "drift_cycles": args.drift_cycles,
        "optical_cycles": args.optical_cycles,
        "optics": args.optics,
    }
    print_table(table)
    return conclude(table, parameters, args.json)
