"""`mems6dof validate control`: the acceptance figures of the closed loop, as tables."""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mems6dof_ros.cli.figures import add_json_option, conclude
from mems6dof_ros.figures import Figure, at_most, information

if TYPE_CHECKING:
    from mems6dof_ros.simulation.settings import SimulationSettings


def add_parser(subparsers: argparse._SubParsersAction) -> None:
    """Options: how many drives and targets, the size of the frames."""
    parser = subparsers.add_parser(
        "control",
        help="angle errors, reaction and safe stops of the closed loop",
        description="Bring simulated gears to random angles, first on synthetic poses with drives of many"
        " kinds, then through ROS 2 from rendered frames; interrupt them; print the figures. The exit status"
        " is 1 when one misses its requirement.",
    )
    parser.add_argument(
        "--drives", type=int, default=20, help="simulated drives of each kind (default: %(default)s)"
    )
    parser.add_argument("--targets", type=int, default=20, help="random targets (default: %(default)s)")
    parser.add_argument("--size", type=int, default=1024, help="width and height of the frames, px")
    parser.add_argument("--seed", type=int, default=1, help="particles, motion, noise, targets")
    parser.add_argument("--calibration", type=Path, help="of the simulated optics (default: made here)")
    parser.add_argument("--no-ros", action="store_true", help="only what needs neither frames nor ROS 2")
    add_json_option(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Print the tables; 1 where a figure misses its requirement."""
    from mems6dof_ros.errors import InputError

    for name in ("drives", "targets"):
        if getattr(args, name) < 1:
            raise InputError(f"--{name}", str(getattr(args, name)), "1 or more")
    rows = measure(args.drives, args.targets, args.size, args.seed, args.calibration, ros=not args.no_ros)
    print()
    parameters = {
        "drives": args.drives,
        "targets": args.targets,
        "size": args.size,
        "seed": args.seed,
        "no_ros": args.no_ros,
    }
    return conclude(rows, parameters, args.json)


def measure(
    drives: int,
    targets: int,
    size: int = 1024,
    seed: int = 1,
    calibration: Path | None = None,
    ros: bool = True,
) -> list[Figure]:
    """Print the tables and return the rows that have a requirement, and those of the reaction."""
    from mems6dof_ros.simulation.settings import SimulationSettings

    rows = [*_synthetic(drives, targets), *_faults()]
    if ros:
        settings = SimulationSettings(width_px=size, height_px=size, seed=seed)
        with tempfile.TemporaryDirectory() as folder:
            rows += _real(settings, targets, calibration, Path(folder))
    return rows


def _verdict(row: Figure) -> str:
    return "pass" if row["passed"] else "FAIL"


def _synthetic(drives: int, targets: int) -> list[Figure]:
    """Angle errors of many drives, closed and open loop."""
    import numpy as np

    from mems6dof_ros.cli.progress import Progress
    from mems6dof_ros.control.controller import State
    from mems6dof_ros.control.validation import figures

    rows, lines = [], []
    with Progress("validate control: kinds of drives") as progress:
        for drive, closed, opened in figures(drives, targets, progress):
            error, blind = (1e3 * np.array([move.error for move in moves]) for moves in (closed, opened))
            arrived = all(move.state is State.ARRIVED for move in closed)
            largest = float(abs(error).max()) if arrived else np.inf
            row = at_most(f"largest error, mrad: {drive.name}", largest, drive.tolerance * 1e3)
            cycles, fewest = (np.mean([getattr(m, name) for m in closed]) for name in ("cycles", "fewest"))
            lines.append(
                f"{drive.name:32}{largest:9.2f}{drive.tolerance * 1e3:9.2f}  {_verdict(row)}"
                f"{_rms(error):9.2f}{_rms(blind):9.1f}{abs(blind).max():9.1f}{cycles:9.1f}{fewest:8.1f}"
            )
            rows.append(row)
    print(
        f"angle error at the end of {drives * targets} motions of each kind of drive, mrad; synthetic poses"
    )
    heads = ("largest", "limit", "", "rms", "open rms", "largest", "cycles", "fewest")
    print(f"{'':32}" + "".join(f"{head:>{6 if not head else 9}}" for head in heads[:-1]) + f"{heads[-1]:>8}")
    print("\n".join(lines))
    return rows


def _faults() -> list[Figure]:
    """Cycles made after each fault."""
    from mems6dof_ros.control.validation import FAULTS, cycles_after

    rows = []
    print("\nmotion cycles made after a fault began; synthetic poses")
    for name, fault in FAULTS.items():
        cycles, reason = cycles_after(fault)
        rows.append(at_most(f"cycles after: {name}", cycles, 1))
        print(f"{name:34}{cycles:3d}  {_verdict(rows[-1])}  {reason}")
    return rows


def _real(settings: SimulationSettings, targets: int, calibration: Path | None, folder: Path) -> list[Figure]:
    """The same through ROS 2, from rendered frames."""
    import numpy as np

    from mems6dof_ros.analysis.simulated import calibrate_simulated
    from mems6dof_ros.calibration.file import save_calibration
    from mems6dof_ros.cli.closed_loop import stage_table, summary
    from mems6dof_ros.cli.progress import Progress
    from mems6dof_ros.control.validation import open_loop, random_targets
    from mems6dof_ros.nodes.closed_loop import approach, closed_loop, data_sheet, safe_stops
    from mems6dof_ros.nodes.loop_client import stages

    if calibration is None:
        calibration = folder / "optics.yaml"
        with Progress("validate control: planes of the focus stacks") as progress:
            save_calibration(calibrate_simulated(settings, progress).calibration, calibration)
    drive, angles = data_sheet(settings), random_targets(targets, settings.seed)
    with (
        closed_loop(settings, calibration, folder / "nodes.log") as (client, _),
        Progress("validate control: targets") as progress,
    ):
        closed = approach(client, settings, angles, progress)
        table, times = stage_table(client), stages(client)
    size = f"{settings.width_px} x {settings.height_px} px"
    print(f"\nangle error, mrad; {targets} random targets through ROS 2, frames of {size}")
    print(f"{'':34}{'rms':>10}{'largest':>10}{'cycles':>10}")
    print(summary("closed loop", closed))
    print(summary("open loop, same drive", open_loop(settings, drive, angles)))
    for move in closed:
        if move.reason:
            print(f"NOT reached: {move.target:.4f} rad, {move.reason}")
    largest = np.inf if any(move.reason for move in closed) else max(abs(move.error) for move in closed) * 1e3
    rows = [at_most("largest error, mrad: ROS 2", float(largest), max(drive.resolution, 1e-3) * 1e3)]
    print(f"\n{table}")
    for name, what in (("reaction", "frame to next command"), ("bare transport", "its bare transport")):
        for label, percent in (("median", 50), ("99 %", 99)):
            measured = float(np.percentile(times[name], percent)) * 1e3
            rows.append(information(f"{what}, ms, {label}", measured))
    print("\nmotion cycles exposed after a loss; ROS 2")
    for name, cycles, reason in safe_stops(settings, calibration, folder / "nodes.log"):
        rows.append(at_most(f"cycles after: {name}", cycles, 1))
        print(f"{name:34}{cycles:3d}  {_verdict(rows[-1])}  {reason}")
    return rows


def _rms(values: Any) -> float:
    return float((values**2).mean() ** 0.5)
