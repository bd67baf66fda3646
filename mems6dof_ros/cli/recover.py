"""`mems6dof recover`: complete bags that a crash, a kill or a full disk left without their end."""

from __future__ import annotations

import argparse
from pathlib import Path


def add_parser(subparsers: argparse._SubParsersAction) -> None:
    """Options: what to recover."""
    parser = subparsers.add_parser(
        "recover",
        help="complete a bag that was cut off",
        description="Complete an .mcap file, or all those of a bag, in place: it is cut behind its last "
        "whole chunk and gets the index that it lacks; damaged chunks before that are set aside. The "
        "bag's metadata.yaml is then written anew. A complete file is left as it is.",
    )
    parser.add_argument("path", type=Path, help="bag or .mcap file; it is changed")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Recover and say what became of each file."""
    from mems6dof_ros.recording.recover import recover

    for result in recover(args.path):
        state = "was complete" if result.complete else f"completed, {result.lost} bytes could not be read"
        print(f"{result.path}: {result.messages} messages, {state}")
    return 0
