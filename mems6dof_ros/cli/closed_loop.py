"""The demonstration of the closed loop: targets reached by a drive that errs, beside an open-loop run."""

from __future__ import annotations

import csv
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from mems6dof_ros.control.validation import Move
    from mems6dof_ros.nodes.loop_client import LoopClient
    from mems6dof_ros.simulation.settings import SimulationSettings


def run_closed_loop(
    out: Path, *, calibration: Path, settings: SimulationSettings, targets: int = 20, record: bool = True
) -> int:
    """Bring the simulated gear to random angles, and print and plot how it went.

    ``calibration``: file of the simulated optics; ``settings``: microsystem and camera. Writes into the
    directory ``out``: moves.csv, closed_loop.png, nodes.log and, with ``record``, bag. Returns 0 when every
    target was reached within its tolerance, otherwise 1.
    """
    from mems6dof_ros.cli.progress import Progress
    from mems6dof_ros.control.validation import open_loop, random_targets
    from mems6dof_ros.nodes.closed_loop import approach, closed_loop, data_sheet

    angles = random_targets(targets, settings.seed)
    out.mkdir(parents=True, exist_ok=True)
    bag = str(out / "bag") if record else ""

    def on_page(url: str) -> None:
        print(f"     watch it in a browser: {url}", file=sys.stderr, flush=True)

    with closed_loop(settings, calibration, out / "nodes.log", bag, on_page) as (client, _):
        with Progress("closed loop: targets") as progress:
            closed = approach(client, settings, angles, progress)
        path = _path(client)
        table = stage_table(client)
    drive = data_sheet(settings)
    opened = open_loop(settings, drive, angles)
    tolerance = max(drive.tolerance, drive.resolution)
    _write_csv(out / "moves.csv", closed, opened, settings)
    _plot(out / "closed_loop.png", path, closed, opened, tolerance)
    print(_move_table(closed, opened, tolerance))
    print(f"\n{table}")
    print(f"\nplot   {out / 'closed_loop.png'}\ntable  {out / 'moves.csv'}")
    missed = [move for move in closed if move.reason or abs(move.error) > tolerance]
    for move in missed:
        print(f"NOT reached: {move.target:.4f} rad, {move.reason or 'beyond the tolerance'}", file=sys.stderr)
    return 1 if missed else 0


def summary(name: str, moves: Sequence[Move], scale: float = 1e3) -> str:
    """One line: rms and largest angle error in mrad, mean cycles."""
    import numpy as np

    error = scale * np.array([move.error for move in moves])
    cycles = np.mean([move.cycles for move in moves])
    return f"{name:34}{np.sqrt((error**2).mean()):10.2f}{abs(error).max():10.2f}{cycles:10.1f}"


def stage_table(client: LoopClient) -> str:
    """What happens between one command and the next, median and 99th percentile."""
    from mems6dof_ros.nodes.loop_client import stages

    rows = [f"{'from command to next command':34}{'median':>10}{'99 %':>10} ms"]
    rows += [
        f"{name:34}{middle:10.2f}{high:10.2f}"
        for name, (middle, high) in ((name, _percentiles(values)) for name, values in stages(client).items())
    ]
    return "\n".join(rows)


def _percentiles(seconds: NDArray[np.float64]) -> tuple[float, float]:
    import numpy as np

    middle, high = np.percentile(seconds * 1e3, (50, 99))
    return float(middle), float(high)


def _move_table(closed: Sequence[Move], opened: Sequence[Move], tolerance: float) -> str:
    rows = [f"{'target, rad':>12}{'error, mrad':>14}{'cycles':>8}{'fewest':>8}{'open loop, mrad':>17}"]
    for move, blind in zip(closed, opened, strict=True):
        rows.append(
            f"{move.target:12.4f}{move.error * 1e3:14.3f}{move.cycles:8d}{move.fewest:8d}"
            f"{blind.error * 1e3:17.1f}"
        )
    rows += [
        "",
        f"{'angle error, mrad':34}{'rms':>10}{'largest':>10}{'cycles':>10}",
        summary("closed loop", closed),
        summary("open loop, same drive", opened),
        f"{'tolerance':34}{'':10}{tolerance * 1e3:10.2f}",
    ]
    return "\n".join(rows)


def _path(client: LoopClient) -> list[tuple[int, float]]:
    """Motion cycle and true psi, from the first frame on."""
    from mems6dof_ros.recording import topics

    truths = client.received[topics.TRUTH]
    return [(truth.cycle, truth.psi - truths[0].psi) for truth in truths]


def _write_csv(
    path: Path, closed: Sequence[Move], opened: Sequence[Move], settings: SimulationSettings
) -> None:
    from mems6dof_ros import __version__

    with path.open("w", newline="", encoding="utf-8") as file:
        file.write("# format: mems6dof closed loop 1\n")
        file.write(f"# software_version: {__version__}\n")
        file.write(f"# simulation: {json.dumps(settings.to_dict())}\n")
        writer = csv.writer(file)
        writer.writerow(
            (
                *("target_rad", "error_rad", "cycles", "fewest_cycles", "state", "reason"),
                *("open_loop_error_rad", "open_loop_cycles"),
            )
        )
        for move, blind in zip(closed, opened, strict=True):
            row = [move.target, move.error, move.cycles, move.fewest, move.state.name, move.reason]
            writer.writerow([*row, blind.error, blind.cycles])


def _plot(
    path: Path,
    turned: Sequence[tuple[int, float]],
    closed: Sequence[Move],
    opened: Sequence[Move],
    tolerance: float,
) -> None:
    """Angle against cycle with the targets, and the errors at the end of each motion."""
    import numpy as np
    from matplotlib.figure import Figure

    from mems6dof_ros.analysis.figures import BLUE, GREY, ORANGE

    figure = Figure(figsize=(9, 6), layout="constrained")
    above, below = figure.subplots(2, 1)
    ends = np.cumsum([move.cycles for move in closed])
    above.stairs([move.target for move in closed], [0, *ends], baseline=None, color=GREY, label="target")
    above.plot(*np.array(turned).T, color=BLUE, label="gear, closed loop")
    blind = np.cumsum([move.cycles for move in opened])
    above.plot(
        blind, [move.target + move.error for move in opened], "x", color=ORANGE, label="gear, open loop"
    )
    above.set(xlabel="motion cycle", ylabel="psi, rad")
    number = np.arange(1, len(closed) + 1)
    below.axhspan(0, tolerance * 1e3, color=GREY, alpha=0.3, lw=0, label="tolerance")
    below.semilogy(number, [abs(move.error) * 1e3 for move in closed], "o", color=BLUE, label="closed loop")
    below.semilogy(number, [abs(move.error) * 1e3 for move in opened], "x", color=ORANGE, label="open loop")
    below.set(xlabel="target", ylabel="|error| at the end, mrad", xticks=number)
    for axes in (above, below):  # beside the data, not on them
        axes.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=3, frameon=False)
    figure.savefig(path, dpi=130)
