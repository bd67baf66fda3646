"""`mems6dof calibrate`: focus stacks of beads into the calibration file of the optics."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

from mems6dof_ros.cli.inputs import add_camera_options, add_image_options, camera_of, open_input


def add_parser(subparsers: argparse._SubParsersAction) -> None:
    """Options: what the stacks are, the camera, the fit, the model, where results go."""
    from mems6dof_ros.calibration.focus_stack import DEFAULT_WINDOW_PX
    from mems6dof_ros.localization.fitting import DEFAULT_WEIGHTING

    parser = subparsers.add_parser(
        "calibrate",
        help="calibrate the optics from focus stacks of beads",
        description="Calibrate the optics from bags with stage positions, or from TIFF stacks with a step.",
    )
    parser.add_argument("stacks", nargs="+", metavar="STACK", help="bag, TIFF stack or folder of images")
    parser.add_argument("--out", type=Path, required=True, help="calibration file to write (YAML)")
    parser.add_argument("--report", type=Path, help="HTML report (default: beside the calibration file)")
    parser.add_argument(
        "--rotation", type=float, nargs="+", metavar="RAD", help="the substrate's orientation in each stack"
    )
    add_image_options(parser)
    add_camera_options(parser)
    fit = parser.add_argument_group("fit and model")
    fit.add_argument(
        "--window", type=int, default=DEFAULT_WINDOW_PX, help="side of the window, px (default: %(default)s)"
    )
    fit.add_argument(
        "--weighting", default=DEFAULT_WEIGHTING, help="weighting of the fit (default: %(default)s)"
    )
    fit.add_argument("--axial-range", type=float, help="largest |defocus| to declare valid, m")
    fit.add_argument("--aperture", type=float, help="numerical aperture, to check the stage's step")
    fit.add_argument(
        "--wavelength", type=float, help="of the emission, m: with aperture and diameter, calibrates psf"
    )
    fit.add_argument("--diameter", type=float, help="of the beads, m")
    fit.add_argument("--reference", help="earlier calibration of these optics, to check step and direction")
    fit.add_argument(
        "--method",
        help="method that the file proposes: joint (default: fast enough to be live), psf (the most precise,"
        " some 40 times slower) or rho_amp (the paper's)",
    )
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Calibrate, write the file and its report; nothing is written when interrupted."""
    from mems6dof_ros.calibration.calibrate import CalibrationSettings, calibrate
    from mems6dof_ros.calibration.file import load_calibration, save_calibration
    from mems6dof_ros.calibration.focus_stack import measure_stack
    from mems6dof_ros.calibration.report import write_report
    from mems6dof_ros.cli.progress import Progress
    from mems6dof_ros.sources.source import frames

    stacks = []
    for number, path in enumerate(args.stacks):
        source = open_input(Path(path), args)
        camera = camera_of(args, source.info, None)
        with Progress(f"stack {number + 1} of {len(args.stacks)}, plane") as progress:
            stacks.append(
                measure_stack(frames(source), camera, args.weighting, args.window, Path(path).name, progress)
            )
    rotations = None if args.rotation is None else tuple(args.rotation)
    settings = CalibrationSettings(
        axial_range=args.axial_range,
        numerical_aperture=args.aperture,
        wavelength=args.wavelength,
        bead_diameter=args.diameter,
        reference=load_calibration(args.reference) if args.reference else None,
        rotations=rotations,
    )
    result = calibrate(stacks, settings)
    calibration = result.calibration
    if args.method:
        calibration = calibration.with_method(args.method)
    save_calibration(calibration, args.out)
    report = args.report or args.out.with_suffix(".html")
    write_report(result, report)
    print(f"calibration {calibration.calibration_id}: {len(result.beads)} beads, method {calibration.method}")
    low, high = calibration.valid.z
    print(f"valid from {low * 1e6:.2f} to {high * 1e6:.2f} um about focus")
    for reason, count in sorted(_counts(r.reason.split(":")[0] for r in result.rejected).items()):
        print(f"rejected {count}: {reason}")
    for warning in result.warnings:
        print(f"warning: {warning}")
    print(args.out)
    print(report)
    return 0


def _counts(reasons: Iterator[str]) -> dict[str, int]:
    counts: dict[str, int] = {}
    for reason in reasons:
        counts[reason] = counts.get(reason, 0) + 1
    return counts
