"""`analyze` with one worker and with two: the same bag, alternately."""

from __future__ import annotations

import hashlib
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from mems6dof_ros.analysis.analyze import analyze
from mems6dof_ros.bench.material import Material
from mems6dof_ros.bench.table import Row
from mems6dof_ros.pose.estimator import PoseEstimator
from mems6dof_ros.recording.frames import write_bag
from mems6dof_ros.simulation.experiment import loop
from mems6dof_ros.sources.bag import BagSource


def workers(material: Material) -> list[Row]:
    """Wall time: only meaningful where two cores are free."""
    count = 40 if material.quick else 600  # to open it takes as long as eight
    bag = material.directory / "bag"
    frames = [frame for frame, _ in zip(loop(material.frames), range(count), strict=False)]
    write_bag(bag, frames, material.calibration.camera, {}, lambda done: None)
    seconds = {1: np.inf, 2: np.inf}
    tables: dict[int, bytes] = {}
    for repeat in range(2 if material.quick else 3):
        for number in seconds:
            out = material.directory / f"analysis_{number}_{repeat}"
            begin = time.monotonic()
            analyze(BagSource(bag), material.localizer, [PoseEstimator()], out, workers=number)
            seconds[number] = min(seconds[number], time.monotonic() - begin)
            tables[number] = _results(out)
    identical = tables[1] == tables[2]
    speedup = seconds[1] / seconds[2] if identical else 0.0
    rates = {number: count / spent for number, spent in seconds.items()}
    details = {"results identical": identical, "speed-up of two independent threads here": _parallelism()}
    return [Row("analyze, 2 workers", rates[2], "/s", "1 worker", rates[1], speedup, 1.8, details=details)]


def _parallelism() -> float:
    """What two threads that share nothing gain on this machine, as busy as it is."""
    block = bytes(1 << 22)

    def hashes(seconds: float) -> int:
        done, end = 0, time.monotonic() + seconds
        while time.monotonic() < end:
            hashlib.sha256(block).digest()
            done += 1
        return done

    with ThreadPoolExecutor(2) as pool:
        return sum(pool.map(hashes, (1.0, 1.0))) / hashes(1.0)


def _results(out: Path) -> bytes:
    return b"".join((out / name).read_bytes() for name in ("cycles.csv", "localizations.csv"))
