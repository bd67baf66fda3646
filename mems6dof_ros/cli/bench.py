"""`mems6dof bench`: speed, each figure beside its peer or its limit, as a table and as JSON."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from mems6dof_ros import __version__


def add_parser(subparsers: argparse._SubParsersAction) -> None:
    """Options: which rows, how much of each."""
    from mems6dof_ros.bench import suite

    parser = subparsers.add_parser(
        "bench",
        help="speed of the instrument beside its peers and limits",
        description="Measure the speed of every part and of the whole, each beside its peer or its limit in"
        " the same run, on simulated frames of 2048 x 2048 px with 100 particles. The exit status is 1 when a"
        " figure misses its requirement. Ratios hold on a busy machine; rates and latencies need a quiet one."
        f" Rows: {', '.join(suite.ROWS)}.",
    )
    parser.add_argument("rows", nargs="*", metavar="ROW", help="rows to measure (default: all)")
    parser.add_argument(
        "--quick", action="store_true", help="less of everything: five minutes instead of twenty"
    )
    parser.add_argument(
        "--calibration", type=Path, help="calibration of the simulator's default optics (default: made here)"
    )
    parser.add_argument("--json", type=Path, help="also write everything to this file")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Measure and print; 1 where a figure misses its requirement."""
    import tempfile

    from mems6dof_ros.bench import suite, table
    from mems6dof_ros.bench.material import Material

    rows = []
    with tempfile.TemporaryDirectory(prefix="mems6dof_bench_") as directory:
        material = Material(Path(directory), args.quick, args.calibration)
        for row in suite.measure(
            args.rows, material, lambda name: print(f"measuring {name}", file=sys.stderr)
        ):
            rows.append(row)
            record = table.record(rows, {"rows": args.rows, "quick": args.quick}, __version__)
            if args.json:  # what is measured by now, should it be interrupted
                args.json.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    machine = record["machine"]
    print(f"{machine['processor']}, {machine['cores']} cores, load {machine['load_average_1_min']:.1f}")
    print("\n".join(table.lines(rows)))
    failed = sum(row.passed is False for row in rows)
    print(f"{sum(row.passed is True for row in rows)} passed, {failed} failed")
    return 1 if failed else 0
