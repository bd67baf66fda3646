"""`mems6dof calibrate`: focus stacks of beads into the calibration file of the optics."""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from mems6dof_ros.errors import InputError
from mems6dof_ros.frame import Frame
from mems6dof_ros.localization.camera import CameraNoise

WINDOW_PX = 41
WEIGHTING = "relative_light_weighting"


def add_parser(subparsers: argparse._SubParsersAction) -> None:
    """Options: what the stacks are, the camera, the fit, the model, where results go."""
    parser = subparsers.add_parser(
        "calibrate",
        help="calibrate the optics from focus stacks of beads",
        description="Calibrate the optics from bags with stage positions, or from TIFF stacks with a step.",
    )
    parser.add_argument("stacks", nargs="+", metavar="STACK", help="bag, TIFF stack or folder of images")
    parser.add_argument("--out", type=Path, required=True, help="calibration file to write (YAML)")
    parser.add_argument("--report", type=Path, help="HTML report (default: beside the calibration file)")
    stack = parser.add_argument_group("stacks of images")
    stack.add_argument("--step", type=float, default=math.nan, help="stage step between images, m")
    stack.add_argument("--pixel-size", type=float, default=math.nan, help="pixel size in object space, m")
    stack.add_argument(
        "--rotation", type=float, nargs="+", metavar="RAD", help="the substrate's orientation in each stack"
    )
    camera = parser.add_argument_group("camera, where the input does not know it")
    camera.add_argument("--offset", type=float, help="pixel value without light, ADU")
    camera.add_argument("--gain", type=float, help="ADU per electron")
    camera.add_argument("--read-noise", type=float, help="electrons rms")
    camera.add_argument("--saturation", type=float, help="ADU (default: the largest pixel value)")
    fit = parser.add_argument_group("fit and model")
    fit.add_argument(
        "--window", type=int, default=WINDOW_PX, help="side of the window, px (default: %(default)s)"
    )
    fit.add_argument("--weighting", default=WEIGHTING, help="weighting of the fit (default: %(default)s)")
    fit.add_argument("--axial-range", type=float, help="largest |defocus| to declare valid, m")
    fit.add_argument("--aperture", type=float, help="numerical aperture, to check the stage's step")
    fit.add_argument("--reference", help="earlier calibration of these optics, to check step and direction")
    fit.add_argument("--method", help="method that the file proposes (default: the best by measurement)")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Calibrate, write the file and its report; nothing is written when interrupted."""
    from mems6dof_ros.calibration.calibrate import CalibrationSettings, calibrate
    from mems6dof_ros.calibration.file import load_calibration, save_calibration
    from mems6dof_ros.calibration.focus_stack import measure_stack
    from mems6dof_ros.calibration.report import write_report
    from mems6dof_ros.cli.progress import Progress

    stacks = []
    for number, path in enumerate(args.stacks):
        frames, camera = open_stack(path, args)
        with Progress(f"stack {number + 1} of {len(args.stacks)}, plane") as progress:
            stacks.append(
                measure_stack(frames, camera, args.weighting, args.window, Path(path).name, progress)
            )
    rotations = None if args.rotation is None else tuple(args.rotation)
    settings = CalibrationSettings(
        axial_range=args.axial_range,
        numerical_aperture=args.aperture,
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


def open_stack(path: str, args: argparse.Namespace) -> tuple[Iterator[Frame], CameraNoise]:
    """Frames of the stack at ``path`` and the noise of their camera, from the input or the options."""
    from mems6dof_ros.sources.source import frames, open_source

    options: dict[str, Any] = {"path": path}
    kind = "bag" if Path(path).suffix == ".mcap" or (Path(path) / "metadata.yaml").exists() else "images"
    if kind == "images":
        options |= {"step": args.step, "pixel_size": args.pixel_size}
    source = open_source(kind, **options)
    camera = source.info.camera
    given = {
        "offset_adu": args.offset,
        "gain_adu_per_electron": args.gain,
        "read_noise_electrons": args.read_noise,
        "saturation_adu": args.saturation,
    }
    stated = {name: value for name, value in given.items() if value is not None}
    if camera is not None:
        return frames(source), replace(camera, **stated)
    stated.setdefault("saturation_adu", 255 if source.info.encoding == "mono8" else 65535)
    missing = [name for name in given if name not in stated]
    if missing:
        raise InputError(
            path, f"no camera numbers ({', '.join(missing)})", "--offset, --gain and --read-noise"
        )
    return frames(source), CameraNoise(**stated)


def _counts(reasons: Iterator[str]) -> dict[str, int]:
    counts: dict[str, int] = {}
    for reason in reasons:
        counts[reason] = counts.get(reason, 0) + 1
    return counts
