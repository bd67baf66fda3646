"""`mems6dof validate monitor`: the acceptance figures of seeing and steering, as one table."""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

from mems6dof_ros.cli.figures import add_json_option, conclude, print_table

#: In the order of the table; all but the last are parts of monitor.validation.
PARTS = ("page", "beside", "endurance", "foxglove", "attacks", "control")


def add_parser(subparsers: argparse._SubParsersAction) -> None:
    """Options: which parts, how long."""
    parser = subparsers.add_parser(
        "monitor",
        help="the live page in a browser, beside a measurement, for ten minutes, attacked; the closed loop",
        description="Load the live page in headless Chromium, press its buttons, open it beside a running"
        " measurement, leave it open, attack it; read the Foxglove bridge by an independent client; and close"
        " the loop as `validate control` does. The exit status is 1 when a figure misses its requirement."
        " Rates and latencies need a machine that does nothing else.",
    )
    parser.add_argument("--only", choices=PARTS, action="append", help="this part only; may be repeated")
    parser.add_argument(
        "--seconds", type=float, default=600.0, help="that the page stays open (default: %(default)g)"
    )
    parser.add_argument("--quick", action="store_true", help="less of everything")
    add_json_option(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Measure part by part and print each; 1 where a figure misses its requirement."""
    from mems6dof_ros.errors import InputError

    if not 10 <= args.seconds <= 86_400:
        raise InputError("--seconds", f"{args.seconds:g}", "10 to 86400")
    table = []
    for part in args.only or PARTS:
        print(f"\n{part}", flush=True)
        if part == "control":
            from mems6dof_ros.cli.validate_control import measure

            rows = measure(drives=2 if args.quick else 20, targets=3 if args.quick else 20)
        else:
            from mems6dof_ros.monitor.validation import PARTS as measured

            with tempfile.TemporaryDirectory(prefix="mems6dof_monitor_") as work:
                rows = [*measured[part](Path(work), _tell, quick=args.quick, seconds=args.seconds)]
        print_table(rows)
        table += rows
    print()
    parameters = {"parts": list(args.only or PARTS), "seconds": args.seconds, "quick": args.quick}
    return conclude(table, parameters, args.json)


def _tell(text: str) -> None:
    import sys

    print(f"... {text}", file=sys.stderr, flush=True)
