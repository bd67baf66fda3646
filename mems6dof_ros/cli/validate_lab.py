"""`mems6dof validate lab`: what the instrument survives in a laboratory, as a table."""

from __future__ import annotations

import argparse
import importlib
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import cast

from mems6dof_ros.cli.figures import add_json_option, conclude, print_table
from mems6dof_ros.errors import Mems6dofError
from mems6dof_ros.figures import Figure, exactly

#: Part to the module that measures it by ``figures(work: Path, seed: int, tell: Callable[[str], None])``: it
#: works in the directory ``work``, tells what it is doing, and yields rows of the table.
PARTS = {
    "messages": "mems6dof_ros.nodes.validation.hostile",
    "outages": "mems6dof_ros.nodes.validation.outages",
    "network": "mems6dof_ros.nodes.validation.networks",
    "bags": "mems6dof_ros.recording.validation.bags",
    "crash": "mems6dof_ros.recording.validation.crash",
    "disk": "mems6dof_ros.recording.validation.disk",
    "files": "mems6dof_ros.recording.validation.fuzzing",
}


def add_parser(subparsers: argparse._SubParsersAction) -> None:
    """Options: which parts, the seed of what is random, where to work."""
    parser = subparsers.add_parser(
        "lab",
        help="what the instrument survives: broken messages and files, crashes, full disks",
        description="Do to the nodes what happens in a laboratory and print what became of them. The exit"
        " status is 1 when a figure misses its requirement.",
    )
    parser.add_argument(
        "--only", choices=tuple(PARTS), action="append", help="this part only; may be repeated"
    )
    parser.add_argument(
        "--soak",
        type=float,
        metavar="MINUTES",
        help="instead, leave every node running at the highest rate that they sustain",
    )
    parser.add_argument("--seed", type=int, default=1, help="of what is random (default: %(default)s)")
    parser.add_argument("--out", type=Path, help="directory to keep (default: a temporary one)")
    add_json_option(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Measure part by part and print each; 1 where a figure misses its requirement."""
    table = []
    parts = ["soak"] if args.soak else args.only or list(PARTS)
    with tempfile.TemporaryDirectory(prefix="mems6dof_lab_") as temporary:
        for part in parts:
            work = (args.out or Path(temporary)) / part
            work.mkdir(parents=True, exist_ok=True)
            rows = []
            try:
                for row in _figures(part, work, args):
                    rows.append(row)
            except Mems6dofError as error:  # the other parts are measured all the same
                rows.append(exactly(f"{part}: broken off: {error}", 1, 0))
            print_table(rows)
            table += rows
    return conclude(table, {"parts": parts, "seed": args.seed}, args.json)


def _figures(part: str, work: Path, args: argparse.Namespace) -> Iterable[Figure]:
    def tell(text: str) -> None:
        print(f"... {text}", flush=True)

    if part == "soak":
        from mems6dof_ros.bench.soak import soak

        return soak(args.soak, work, tell)
    figures = importlib.import_module(PARTS[part]).figures
    return cast("Iterable[Figure]", figures(work, args.seed, tell))
