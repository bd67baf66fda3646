"""Frames to poses on one core: in memory, from a file, and tracked; with a profile of the stages."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from itertools import islice
from typing import NamedTuple

import cv2
import numpy as np
import tifffile

from mems6dof_ros.bench.material import CYCLES, Material
from mems6dof_ros.bench.table import Row
from mems6dof_ros.frame import Frame
from mems6dof_ros.localization.detection import detect
from mems6dof_ros.localization.fitting import fit_gaussians
from mems6dof_ros.localization.localizer import Localizer
from mems6dof_ros.localization.tracking import TrackingLocalizer
from mems6dof_ros.pose.estimator import PoseEstimator
from mems6dof_ros.simulation.experiment import loop, motion_frames
from mems6dof_ros.sources.images import ImagesSource

#: Poses before the clock runs: the constellation is then known and refined rarely, as in steady operation.
WARM_UP = 4 * CYCLES
#: Cycles per second of the drive.
DRIVE = 90.0


@contextmanager
def one_core() -> Iterator[None]:
    """OpenCV's threads would do part of the work unseen."""
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(threads)


class Steps(NamedTuple):
    """Processor seconds of each cycle (n,): ``localization``, ``pose``; ``particles`` used on average."""

    localization: np.ndarray
    pose: np.ndarray
    particles: float

    @property
    def rate(self) -> float:
        """Cycles per second."""
        return 1.0 / float(np.mean(self.localization + self.pose))


def run(frames: Iterator[Frame], localizer: Localizer | TrackingLocalizer, cycles: int) -> Steps:
    """Localize and estimate; processor time of this thread after WARM_UP cycles."""
    estimator = PoseEstimator()
    times, used = [], []
    with one_core():
        for frame in islice(frames, WARM_UP + cycles):
            begin = time.thread_time()
            found = localizer.localize(frame)
            middle = time.thread_time()
            pose = estimator.update(found)
            if isinstance(localizer, TrackingLocalizer) and pose.valid:
                localizer.observe(pose.cycle, pose.rotation, pose.translation, pose.reference_version)
            times.append((middle - begin, time.thread_time() - middle))
            used.append(pose.particles_used)
    spent = np.array(times[WARM_UP:])
    return Steps(spent[:, 0], spent[:, 1], float(np.mean(used[WARM_UP:])))


