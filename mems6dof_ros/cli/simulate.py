"""`mems6dof simulate`: frames of the simulated microscope, with their truth, into a bag or a TIFF stack."""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import json
import math
from collections.abc import Iterator
from pathlib import Path

from mems6dof_ros.errors import InputError
from mems6dof_ros.frame import Frame

_STACK_OPTIONS = {
    "beads": (int, 200, "beads on the substrate"),
    "frames_per_plane": (int, 1, "frames at each position"),
    "tilt": (float, 0.5e-3, "tilt of the substrate, rad"),
    "substrate_rotation": (float, 0.0, "rotation of the substrate about the optical axis, rad"),
    "stage_noise": (float, 0.0, "error of every stage position, m rms"),
}


def add_parser(subparsers: argparse._SubParsersAction) -> None:
    """Options: what to simulate, and every field of SimulationSettings."""
    from mems6dof_ros.simulation.settings import SimulationSettings

    parser = subparsers.add_parser(
        "simulate",
        help="write simulated frames and their truth",
        description="Simulate the turning gear, or a focus stack for calibration; write frames with truth.",
    )
    parser.add_argument("--out", type=Path, required=True, help="directory to create")
    parser.add_argument(
        "--format", choices=("bag", "tiff"), default="bag", help="default: bag; tiff: with CSV"
    )
    parser.add_argument("--cycles", type=int, default=80, help="motion cycles (default: %(default)s)")
    stack = parser.add_argument_group("focus stack")
    stack.add_argument(
        "--focus-stack",
        nargs=2,
        type=float,
        metavar=("RANGE", "STEP"),
        help="beads through focus instead of a turning gear: stage from -RANGE to RANGE in steps of STEP, m",
    )
    for name, (kind, value, text) in _STACK_OPTIONS.items():
        stack.add_argument(_flag(name), type=kind, default=value, help=f"{text} (default: %(default)g)")
    group = parser.add_argument_group("simulated experiment")
    for spec in dataclasses.fields(SimulationSettings):
        meta, default = spec.metadata, spec.default
        if "choices" in meta:
            group.add_argument(_flag(spec.name), choices=meta["choices"], default=default, help=meta["doc"])
        else:
            text = f"{meta['doc']} (default: %(default)g)"
            unit = meta["unit"]
            group.add_argument(_flag(spec.name), type=type(default), default=default, metavar=unit, help=text)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Simulate and write; what was written before an interruption is valid."""
    from mems6dof_ros.cli.interrupt import stop_on_signal
    from mems6dof_ros.cli.progress import Progress
    from mems6dof_ros.recording.frames import write_bag, write_tiff
    from mems6dof_ros.simulation.experiment import focus_stack, motion_frames
    from mems6dof_ros.simulation.settings import SimulationSettings
    from mems6dof_ros.sources.simulator import camera_noise

    names = [spec.name for spec in dataclasses.fields(SimulationSettings)]
    settings = SimulationSettings(**{name: getattr(args, name) for name in names})
    if args.focus_stack:
        span, step = args.focus_stack
        if not (span > 0 and step > 0):
            raise InputError("--focus-stack", f"{span} {step}", "a positive range and step, m")
        options = {name: getattr(args, name) for name in _STACK_OPTIONS}
        frames: Iterator[Frame] = focus_stack(settings, -span, span, step, seed=args.seed, **options)
        total = (math.floor(2 * span / step + 1e-6) + 1) * args.frames_per_plane
    else:
        if args.cycles < 1:
            raise InputError("--cycles", str(args.cycles), "1 or more")
        frames, total = motion_frames(settings, args.cycles), args.cycles
    write = write_bag if args.format == "bag" else write_tiff
    provenance = {"made_by": "mems6dof simulate", "simulation": json.dumps(settings.to_dict())}
    first = next(frames)  # settings that cannot be simulated show here, before anything is created
    with Progress("frames") as progress, stop_on_signal() as stopped:
        until_stopped = itertools.takewhile(lambda _: not stopped(), itertools.chain([first], frames))
        write(args.out, until_stopped, camera_noise(settings), provenance, lambda done: progress(done, total))
        interrupted = stopped()
    print(args.out)
    return 130 if interrupted else 0


def _flag(name: str) -> str:
    return "--" + name.replace("_", "-")
