"""A whole recording through the same core as the live nodes, without ROS and deterministic."""

from __future__ import annotations

import contextlib
import hashlib
import json
from collections import Counter, deque
from collections.abc import Callable, Generator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, dataclass, field
from itertools import chain
from pathlib import Path

from mems6dof_ros.errors import InputError
from mems6dof_ros.frame import Frame, GroundTruth
from mems6dof_ros.localization.localizations import Localizations
from mems6dof_ros.localization.localizer import Localizer
from mems6dof_ros.pose.bodies import Bodies
from mems6dof_ros.pose.cycle_pose import CyclePose
from mems6dof_ros.pose.estimator import PoseEstimator
from mems6dof_ros.recording import messages, topics
from mems6dof_ros.recording.bag import BagWriter
from mems6dof_ros.recording.frames import write_frame
from mems6dof_ros.recording.poses import pose_messages
from mems6dof_ros.recording.tables import CYCLES, LOCALIZATIONS, TableWriter, sightings
from mems6dof_ros.sources.bag import BagSource
from mems6dof_ros.sources.source import FrameSource

#: Called as progress(done, total) after every frame; total 0: unknown.
Progress = Callable[[int, int], None]

_FLUSH_EVERY = 50  # frames: so much is computed again soon, and chunks of one frame compress badly


@dataclass
class Summary:
    """What an analysis did. ``refused``: why frames could not be used. ``truths`` parallel to ``poses``,
    None where the recording knows no truth of that body."""

    frames: int = 0
    localizations: int = 0
    refused: list[str] = field(default_factory=list)
    poses: list[CyclePose] = field(default_factory=list)
    truths: list[GroundTruth | None] = field(default_factory=list)
    interrupted: bool = False

    @property
    def statuses(self) -> Counter[str]:
        """Number of poses by status."""
        return Counter(pose.status.name.lower() for pose in self.poses)


def analyze(
    source: FrameSource,
    localizer: Localizer,
    estimators: Sequence[PoseEstimator],
    out: Path,
    *,
    provenance: Mapping[str, str] | None = None,
    attachments: Mapping[str, bytes] | None = None,
    keep_images: bool = False,
    workers: int = 1,
    progress: Progress = lambda done, total: None,
    stopped: Callable[[], bool] = lambda: False,
) -> Summary:
    """Measure all frames of ``source``; write ``bag/``, ``cycles.csv``, ``localizations.csv`` into ``out``,
    and ``BODY_constellation.json`` for each body, by which another session may recognise it.

    Nothing in the results depends on when or how fast it runs: latencies stay unknown, and messages are
    recorded at the stamps of their frames. ``workers`` frames are localized at a time, with the same
    results; poses build on each other and follow in order. A frame that cannot be used is left out and its
    reason kept, but the first one must be usable. ``stopped`` is asked between frames; what is done by
    then is complete. Raises InputError for an ``out`` that is not empty, for ``workers`` below 1,
    for bodies that cannot be told apart, and for the first frame.
    """
    if workers < 1:
        raise InputError("workers", f"{workers}", "1 or more")
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(str(out), "something there already", "a new or empty directory")
    summary = Summary()
    bodies = Bodies(estimators) if estimators else None
    with contextlib.closing(_measured(source, localizer, workers, summary.refused)) as measured:
        # The first frame is measured before anything is created: most mistakes show there.
        first = next(measured, None)
        if first is None:
            raise InputError("input", "no frames", "at least one")
        out.mkdir(parents=True, exist_ok=True)
        provenance = {
            "made_by": "mems6dof analyze",
            **settings_of(localizer, estimators),
            **(provenance or {}),
        }
        with (
            BagWriter(out / "bag", compression="zstd", provenance=provenance) as bag,
            TableWriter(out / "cycles.csv", CYCLES, provenance) as cycles,
            TableWriter(out / "localizations.csv", LOCALIZATIONS, provenance) as particles,
        ):
            for name, data in (attachments or {}).items():
                bag.attach(name, data)
            for frame, found in chain([first], measured):
                poses = bodies.update(found) if bodies else []
                _write(bag, frame, found, poses, keep_images)
                for pose in poses:
                    cycles.write(pose)
                particles.write_rows(sightings(found, poses))
                _count(summary, frame, found, poses)
                if summary.frames % _FLUSH_EVERY == 0:
                    for writer in (bag, cycles, particles):
                        writer.flush()
                progress(summary.frames + len(summary.refused), source.info.frames or 0)
                if stopped():
                    summary.interrupted = True
                    break
        for estimator in estimators:
            _keep_constellation(estimator, out)
    return summary


