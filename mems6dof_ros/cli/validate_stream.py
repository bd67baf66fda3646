"""`mems6dof validate stream`: the acceptance figures of the whole stream, from frames to a replayed bag."""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

from mems6dof_ros.cli.figures import add_json_option, conclude, print_table


def add_parser(subparsers: argparse._SubParsersAction) -> None:
    """Options: how many cycles, seeds, where to work."""
    parser = subparsers.add_parser(
        "stream",
        help="the demonstration, its record and its replay, as figures",
        description="Run the demonstration; read its bag with other people's readers; replay it through two"
        " instruments in two namespaces at once and hold their poses against the offline analysis; fit"
        " matched Gaussians. The exit status is 1 when a figure misses its requirement.",
    )
    parser.add_argument("--cycles", type=int, default=90, help="motion cycles (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=1, help="of gear and optics (default: %(default)s)")
    parser.add_argument("--out", type=Path, help="directory to keep (default: a temporary one)")
    add_json_option(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Measure, print the table; 1 where a figure misses its requirement."""
    from mems6dof_ros.nodes.validation.stream import figures
    from mems6dof_ros.simulation.settings import SimulationSettings

    settings = SimulationSettings(seed=args.seed, optics_seed=args.seed)
    with tempfile.TemporaryDirectory(prefix="mems6dof_stream_") as folder:
        table = figures(settings, args.cycles, args.out or Path(folder) / "demo")
    print_table(table)
    return conclude(table, {"cycles": args.cycles, "seed": args.seed}, args.json)
