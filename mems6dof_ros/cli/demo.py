"""`mems6dof demo`: the main job, from focus stacks to six degrees of freedom beside their truth.

Simulates and calibrates in this process, measures in four others that talk ROS 2, then reads back
what was recorded. Nothing passes from the first to the second but the calibration file.
"""

from __future__ import annotations

import argparse
import shutil
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from mems6dof_ros.errors import InputError, Mems6dofError

if TYPE_CHECKING:
    from mems6dof_ros.analysis.truth import TruthComparison
    from mems6dof_ros.pose.cycle_pose import CyclePose
    from mems6dof_ros.simulation.settings import SimulationSettings

#: Marks a directory that a demonstration has made, and that the next one may replace.
MARKER = "made_by_mems6dof_demo"

BODY = "load_gear"
#: What the nodes say, beside the bag.
LOG = "nodes.log"


@dataclass(frozen=True)
class Requirement:
    """The rms error of one degree of freedom that the demonstration must not exceed, and how to print it."""

    limit: float
    scale: float
    unit: str


#: At 6e4 electrons and about 80 visible particles.
REQUIREMENTS = {
    "dx": Requirement(1e-9, 1e9, "nm"),
    "dy": Requirement(1e-9, 1e9, "nm"),
    "dz": Requirement(20e-9, 1e9, "nm"),
    "tilt_x": Requirement(200e-6, 1e6, "urad"),
    "tilt_y": Requirement(200e-6, 1e6, "urad"),
    "psi": Requirement(5e-6, 1e6, "urad"),
}


