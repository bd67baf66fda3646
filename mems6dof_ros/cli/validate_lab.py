"""`mems6dof validate lab`: what the instrument survives in a laboratory, as a table."""

from __future__ import annotations

import argparse
import importlib
import tempfile
from pathlib import Path

from mems6dof_ros.cli.figures import add_json_option, conclude, print_table

#: Part to the module that measures it by ``figures(work: Path, seed: int, tell: Callable[[str], None])``: it
#: works in the directory ``work``, tells what it is doing, and yields rows of quantity, measured, required
#: (text) and passed (None: for information).
PARTS = {
    "messages": "mems6dof_ros.nodes.hostile",
}


def add_parser(subparsers: argparse._SubParsersAction) -> None:
    """Options: which parts, the seed of what is random, where to work."""
    parser = subparsers.add_parser(
        "lab",
        help="what the instrument survives: broken messages, and more",
        description="Do to the nodes what happens in a laboratory and print what became of them. The exit"
        " status is 1 when a figure misses its requirement.",
    )
    parser.add_argument(
        "--only", choices=tuple(PARTS), action="append", help="this part only; may be repeated"
    )
    parser.add_argument("--seed", type=int, default=1, help="of what is random (default: %(default)s)")
    parser.add_argument("--out", type=Path, help="directory to keep (default: a temporary one)")
    add_json_option(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Measure part by part and print each; 1 where a figure misses its requirement."""
    table = []
    with tempfile.TemporaryDirectory(prefix="mems6dof_lab_") as temporary:
        for part in args.only or PARTS:
            work = (args.out or Path(temporary)) / part
            work.mkdir(parents=True, exist_ok=True)
            measure = importlib.import_module(PARTS[part]).figures
            rows = list(measure(work, args.seed, lambda text: print(f"... {text}", flush=True)))
            print_table(rows)
            table += rows
    return conclude(table, {"parts": list(args.only or PARTS), "seed": args.seed}, args.json)
