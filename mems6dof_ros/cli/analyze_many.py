"""`mems6dof analyze-many`: what analyze does, for many recordings on several processes or machines."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path


def add_parser(subparsers: argparse._SubParsersAction) -> None:
    """Options: which recordings, by which calibration, where to write, where to compute."""
    parser = subparsers.add_parser(
        "analyze-many",
        help="measure many recordings, on several processes or machines",
        description="Measure recordings as `mems6dof analyze` does, each into a directory of its name. The"
        " results do not depend on where they are computed. Several processes or machines need Dask:"
        " pip install 'mems6dof_ros[dask]'. The exit status is 1 when a recording could not be measured.",
    )
    parser.add_argument("inputs", nargs="+", type=Path, metavar="INPUT", help="bags, or images with a scale")
    parser.add_argument("--calibration", type=Path, required=True, help="calibration file")
    parser.add_argument("--out", type=Path, required=True, help="directory of the results")
    parser.add_argument("--method", help="method of reading z (default: what the calibration proposes)")
    parser.add_argument("--body", default="load_gear", help="name of the rigid body (default: %(default)s)")
    where = parser.add_mutually_exclusive_group()
    where.add_argument(
        "--processes", type=int, default=1, help="recordings measured at a time here (default: %(default)s)"
    )
    where.add_argument(
        "--scheduler",
        default="",
        metavar="ADDRESS",
        help="Dask scheduler, such as tcp://host:8786, whose workers see the same files",
    )
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Measure; one line for each recording."""
    from mems6dof_ros.analysis.many_recordings import Job, analyze_many, cluster
    from mems6dof_ros.cli.progress import Progress
    from mems6dof_ros.errors import InputError

    if args.processes < 1:
        raise InputError("--processes", f"{args.processes}", "1 or more")
    out, calibration = args.out.resolve(), args.calibration.resolve()
    jobs = [Job(path.resolve(), calibration, out / path.stem, args.body, args.method) for path in args.inputs]
    with cluster(args.scheduler, args.processes) as client, Progress("recordings") as progress:
        outcomes = analyze_many(jobs, client, progress)
    for outcome in outcomes:
        what = outcome.error or f"frames {outcome.frames}, poses {outcome.poses}, valid {outcome.valid}"
        print(f"{outcome.job.input.name}: {what}", file=sys.stderr if outcome.error else sys.stdout)
    print(args.out)
    return 1 if any(outcome.error for outcome in outcomes) else 0