def settings_of(localizer: Localizer, estimators: Sequence[PoseEstimator]) -> dict[str, str]:
    """Everything set that bears on the results, for the provenance."""
    calibration = localizer.calibration
    settings = {
        "calibration_id": calibration.calibration_id if calibration else "none",
        "calibration_method": calibration.method if calibration else "none",
        "localizer": json.dumps(asdict(localizer.settings)),
    }
    for estimator in estimators:
        settings[f"pose_of_{estimator.body}"] = json.dumps(asdict(estimator.settings))
        if estimator.region is not None:
            settings[f"region_of_{estimator.body}"] = json.dumps(asdict(estimator.region))
        if estimator.reference is not None:
            settings[f"particles_known_of_{estimator.body}"] = str(len(estimator.reference.ids))
    return settings


def sha256_of(path: Path) -> str:
    """SHA-256 of a file, or of the names and contents of a folder's files."""
    digest = hashlib.sha256()
    for file in sorted(path.iterdir()) if path.is_dir() else [path]:
        if path.is_dir():
            digest.update(file.name.encode())
        with file.open("rb") as stream:
            while block := stream.read(1 << 20):
                digest.update(block)
    return digest.hexdigest()


def _measured(
    source: FrameSource, localizer: Localizer, workers: int, refused: list[str]
) -> Generator[tuple[Frame, Localizations], None, None]:
    """Frames with their localizations; after the first, those that cannot be used become reasons."""
    usable = False
    with contextlib.closing(_results(source, localizer, workers)) as results:
        for result in results:
            try:
                frame, found = result()
            except InputError as error:
                if not usable:
                    raise
                refused.append(str(error))
                continue
            usable = True
            yield frame, found


def _results(
    source: FrameSource, localizer: Localizer, workers: int
) -> Generator[Callable[[], tuple[Frame, Localizations]], None, None]:
    """For each frame, in order, what returns it with its localizations or raises its InputError.

    One thread reads, ``workers`` localize, and as many decompress a bag: compiled kernels, OpenCV and
    decompression leave the interpreter to others. One thread from beginning to end reads, because some files
    insist on that.
    """
    if isinstance(source, BagSource):
        source.threads = workers
    pending: deque[Future[tuple[Frame, Localizations] | None]] = deque()

    def measure(read: Future[Frame | None]) -> tuple[Frame, Localizations] | None:
        frame = read.result()
        return None if frame is None else (frame, localizer.localize(frame))

    # Frames under way behind the one that is waited for: enough to work on while poses and tables are made.
    ahead = 2 * workers if workers > 1 else 0
    with ThreadPoolExecutor(1, "reader") as reader, ThreadPoolExecutor(workers, "localizer") as pool:
        reader.submit(source.start).result()
        try:
            while True:
                while len(pending) <= ahead:
                    pending.append(pool.submit(measure, reader.submit(source.read)))
                first = pending.popleft()
                if first.exception() is None and first.result() is None:
                    return
                yield first.result  # type: ignore[misc]
        finally:
            reader.submit(source.stop).result()


def _write(
    bag: BagWriter, frame: Frame, found: Localizations, poses: Sequence[CyclePose], keep_images: bool
) -> None:
    write_frame(bag, frame)
    if keep_images:
        bag.write_message(f"/{topics.IMAGE}", messages.image(frame), frame.stamp_ns)
    bag.write_message(f"/{topics.LOCALIZATIONS}", messages.localizations(found), frame.stamp_ns)
    for topic, message in pose_messages(poses):
        bag.write_message(f"/{topic}", message, frame.stamp_ns)


def _keep_constellation(estimator: PoseEstimator, out: Path) -> None:
    """Unless nothing is known that a body could be recognised by."""
    if estimator.constellation is not None:
        known = estimator.snapshot()
        if len(known.ids) >= estimator.settings.min_particles:
            known.save(out / f"{estimator.body}_constellation.json")


def _count(summary: Summary, frame: Frame, found: Localizations, poses: Sequence[CyclePose]) -> None:
    summary.frames += 1
    summary.localizations += len(found)
    truths = {truth.body: truth for truth in frame.truth}
    for pose in poses:
        summary.poses.append(pose)
        summary.truths.append(truths.get(pose.body))
