"""`mems6dof scan`: let the running calibrator scan beads through focus and calibrate the optics."""

from __future__ import annotations

import argparse
import os
from pathlib import Path


def add_parser(subparsers: argparse._SubParsersAction) -> None:
    """Options: the scan, what to calibrate with it, where results go."""
    parser = subparsers.add_parser(
        "scan",
        help="scan beads through focus with camera and stage, and calibrate the optics",
        description="Ask the calibrator, a ROS node on this machine, for a scan through focus and a"
        " calibration made of it. Ctrl-C cancels, and nothing is written.",
    )
    parser.add_argument("range", type=float, metavar="RANGE", help="from the centre to either end, m")
    parser.add_argument("step", type=float, metavar="STEP", help="from position to position, m")
    parser.add_argument(
        "--centre", type=float, default=0.0, help="position of the stage about where beads are in focus, m"
    )
    parser.add_argument("--out", type=Path, required=True, help="calibration file to write (YAML)")
    parser.add_argument(
        "--frames", type=int, default=1, help="frames at each position (default: %(default)s)"
    )
    parser.add_argument(
        "--with",
        dest="earlier",
        nargs="+",
        default=[],
        metavar="STACK",
        type=Path,
        help="bags or TIFF stacks of the same optics to calibrate together with this scan",
    )
    parser.add_argument(
        "--rotation",
        type=float,
        nargs="+",
        default=[],
        metavar="RAD",
        help="the substrate's orientation in each of them, and in this scan",
    )
    parser.add_argument("--keep", type=Path, metavar="BAG", help="keep the scan in this new bag")
    parser.add_argument(
        "--axial-range", type=float, default=0.0, help="largest |defocus| to declare valid, m"
    )
    parser.add_argument("--aperture", type=float, default=0.0, help="numerical aperture, to check the step")
    parser.add_argument("--namespace", default="", help="of the calibrator")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Ask, show the progress, say what came of it."""
    from mems6dof_msgs.action import Calibrate
    from mems6dof_ros.cli.progress import Progress
    from mems6dof_ros.nodes import transport
    from mems6dof_ros.nodes.calibration_client import request_calibration

    for name, value in transport.LOCALHOST_ONLY.items():
        os.environ.setdefault(name, value)
    goal = Calibrate.Goal(
        start=args.centre - args.range,
        stop=args.centre + args.range,
        step=args.step,
        frames_per_plane=max(args.frames, 0),
        earlier_stacks=[str(path.resolve()) for path in args.earlier],
        rotations=args.rotation,
        output=str(args.out.resolve()),
        stack_output=str(args.keep.resolve()) if args.keep else "",
        axial_range=args.axial_range,
        numerical_aperture=args.aperture,
    )
    with Progress("plane") as progress:
        result = request_calibration(
            goal, lambda told: progress(told.plane, told.planes, told.phase), args.namespace
        )
    print(f"calibration {result.calibration_id}: {result.beads} beads, method {result.method}")
    if result.beads_rejected:
        print(f"rejected {result.beads_rejected}: see the report")
    for warning in result.warnings:
        print(f"warning: {warning}")
    print(args.out)
    print(result.report)
    return 0
