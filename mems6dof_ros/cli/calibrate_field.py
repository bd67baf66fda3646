"""`mems6dof calibrate-field`: recordings of a turning gear into the second layer of a calibration."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from mems6dof_ros.cli.inputs import add_camera_options, add_image_options, camera_of, open_input

if TYPE_CHECKING:
    from mems6dof_ros.calibration.file import Calibration
    from mems6dof_ros.cli.progress import Progress
    from mems6dof_ros.localization.localizations import Localizations


def add_parser(subparsers: argparse._SubParsersAction) -> None:
    """Options: the recordings, the calibration they are measured by, what turns in them."""
    parser = subparsers.add_parser(
        "calibrate-field",
        help="correct a calibration by what a turning gear shows of the field",
        description="Measure the smooth errors of x, y and z over the field that no bead array shows, from "
        "recordings of a turning rigid body, and write them as a second layer into the calibration. "
        "Localizations by that calibration are used where a bag has them, else its images.",
    )
    parser.add_argument("recordings", nargs="+", type=Path, metavar="RECORDING", help="bag, stack or folder")
    parser.add_argument("--calibration", required=True, help="calibration file, corrected before or not")
    parser.add_argument("--out", type=Path, required=True, help="calibration file to write (YAML)")
    which = parser.add_mutually_exclusive_group()
    which.add_argument("--body", default="load_gear", help="name of the rigid body (default: %(default)s)")
    which.add_argument("--bodies", type=Path, metavar="FILE", help="YAML file of several bodies")
    add_image_options(parser)
    add_camera_options(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Calibrate by one recording after another; nothing is written when interrupted."""
    from mems6dof_ros.analysis.analyze import sha256_of
    from mems6dof_ros.analysis.field_calibration import calibrate_field
    from mems6dof_ros.calibration.file import load_calibration, save_calibration
    from mems6dof_ros.cli.progress import Progress
    from mems6dof_ros.pose.bodies import Bodies
    from mems6dof_ros.pose.bodies_file import load_bodies
    from mems6dof_ros.pose.estimator import PoseEstimator
    from mems6dof_ros.pose.field import FieldError
    from mems6dof_ros.pose.settings import PoseSettings

    def bodies(settings: PoseSettings, field: FieldError) -> Bodies:
        if args.bodies:
            return load_bodies(args.bodies, settings, field)
        return Bodies([PoseEstimator(settings, args.body, field=field)])

    calibration = load_calibration(args.calibration)
    for path in args.recordings:
        with Progress(f"{path.name}, frames") as progress:
            result = calibrate_field(
                calibration,
                _counted(_cycles(path, calibration, args), progress),
                bodies,
                path.name,
                sha256_of(path),
            )
        calibration = result.calibration
        for body, valid in result.poses.items():
            print(f"{path.name}: {body}, {valid} valid poses in {result.cycles} cycles")
        print(f"{'rms over the field, nm':26}{'x':>8}{'y':>8}{'z':>8}")
        rows = {"error measured": result.measured, "sd before": result.before, "sd after": result.after}
        for name, values in rows.items():
            print(f"{name:26}" + "".join(f"{value * 1e9:8.2f}" for value in values))
    save_calibration(calibration, args.out)
    print(f"calibration {calibration.calibration_id}: {args.out}")
    return 0


def _cycles(path: Path, calibration: Calibration, args: argparse.Namespace) -> Iterator[Localizations]:
    """What ``path`` holds of localizations by ``calibration``, else its images localized by it."""
    from mems6dof_ros.analysis.field_calibration import localizations_of
    from mems6dof_ros.localization.localizer import Localizer
    from mems6dof_ros.sources.source import frames, is_bag

    if is_bag(path) and (known := localizations_of(path, calibration)) is not None:
        yield from known
        return
    source = open_input(path, args)
    localizer = Localizer(camera_of(args, source.info, calibration.camera), calibration)
    yield from map(localizer.localize, frames(source))


def _counted(cycles: Iterator[Localizations], progress: Progress) -> Iterator[Localizations]:
    for done, found in enumerate(cycles, 1):
        yield found
        progress(done)
