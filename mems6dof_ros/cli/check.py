"""`mems6dof check`: is a bag whole, and is every frame accounted for?"""

from __future__ import annotations

import argparse
from pathlib import Path


def add_parser(subparsers: argparse._SubParsersAction) -> None:
    """Options: which bag."""
    parser = subparsers.add_parser(
        "check",
        help="is a bag whole, every frame accounted for?",
        description="Decode every message of a bag and compare what belongs together. The exit status is 1 "
        "when something is missing.",
    )
    parser.add_argument("bag", type=Path, help="bag or .mcap file")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Print the topics and what is wrong."""
    from mems6dof_ros.analysis.check import check_bag

    result = check_bag(args.bag)
    for topic, (kind, count) in sorted(result.topics.items()):
        print(f"{count:8} {topic}  {kind}")
    for problem in result.problems:
        print(f"problem: {problem}")
    print("not whole" if result.problems else "whole")
    return 1 if result.problems else 0
