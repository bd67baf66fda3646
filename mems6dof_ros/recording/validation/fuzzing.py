"""Damaged and contradictory files of every kind that is read, as figures of `mems6dof validate lab`."""

from __future__ import annotations

import json
import os
import random
import select
import shutil
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
import tifffile
from rosbags.rosbag2 import StoragePlugin

from mems6dof_ros.figures import Figure, at_most, exactly, information
from mems6dof_ros.frame import Frame
from mems6dof_ros.nodes import transport
from mems6dof_ros.nodes.common import AUTOSTART
from mems6dof_ros.nodes.parameters import as_yaml
from mems6dof_ros.nodes.recorder import PARAMETERS
from mems6dof_ros.pose.constellation_file import ReferenceConstellation
from mems6dof_ros.recording.validation.bags import write_mcap_ros2, write_ours, write_rosbags
from mems6dof_ros.recording.validation.mutation import contradicted, damaged, to_json, to_yaml
from mems6dof_ros.recording.validation.reading import Answer

#: How many of each kind.
FILES = {
    "bag": 2000,
    "images": 1000,
    "calibration": 500,
    "constellation": 500,
    "bodies": 500,
    "parameters": 500,
}
#: Seconds that a file of at most a few hundred kB may take, on a machine that does other things too.
TIME_LIMIT = 30.0
#: MiB that reading one may take, and by which the process may grow over all files after the first tenth.
MEMORY_LIMIT, GROWTH_LIMIT = 256.0, 32.0

BODIES = """
settings: {field_degree: 4}
bodies:
  load_gear:
    region: {centre: [-100.0e-6, 0.0], outer_radius: 170.0e-6}
  ring_gear:
    region: {centre: [474.0e-6, 0.0], outer_radius: 420.0e-6, inner_radius: 300.0e-6}
    constellation: constellation.json
    settings: {confirm_after: 2}
"""