def in_memory(material: Material) -> list[Row]:
    """Detect, fit, z and pose of frames in memory."""
    cycles = 2 * CYCLES if material.quick else 10 * CYCLES
    localizer = material.localizer
    steps = run(loop(material.frames), localizer, cycles)
    details = {
        "particles used": steps.particles,
        "window px": material.calibration.window_px,
        **profile(material.frames[:: CYCLES // 5], localizer),
        "pose ms": float(np.median(steps.pose)) * 1e3,
        "pose ms, longest": float(np.max(steps.pose)) * 1e3,
    }
    return [
        Row("frames to poses, in memory, one core", steps.rate, "/s", "the drive", DRIVE, steps.rate, DRIVE,
            details=details)
    ]  # fmt: skip


def profile(frames: Sequence[Frame], localizer: Localizer) -> dict[str, float]:
    """Where the time of a frame goes, ms of one core: least of some repetitions, mean over frames."""
    calibration = localizer.calibration
    assert calibration is not None
    stages = np.full((len(frames), 4), np.inf)
    with one_core():
        for k, frame in enumerate(frames):
            for _ in range(5):
                marks = [time.thread_time()]
                candidates = detect(frame.image, localizer.settings.detection)
                marks.append(time.thread_time())
                fits = fit_gaussians(
                    frame.image, candidates, localizer.camera, calibration.weighting, calibration.window_px
                )
                marks.append(time.thread_time())
                calibration.locate(fits, frame.image)
                marks.append(time.thread_time())
                localizer.localize(frame, candidates)
                marks.append(time.thread_time())
                spent = np.diff(marks)
                spent[3] -= spent[1] + spent[2]  # what else localize does
                stages[k] = np.minimum(stages[k], spent)
    names = ("detection ms", "fits ms", "z ms", "judging fits ms")
    return {name: float(value) * 1e3 for name, value in zip(names, stages.mean(axis=0), strict=True)}


def tracking(material: Material) -> list[Row]:
    """Windows predicted from the motion, detection in one frame of sixteen."""
    cycles = 2 * CYCLES if material.quick else 10 * CYCLES
    localizer = TrackingLocalizer(material.localizer)
    steps = run(loop(material.frames), localizer, cycles)
    details = {
        "particles used": steps.particles,
        "searched frames": localizer.detections / (cycles + WARM_UP),
    }
    return [
        Row("frames to poses, tracking, one core", steps.rate, "/s", "twice the drive, and some", 200.0,
            steps.rate, 200.0, details=details)
    ]  # fmt: skip


def from_file(material: Material) -> list[Row]:
    """The same, read from an uncompressed TIFF stack; reading by wall time, since it may wait."""
    path = material.directory / "frames.tif"
    with tifffile.TiffWriter(path, bigtiff=True) as stack:
        for frame in material.frames:
            stack.write(frame.image, photometric="minisblack", metadata=None)
    source = ImagesSource(path, pixel_size=material.settings.pixel_size)

    def frames() -> Iterator[Frame]:
        for frame in loop(material.frames):
            if frame.cycle % CYCLES == 1:
                source.start()
            read = source.read()
            assert read is not None
            yield replace(frame, image=read.image)

    reading = []
    source.start()
    for _ in range(CYCLES):
        begin = time.monotonic()
        source.read()
        reading.append(time.monotonic() - begin)
    cycles = 2 * CYCLES if material.quick else 10 * CYCLES
    steps = run(frames(), material.localizer, cycles)
    each = float(np.median(reading))
    rate = 1 / (1 / steps.rate + each)
    return [
        Row("frames to poses, uncompressed file, one core", rate, "/s", "the drive", DRIVE, rate, DRIVE,
            details={"reading ms": each * 1e3})
    ]  # fmt: skip


def scaling(material: Material) -> list[Row]:
    """Processor time against particles and against the size of the field, with fitted slopes."""
    counts = (10, 100, 400) if material.quick else (10, 50, 100, 200, 400)
    sizes = (512, 1024, 2048) if material.quick else (512, 1024, 2048, 4096)
    by_count = [_cost(material, count, 2048) for count in counts]
    by_size = [_cost(material, 20, size) for size in sizes]  # few, so that 512 px hold them
    return [
        _slope(
            "detection and fits against particles",
            [n for n, _ in by_count],
            [t for _, t in by_count],
            "particle",
        ),
        _slope(
            "detection and fits against the field",
            [size**2 / 1e6 for size in sizes],
            [t for _, t in by_size],
            "Mpx",
        ),
    ]


def _cost(material: Material, particles: int, size: int) -> tuple[int, float]:
    """Candidates and processor ms of localizing one frame with about so many particles."""
    settings = replace(
        material.settings, particles=particles, clumps=0, width_px=size, height_px=size,
        gear_diameter=0.9 * size * material.settings.pixel_size, hub_diameter=0.0,
    )  # fmt: skip
    frame = next(iter(motion_frames(settings, 1)))
    localizer = Localizer(material.calibration.camera, None)
    with one_core():
        found = localizer.localize(frame)
        times = []
        for _ in range(9):
            begin = time.thread_time()
            localizer.localize(frame)
            times.append(time.thread_time() - begin)
    return len(found), min(times) * 1e3


def _slope(name: str, x: Sequence[float], y: Sequence[float], unit: str) -> Row:
    slope, offset = np.polyfit(x, y, 1)
    residual = np.asarray(y) - np.polyval([slope, offset], x)
    linearity = 1 - float(np.sum(residual**2) / np.sum((np.asarray(y) - np.mean(y)) ** 2))
    points = {f"{at:.4g}": round(value, 2) for at, value in zip(x, y, strict=True)}
    return Row(name, float(slope) * 1e3, f"us per {unit}", "a straight line", None, linearity, 0.97, None,
               "figure: part of the variance that the line explains",
               {"offset ms": float(offset), "points ms": points})  # fmt: skip
