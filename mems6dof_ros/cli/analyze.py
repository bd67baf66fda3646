"""`mems6dof analyze`: a recording to localizations and poses, by the same core as the live nodes."""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from mems6dof_ros.cli.inputs import add_camera_options, add_image_options, camera_of, open_input
from mems6dof_ros.errors import InputError

if TYPE_CHECKING:
    from mems6dof_ros.analysis.analyze import Summary


def add_parser(subparsers: argparse._SubParsersAction) -> None:
    """Options: what to read, by which calibration, where to write."""
    parser = subparsers.add_parser(
        "analyze",
        help="measure a recording: localizations and poses",
        description="Measure a bag, a TIFF stack, a folder of images or a video, and write a bag, cycles.csv "
        "and localizations.csv. The same input gives the same results, digit for digit.",
    )
    parser.add_argument("input", type=Path, help="bag, .mcap file, TIFF stack, folder of images or video")
    parser.add_argument(
        "--calibration", required=True, help="calibration file, or 'none': x and y only, and no pose"
    )
    parser.add_argument("--out", type=Path, required=True, help="directory to create")
    parser.add_argument("--method", help="method of reading z (default: what the calibration proposes)")
    which = parser.add_mutually_exclusive_group()
    which.add_argument("--body", default="load_gear", help="name of the rigid body (default: %(default)s)")
    which.add_argument(
        "--bodies",
        type=Path,
        metavar="FILE",
        help="YAML file of several bodies: of each the region or constellation (docs/files.md)",
    )
    parser.add_argument(
        "--reference",
        choices=("map", "previous"),
        default="map",
        help="register to the constellation map (default) or to the previous micrograph",
    )
    parser.add_argument(
        "--beyond-calibration",
        action="store_true",
        help="use particles outside the calibration's ranges of z, field and brightness, too",
    )
    parser.add_argument("--keep-images", action="store_true", help="write the images into the new bag too")
    parser.add_argument(
        "--workers", type=int, default=1, help="frames localized at a time (default: %(default)s)"
    )
    add_image_options(parser)
    add_camera_options(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Analyze; an interruption leaves the frames measured so far, completely."""
    from mems6dof_ros.analysis.analyze import analyze, sha256_of
    from mems6dof_ros.calibration.file import load_calibration
    from mems6dof_ros.cli.interrupt import stop_on_signal
    from mems6dof_ros.cli.progress import Progress
    from mems6dof_ros.localization.localizer import Localizer
    from mems6dof_ros.pose.bodies_file import load_bodies
    from mems6dof_ros.pose.estimator import PoseEstimator, PoseSettings
    from mems6dof_ros.pose.field import FieldError

    calibration, attachments = None, {}
    if args.calibration != "none":
        calibration = load_calibration(args.calibration, args.method)
        attachments["calibration.yaml"] = Path(args.calibration).read_bytes()
    source = open_input(args.input, args)
    camera = camera_of(args, source.info, calibration.camera if calibration else None)
    localizer = Localizer(camera, calibration)
    settings = PoseSettings(reference=args.reference, beyond_calibration=args.beyond_calibration)
    field = FieldError.remaining(calibration.correction, settings) if calibration else None
    estimators: Sequence[PoseEstimator] = []
    if calibration:
        estimators = [PoseEstimator(settings, args.body, field=field)]
    if args.bodies:
        if not calibration:
            raise InputError("--bodies", "no calibration", "a calibration: without one there are no poses")
        estimators = load_bodies(args.bodies, settings, field).estimators
    provenance = {"input": args.input.name, "input_sha256": sha256_of(args.input)}
    with Progress("frames") as progress, stop_on_signal() as stopped:
        summary = analyze(
            source,
            localizer,
            estimators,
            args.out,
            provenance=provenance,
            attachments=attachments,
            keep_images=args.keep_images,
            workers=args.workers,
            progress=progress,
            stopped=stopped,
        )
    print("\n".join(_lines(summary)))
    print(args.out)
    return 130 if summary.interrupted else 0


def _lines(summary: Summary) -> list[str]:
    lines = [f"frames {summary.frames}, localizations {summary.localizations}"]
    lines += [f"refused {reason}" for reason in summary.refused]
    if summary.interrupted:
        lines.append("interrupted: the frames so far are complete")
    for body in dict.fromkeys(pose.body for pose in summary.poses):
        lines += _lines_of_body(summary, body)
    return lines


def _lines_of_body(summary: Summary, body: str) -> list[str]:
    from mems6dof_ros.analysis.truth import compare

    pairs = [pair for pair in zip(summary.poses, summary.truths, strict=True) if pair[0].body == body]
    counts = Counter(pose.status.name.lower() for pose, _ in pairs)
    lines = [f"{body} poses: " + ", ".join(f"{status} {count}" for status, count in sorted(counts.items()))]
    if any(pose.valid and truth is not None for pose, truth in pairs):
        comparison = compare([pose for pose, _ in pairs], [truth for _, truth in pairs])
        lines.append(f"{'against truth':14}{'rms error':>12}{'claimed':>12}")
        for name, error, claimed in comparison.table():
            unit, scale = ("nm", 1e9) if name in ("dx", "dy", "dz") else ("urad", 1e6)
            lines.append(f"{name:14}{error * scale:12.3f}{claimed * scale:12.3f} {unit}")
        lines.append(f"normalised estimation error squared / 6: {comparison.nees_per_dof:.2f}")
    return lines
