"""What the camera drivers lose, miscount or mis-stamp, measured against emulated cameras."""

from __future__ import annotations

import math
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mems6dof_ros.errors import Mems6dofError
from mems6dof_ros.figures import Figure, between, exactly, figure, information, remark
from mems6dof_ros.frame import Frame
from mems6dof_ros.nodes.validation import cameras as nodes
from mems6dof_ros.sources.cameras.basler import BaslerSource
from mems6dof_ros.sources.cameras.camera import CameraSource
from mems6dof_ros.sources.cameras.emulation import GigeEmulator, WireCounter, basler_emulator
from mems6dof_ros.sources.cameras.genicam import GenicamSource

_EXPOSURE = 0.01


def figures(
    seconds: float, size: int, rate: float, progress: Callable[[int, int, str], None]
) -> list[Figure]:
    """All figures: ``seconds`` of ``size`` x ``size`` px mono16 frames asked for at ``rate`` Hz.

    The emulators give what the machine can. One that is not installed is one row without a verdict.
    """
    parts = {"GigE": gige_stream, "GigE lossy": gige_losses, "GigE replug": gige_restart, "Basler": basler}
    parts |= {"GigE, nodes": nodes.gige, "Basler, nodes": nodes.poses}
    table: list[Figure] = []
    for k, (name, part) in enumerate(parts.items()):
        progress(k, len(parts), name)
        try:
            table += [{**row, "quantity": f"{name}: {row['quantity']}"} for row in part(seconds, size, rate)]
        except (Mems6dofError, PermissionError) as reason:
            table.append(remark(f"{name}: not measured, {reason}"))
    return table


def gige_stream(seconds: float, size: int, rate: float) -> Iterator[Figure]:
    """Counted independently on the wire; the emulator's clock, the host's own, is the truth of the stamps."""
    with WireCounter() as wire, GigeEmulator() as emulator:
        source = _gige(emulator, size, rate)
        stamps, errors, broken = [], [], 0
        for frame in _read_for(source, seconds, emulator.kill):
            stamps.append(frame.stamp_ns)
            errors.append((frame.stamp_ns - frame.device_time_ns) * 1e-9 + _EXPOSURE / 2)
            broken += len(stamps) % 10 == 0 and not _whole(frame.image)
        status, produced = source.status, wire.produced
        source.stop()
    settled = errors[len(errors) // 2 :]
    yield information("frames produced", produced)
    yield information("frames per second", (len(stamps) - 1) / ((stamps[-1] - stamps[0]) * 1e-9))
    yield information("reported lost", status.lost + status.pending)
    yield exactly(
        "produced - delivered - lost", produced - status.delivered - status.lost - status.pending, 0
    )
    yield exactly("stamps that do not ascend", sum(b <= a for a, b in pairwise(stamps)), 0)
    yield exactly("images that are not whole (every 10th looked at)", broken, 0)
    yield information("stamp error, mean, ms", float(np.mean(settled)) * 1e3)
    yield information("stamp error, standard deviation, ms", float(np.std(settled)) * 1e3)
    within = math.sqrt(float(np.mean(np.square(settled)))) / status.stamp_uncertainty
    yield figure("stamp error, rms / stated uncertainty", within, "< 2", within < 2)


def gige_losses(seconds: float, size: int, rate: float) -> Iterator[Figure]:
    """Of a thousand packets five are not sent: a frame is whole or lost, never garbage."""
    # Small frames, so that some are whole; no more than 60000 may pass, for the wire counter does not unwrap.
    with WireCounter() as wire, GigeEmulator(lost_per_thousand=5) as emulator:
        source = _gige(emulator, min(size, 512), rate)
        broken = sum(not _whole(frame.image) for frame in _read_for(source, seconds / 3, emulator.kill))
        status, produced = source.status, wire.produced
        source.stop()
    unknown = produced - status.delivered - status.lost - status.pending
    yield information("delivered whole, share", status.delivered / produced)
    yield exactly("images that are not whole", broken, 0)
    # Before the first whole frame nothing tells of a loss.
    yield between("produced - delivered - lost", unknown, 0, 8)


def gige_restart(seconds: float, size: int, rate: float) -> Iterator[Figure]:
    """Killed, and restarted a second later."""
    with GigeEmulator() as emulator:
        source = _gige(emulator, size, rate)
        source.start()
        before = [source.read(timeout=10.0) for _ in range(40)][-1]
        restarted = threading.Event()
        restarted_at = 0.0

        def replug() -> None:
            nonlocal restarted_at
            emulator.kill()
            time.sleep(1.0)
            emulator.start()
            restarted_at = time.monotonic()
            restarted.set()

        threading.Thread(target=replug).start()
        while (frame := source.read(timeout=60.0)) is not None and not source.status.reconnects:
            before = frame
        resumed = time.monotonic() - restarted_at
        restarted.wait()
        source.stop()
    assert before is not None  # a live source has no end
    assert frame is not None
    away = (frame.device_time_ns - before.device_time_ns) * 1e-9
    yield information("without frames, s", away)
    yield figure("from its restart to the next frame, s", resumed, "< 10", resumed < 10)
    yield figure("reported lost", frame.frames_dropped, "> 0", frame.frames_dropped > 0)
    yield information("reported lost per second without frames, Hz", frame.frames_dropped / away)


def basler(seconds: float, size: int, rate: float) -> Iterator[Figure]:
    """pylon's emulator shows images of ours; one software trigger per frame."""
    images = np.random.default_rng(1).integers(0, 65536, (6, size, size), dtype=np.uint16)
    with tempfile.TemporaryDirectory() as folder, basler_emulator(Path(folder), list(images)) as options:
        source = BaslerSource(**options, trigger="software", exposure=1e-3)
        source.start()
        began, triggers, different, first = time.monotonic(), 0, 0, 0
        while time.monotonic() - began < seconds:
            source.trigger()
            triggers += 1
            frame = source.read(timeout=10.0)
            assert frame is not None  # a live source has no end
            if triggers == 1:
                first = next(k for k in range(6) if np.array_equal(frame.image, images[k]))
            different += not np.array_equal(frame.image, images[(first + frame.frame_counter) % 6])
        elapsed, status = time.monotonic() - began, source.status
        source.stop()
    yield information("triggers", triggers)
    yield information("frames per second", status.delivered / elapsed)
    yield exactly("triggers - delivered - lost", triggers - status.delivered - status.lost, 0)
    yield exactly("images that differ from ours", different, 0)


def _gige(emulator: GigeEmulator, size: int, rate: float) -> CameraSource:
    return GenicamSource(
        device=emulator.device,
        region=(0, 0, size, size),
        pixel_format="Mono16",
        frame_rate=rate,
        exposure=_EXPOSURE,
        timestamp_at="end",
        packet_size=9000,
    )


def _read_for(source: CameraSource, seconds: float, unplug: Callable[[], None]) -> Iterator[Frame]:
    """Frames of so many seconds, and those that were under way when the camera was unplugged."""
    source.start()
    end = time.monotonic() + seconds
    while (frame := source.read(timeout=10.0)) is not None:
        yield frame
        if time.monotonic() > end:
            break
    unplug()
    while True:
        try:
            frame = source.read(timeout=0.5)
        except TimeoutError:
            return
        if frame is not None:
            yield frame


def _whole(image: NDArray[np.generic]) -> bool:
    """The emulator draws a ramp of x + y + frame id: a stretch of another frame breaks it."""
    return bool((image[1:, :-1] == image[:-1, 1:]).all())