def figures(work: Path, seed: int, tell: Callable[[str], None], scale: float = 1.0) -> Iterator[Figure]:
    """All figures, for ``scale`` times 5000 files; those that show a defect are kept in ``work``."""
    originals = write_originals(work / "originals")
    answers: list[Answer] = []
    growth = 0.0
    for kind, number in FILES.items():
        count = max(round(number * scale), 10)
        tell(f"{count} damaged files of the kind {kind}")
        of_kind = list(fuzz(kind, originals, count, seed, work, tell))
        after = [answer.resident for answer in of_kind if answer.resident]
        growth = max(growth, after[-1] - max(after[: 1 + len(after) // 10]))
        answers += of_kind
    outcomes = Counter(answer.outcome for answer in answers)
    yield information("fuzzed files: tried", len(answers))
    for outcome in ("refused", "part", "read"):
        yield information(f"fuzzed files: {outcome}", outcomes[outcome])
    yield exactly("fuzzed files: traceback instead of one line", outcomes["defect"], 0)
    yield exactly("fuzzed files: crash of the process", outcomes["crash"], 0)
    yield exactly(f"fuzzed files: more than {TIME_LIMIT:g} s", outcomes["hang"], 0)
    yield at_most("fuzzed files: longest time, s", max(answer.seconds for answer in answers), TIME_LIMIT)
    yield at_most("fuzzed files: most memory for one, MiB", max(a.memory for a in answers), MEMORY_LIMIT)
    yield at_most("fuzzed files: growth of the process, MiB", growth, GROWTH_LIMIT)


def write_originals(folder: Path) -> Path:
    """Small good files of every kind and of several writers, in a folder of their kind."""
    for kind in FILES:
        (folder / kind).mkdir(parents=True)
    rng = np.random.default_rng(1)
    frames = [_frame(rng, k) for k in range(12)]
    bags, images = folder / "bag", folder / "images"
    for compression in ("none", "lz4", "zstd"):
        write_ours(bags / f"ours_{compression}", frames, compression=compression, split_size=20_000)
    write_rosbags(bags / "rosbags_sqlite3", frames, StoragePlugin.SQLITE3)
    write_rosbags(bags / "rosbags_mcap", frames, StoragePlugin.MCAP)
    write_mcap_ros2(bags / "mcap_ros2", frames)
    stack = np.array([frame.image for frame in frames])
    tifffile.imwrite(images / "stack.tif", stack)
    tifffile.imwrite(images / "big.btf", stack, bigtiff=True, byteorder=">")
    tifffile.imwrite(images / "imagej.tif", stack, imagej=True)
    tifffile.imwrite(images / "deflated.tif", stack, compression="zlib", tile=(16, 16))
    scale = {"PhysicalSizeX": 0.127, "PhysicalSizeZ": 0.2}
    tifffile.imwrite(images / "stack.ome.tif", stack, metadata={"axes": "ZYX", **scale})
    for suffix in ("png", "pgm", "bmp"):
        cv2.imwrite(str(images / f"one.{suffix}"), (stack[0] // 256).astype(np.uint8))
    shutil.copy(_sample_calibration(), folder / "calibration" / "optics.yaml")
    constellation = ReferenceConstellation(
        "gear", np.arange(20), rng.normal(0.0, 1e-4, (20, 3)), np.tile(np.eye(3) * 1e-18, (20, 1, 1))
    )
    for kind in ("constellation", "bodies"):
        constellation.save(folder / kind / "constellation.json")
    (folder / "bodies" / "bodies.yaml").write_text(BODIES, encoding="utf-8")
    text = as_yaml("Parameters", (AUTOSTART, *PARAMETERS))
    (folder / "parameters" / "recorder.yaml").write_text(text, encoding="utf-8")
    return folder


def fuzz(
    kind: str, originals: Path, count: int, seed: int, work: Path, tell: Callable[[str], None]
) -> Iterator[Answer]:
    """What comes of ``count`` mutations of the originals of a kind, in a process that is begun anew where it
    died or hung. The outcome may also be ``crash`` and ``hang``."""
    rng = random.Random(f"{seed} {kind}")
    with _Reader(kind) as reader:
        for number in range(count):
            path = _mutated(rng, kind, originals / kind, work / "fuzzed")
            answer = reader.read(path)
            if answer.outcome in ("defect", "crash", "hang") or answer.memory > MEMORY_LIMIT:
                kept = work / "kept" / f"{kind}_{number}"
                kept.mkdir(parents=True, exist_ok=True)
                (shutil.copytree if path.is_dir() else shutil.copy)(path, kept / path.name)
                last = answer.reason.rstrip().rpartition("\n")[2]
                tell(f"{answer.outcome}, {answer.memory:.0f} MiB, {kept}: {last}")
                (kept / "reason.txt").write_text(answer.reason, encoding="utf-8")
            yield answer


class _Reader:
    """The process that reads."""

    def __init__(self, kind: str) -> None:
        self._kind = kind
        self._process: subprocess.Popen[str] | None = None

    def __enter__(self) -> _Reader:
        return self

    def __exit__(self, *_: object) -> None:
        self._end()

    def read(self, path: Path) -> Answer:
        """Have ``path`` read."""
        if self._process is None:
            command = [sys.executable, "-m", "mems6dof_ros.recording.validation.reading", self._kind]
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                text=True,
                env={**os.environ, **transport.LOCALHOST_ONLY},
            )
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        print(path, file=self._process.stdin, flush=True)
        if not select.select([self._process.stdout], [], [], TIME_LIMIT)[0]:
            self._end()
            return Answer("hang", f"no answer in {TIME_LIMIT:g} s", TIME_LIMIT, 0.0, 0.0)
        line = self._process.stdout.readline()
        if not line:
            code = self._process.wait()
            self._end()
            return Answer("crash", f"exit status {code}", 0.0, 0.0, 0.0)
        return Answer(*json.loads(line))

    def _end(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.communicate()
            self._process = None


def _mutated(rng: random.Random, kind: str, originals: Path, target: Path) -> Path:
    """A copy of one of the originals in ``target``, one of its files damaged; the path to read."""
    shutil.rmtree(target, ignore_errors=True)
    chosen = rng.choice(sorted(path for path in originals.iterdir() if _stands_for_itself(kind, path)))
    if kind == "bodies" or chosen.is_dir():
        shutil.copytree(chosen if chosen.is_dir() else originals, target)
    else:
        target.mkdir(parents=True)
        shutil.copy(chosen, target)
    victim = rng.choice(sorted(target.iterdir()))
    data = victim.read_bytes()
    if victim.suffix in (".yaml", ".json") and rng.random() < 0.7:
        dump = to_json if victim.suffix == ".json" else to_yaml
        victim.write_bytes(contradicted(rng, data.decode(), dump))
    else:
        victim.write_bytes(damaged(rng, data))
    if rng.random() < 0.02:
        victim.unlink()
        if rng.random() < 0.5:
            victim.mkdir()
    if chosen.is_dir():
        return target if rng.random() < 0.5 or victim.suffix == ".yaml" else victim
    return target / chosen.name


def _stands_for_itself(kind: str, path: Path) -> bool:
    return kind != "bodies" or path.suffix == ".yaml"


def _frame(rng: np.random.Generator, k: int) -> Frame:
    image = rng.integers(0, 2**16, (32, 48)).astype(np.uint16)
    return Frame(image, stamp_ns=1_700_000_000_000_000_000 + k * 10**7, frame_counter=k, cycle=k)


def _sample_calibration() -> Path:
    """That of the sample bag, of a checkout or of an installation."""
    name = Path("bags", "sample_calibration.yaml")
    prefixes = [Path(p) for p in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if p]
    folders: Sequence[Path] = [
        Path(__file__).resolve().parents[3],
        *(prefix / "share" / "mems6dof_ros" for prefix in (*prefixes, Path(sys.prefix))),
    ]
    return next(folder / name for folder in folders if (folder / name).is_file())
