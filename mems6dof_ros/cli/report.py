"""`mems6dof report`: figures and numbers of a recording, as PNG, CSV and one HTML page."""

from __future__ import annotations

import argparse
from pathlib import Path


def add_parser(subparsers: argparse._SubParsersAction) -> None:
    """Options: which bag, where to write."""
    parser = subparsers.add_parser(
        "report",
        help="figures and numbers of a recorded bag",
        description="Draw what a bag of poses holds, with uncertainties, and with errors where it has truth.",
    )
    parser.add_argument("bag", type=Path, help="bag with poses, recorded live or by 'mems6dof analyze'")
    parser.add_argument("--out", type=Path, help="directory to write (default: beside the bag, NAME_report)")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Write the report and print where its page is."""
    from mems6dof_ros.analysis.report import write_report

    bag = args.bag.resolve()
    print(write_report(bag, args.out or bag.with_name(f"{bag.stem}_report")))
    return 0