def add_parser(subparsers: argparse._SubParsersAction) -> None:
    """Options: how much to simulate, where to write."""
    parser = subparsers.add_parser(
        "demo",
        help="simulate, calibrate, measure through ROS 2, compare with truth",
        description="Calibrate simulated optics from focus stacks, measure a turning gear through the four"
        " nodes as processes of their own, record, and compare every degree of freedom with truth.",
    )
    parser.add_argument(
        "--out", type=Path, default=Path("demo_output"), help="directory (default: %(default)s)"
    )
    parser.add_argument("--cycles", type=int, default=90, help="motion cycles; 80 are a revolution")
    parser.add_argument("--size", type=int, default=2048, help="width and height of the frames, px")
    parser.add_argument("--seed", type=int, default=1, help="particles, motion and noise")
    parser.add_argument("--optics-seed", type=int, default=1, help="aberrations of the objective")
    parser.add_argument(
        "--closed-loop",
        action="store_true",
        help="instead of letting the gear turn, bring it to random angles by the controller",
    )
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Run the demonstration; 1 where a cycle was lost, an error exceeds its requirement, or a target was
    missed."""
    from mems6dof_ros.cli.closed_loop import run_closed_loop
    from mems6dof_ros.simulation.settings import SimulationSettings

    settings = SimulationSettings(
        width_px=args.size, height_px=args.size, seed=args.seed, optics_seed=args.optics_seed
    )
    if args.cycles < 2:
        raise InputError("--cycles", f"{args.cycles}", "2 or more, 80 for a revolution")
    started = time.monotonic()
    calibration = prepare(settings, args.out)
    if args.closed_loop:
        _say("2/3  close the loop: the four nodes and a controller as five processes")
        passed = run_closed_loop(args.out, calibration=calibration, settings=settings) == 0
    else:
        passed = _turn(settings, args.cycles, calibration, args.out)
    print(f"calibration  {calibration}\ndone in {time.monotonic() - started:.0f} s")
    return 0 if passed else 1


def _turn(settings: SimulationSettings, cycles: int, calibration: Path, out: Path) -> bool:
    from mems6dof_ros.analysis.report import write_report

    bag = measure(settings, cycles, calibration, out)
    _say("3/3  report")
    page = write_report(bag, out / "report")
    passed = _print_result(bag, cycles)
    print(f"\nbag          {bag}\nreport       {page}")
    return passed


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def prepare(settings: SimulationSettings, out: Path) -> Path:
    """Make ``out``, in place of an earlier demonstration but of nothing else, and calibrate the optics of
    ``settings``; returns the calibration file. Raises InputError where ``out`` holds something else."""
    if out.exists() and not (out / MARKER).exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(str(out), "something else than an earlier demonstration", "a new directory: --out")
    if (out / MARKER).exists():
        shutil.rmtree(out)
    out.mkdir(parents=True, exist_ok=True)
    (out / MARKER).touch()
    _say("1/3  calibrate: bead substrate through focus, in two orientations")
    path = out / "optics.yaml"
    _calibrate(settings, path)
    return path


def _calibrate(settings: SimulationSettings, path: Path) -> None:
    from mems6dof_ros.analysis.simulated import calibrate_simulated
    from mems6dof_ros.calibration.file import save_calibration
    from mems6dof_ros.cli.progress import Progress

    with Progress("     planes") as progress:
        result = calibrate_simulated(settings, progress)
    save_calibration(result.calibration, path)
    _say(
        f"     {len(result.beads)} beads, {len(result.rejected)} rejected, method {result.calibration.method}"
    )


def measure(settings: SimulationSettings, cycles: int, calibration: Path, out: Path) -> Path:
    """Run the nodes until every frame has become a pose; returns the bag. Raises Mems6dofError where a node
    fails."""
    from mems6dof_ros.cli.progress import Progress
    from mems6dof_ros.nodes.recorder import DEFAULT_TOPICS
    from mems6dof_ros.nodes.runner import run_system
    from mems6dof_ros.nodes.system import NodeSpec, chain, simulated
    from mems6dof_ros.nodes.watch import watch_poses
    from mems6dof_ros.recording import topics

    _say("2/3  measure: frame_source, localizer, pose_estimator and recorder as four processes")
    bag, log = out / "bag", out / LOG
    source = simulated(cycles, **settings.to_dict())
    nodes = chain(
        source,
        calibration=str(calibration),
        output=str(bag),
        recorded=[*DEFAULT_TOPICS, topics.IMAGE],
        # All frames may wait for a disk that is busy, with a fresh installation for instance.
        recording={"compression": "zstd", "queue_mebibytes": 2048},
        watched={topics.POSE_6DOF: "watch"},
        monitor=NodeSpec("monitor", {"port": 0}),
    )
    with log.open("w", encoding="utf-8") as lines, Progress("     cycles") as progress:

        def on_pose(pose: CyclePose) -> None:
            progress(pose.cycle, cycles, describe(pose))

        def on_line(line: str) -> None:
            print(line, file=lines, flush=True)
            if line.startswith("[monitor] live page:"):
                _say(f"     watch it in a browser: {line.rsplit(' ', 1)[-1]}")

        with watch_poses(on_pose) as spin, run_system(nodes, on_line=on_line) as running:
            while "frame_source" not in (ended := running.poll()) and not any(ended.values()):
                spin(0.1)
            codes = running.stop()
    if failed := {name: code for name, code in codes.items() if code}:
        tail = "\n".join(log.read_text(encoding="utf-8").splitlines()[-5:])
        raise Mems6dofError(f"nodes failed: {failed}; see {log}, which ends:\n{tail}")
    return bag


def describe(pose: CyclePose) -> str:
    """Six numbers on one line."""
    if not pose.valid:
        return f"{pose.status.name.lower()}: {pose.reason}"
    dx, dy, dz = pose.displacement[:3] * 1e9
    tilt_x, tilt_y = pose.displacement[3:5] * 1e3
    return (
        f"dx {dx:+6.1f}  dy {dy:+6.1f}  dz {dz:+6.1f} nm  tilt {tilt_x:+5.2f} {tilt_y:+5.2f} mrad"
        f"  psi {pose.displacement[5]:7.4f} rad"
    )


def _print_result(bag: Path, cycles: int) -> bool:
    from mems6dof_ros.analysis.recording import load_recording
    from mems6dof_ros.analysis.truth import compare

    recording = load_recording(bag)
    poses = recording.poses[BODY]
    valid = [pose for pose in poses if pose.valid]
    comparison = compare(valid, recording.truth_of(valid))
    seen = [pose.particles_seen for pose in valid]
    used = [pose.particles_used for pose in valid]
    lost = cycles - len(poses)
    print()
    print(f"{'cycles in':28}{recording.frames:8d}")
    print(f"{'cycles out, valid poses':28}{len(valid):8d}")
    print(f"{'frames lost':28}{lost:8d}")
    if unknown := len(valid) - len(comparison.cycle):
        print(f"{'poses without their truth':28}{unknown:8d}  lost by the recorder: see {bag.parent / LOG}")
    print(f"{'particles seen / used':28}{sum(seen) / len(seen):8.1f} /{sum(used) / len(used):5.1f}")
    print(f"{'median latency, frame to pose':28}{_median_latency_ms(valid):8.1f} ms\n")
    passed = len(comparison.cycle) == len(valid) == recording.frames == cycles
    print(f"{'against truth':16}{'rms error':>12}{'claimed':>12}{'required':>12}")
    for row in _rows(comparison):
        print(row)
    for name, error, _ in comparison.table():
        passed &= error <= REQUIREMENTS[name].limit
    print(f"{'error^2 / claimed^2, mean over six degrees of freedom':52}{comparison.nees_per_dof:6.2f}")
    if not passed:
        print("NOT as required: see the table")
    return passed


def _rows(comparison: TruthComparison) -> Sequence[str]:
    rows = []
    for name, error, claimed in comparison.table():
        limit, scale, unit = REQUIREMENTS[name].limit, REQUIREMENTS[name].scale, REQUIREMENTS[name].unit
        rows.append(f"{name:16}{error * scale:12.2f}{claimed * scale:12.2f}{limit * scale:12.0f} {unit}")
    return rows


def _median_latency_ms(poses: Sequence[CyclePose]) -> float:
    latencies = sorted(pose.latency.total for pose in poses)
    return latencies[len(latencies) // 2] * 1e3
