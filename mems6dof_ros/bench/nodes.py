"""The nodes as processes over DDS: rate, losses, latency and memory, beside the bare transport.

The bare transport is an ordinary subscriber to the images; our localizer takes them from the memory that it
shares with the source (``nodes.shared_frames``), and over the topic in a row for information.
"""

from __future__ import annotations

import math
import os
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from mems6dof_ros.bench.material import CYCLES, Material
from mems6dof_ros.bench.processes import memory_of, processor_seconds
from mems6dof_ros.bench.table import Row
from mems6dof_ros.errors import Mems6dofError
from mems6dof_ros.recording import messages, topics
from mems6dof_ros.recording.bag import BagReader
from mems6dof_ros.recording.direct_file import DirectFile

#: Motion cycles per second that the drive of the paper makes.
DRIVE = 90.0
#: Most time, s, that nodes may take to render their frames and to answer the first of them.
START = 240.0
#: Growth, MiB per 10 000 cycles, above which 200 bytes of each cycle are kept; 600 cycles tell less.
LEAK, LEAK_QUICK = 2.0, 50.0
#: Of the disk's own rate, that recorded frames take where it is what limits them.
DISK_SHARE = 0.8
#: Messages before the clocks run: the constellation is then known.
WARM_UP = 4 * CYCLES


@dataclass(frozen=True)
class Series:
    """What came out: ``rate`` 1/s; ``latency`` (n,) s from publication of a frame to that of the result;
    ``lost`` frames; by node, ``processor`` ms per cycle, and ``memory`` (samples,) of
    its own, MiB."""

    rate: float
    latency: np.ndarray
    lost: int
    processor: Mapping[str, float]
    memory: Mapping[str, np.ndarray]

    @property
    def details(self) -> dict[str, Any]:
        """For a row."""
        busy = {f"{name} ms": round(ms, 2) for name, ms in self.processor.items()}
        return {"cycles": len(self.latency), "lost": self.lost, "processor time per cycle": busy}

    def percentile(self, percent: float) -> float:
        """Of the latency, ms."""
        return float(np.percentile(self.latency, percent)) * 1e3


def four_processes(material: Material) -> list[Row]:
    """Highest rate without loss, each frame searched; then latency at the drive's rate or what can be
    sustained, tracking as it does when live; for information, without."""
    bare = _bare(material, 0.0)
    chain = _chain(material, 0.0, sustained=True)
    rate = min(DRIVE, 0.9 * chain.rate)
    paced_bare, paced = _bare(material, rate), _chain(material, rate)
    tracked = _chain(material, rate, tracking=True)
    tracked_free = _chain(material, 0.0, tracking=True)
    by_topic = _chain(material, 0.0, shared=False)
    # Eight tenths of the bare rate; where that has more than the drive needs, all that the drive needs.
    least = 0.8 if bare.rate < DRIVE else 1.0
    paced_name = f"latency at {rate:.0f}/s, four processes"
    return [
        Row("four processes over DDS", chain.rate, "/s", "a subscriber that does nothing", bare.rate,
            min(chain.rate, DRIVE) / min(bare.rate, DRIVE) if not chain.lost else 0.0, least,
            note="figure: both limited to 90/s; 0 where a frame was lost",
            details={"of the bare rate": chain.rate / bare.rate, **chain.details}),
        Row("... tracking", tracked_free.rate, "/s", "the same subscriber", bare.rate,
            tracked_free.rate / bare.rate, details=tracked_free.details),
        Row("... frames by the topic, not by shared memory", by_topic.rate, "/s", "the same subscriber",
            bare.rate, details=by_topic.details),
        *_latencies(f"{paced_name}, tracking", tracked, paced_bare, 8.0, 11.0),
        *_latencies(f"{paced_name}, each frame searched", paced, paced_bare, None, None),
    ]  # fmt: skip


def one_process(material: Material) -> list[Row]:
    """The pipeline node: highest rate, then latency at the drive's rate or what can be sustained, tracking as
    it does when live; for information, without."""
    free = _chain(material, 0.0, arrangement="pipeline")
    rate = min(DRIVE, 0.9 * free.rate)
    paced = _chain(material, rate, arrangement="pipeline")
    tracked = _chain(material, rate, arrangement="pipeline", tracking=True)
    return [
        Row("pipeline", free.rate, "/s", "the drive", DRIVE, free.rate, DRIVE, details=free.details),
        *_latencies(f"latency at {rate:.0f}/s, pipeline, tracking", tracked, None, 6.0, 9.0),
        *_latencies(f"latency at {rate:.0f}/s, pipeline, each frame searched", paced, None, None, None),
    ]  # fmt: skip


def recorder(material: Material) -> list[Row]:
    """What a recorder beside the chain takes of its rate, and whether it writes all frames too.

    At the drive's rate, or nine tenths of what the chain can do: beyond it whatever runs takes its share.
    Frames at that rate too, or at the disk's, tracking as it does when live.
    """
    free = _chain(material, 0.0)
    rate = min(DRIVE, 0.9 * free.rate)
    without = _chain(material, rate)
    beside = _chain(material, rate, output=material.directory / "recorded")
    beside_free = _chain(material, 0.0, output=material.directory / "recorded_free")
    output = material.directory / "recorded_frames"
    size = 2e-6 * material.size**2
    disk = _disk_rate(material.directory)
    with_frames = min(rate, DISK_SHARE * disk / size)
    frames = _chain(material, with_frames, tracking=True, output=output, images=True)
    gaps = _missing(output, topics.IMAGE)
    missing = _missing(material.directory / "recorded", topics.POSE_6DOF)
    return [
        Row(f"recorder beside, at {rate:.0f}/s: poses and localizations", beside.rate, "/s", "without",
            without.rate, beside.rate / without.rate if not beside.lost + missing else 0.0, 0.97,
            note="figure: 0 where a frame was lost, or a pose is missing in the bag",
            details={"missing in the bag": missing, **beside.details}),
        Row("recorder beside, at the highest rate", beside_free.rate, "/s", "without", free.rate,
            beside_free.rate / free.rate, details=beside_free.details),
        Row(f"recorder beside, tracking, at {with_frames:.0f}/s: frames too", frames.rate * size, "MB/s",
            "the disk, sequential", disk, frames.rate / with_frames if not frames.lost + gaps else 0.0, 0.97,
            note="figure: rate over what was asked for; 0 where a frame was lost, or is missing in the bag",
            details={"missing in the bag": gaps, **frames.details}),
    ]  # fmt: skip


def _missing(bag: Path, topic: str) -> int:
    """Of how many frames the message of ``topic`` is missing between the first and the last in ``bag``."""
    counters, stamps = {}, []
    with BagReader(bag) as reader:
        names = {name.rsplit("/", 1)[-1]: name for name in reader.topics}
        for found in reader.messages((names[topic], names[topics.FRAME_INFO])):
            stamp = messages.nanoseconds(found.message.header.stamp)
            if found.topic == names[topic]:
                stamps.append(stamp)
            else:
                counters[stamp] = int(found.message.frame_counter)
    # Of the very last frame perhaps only a part came before the recorder was stopped.
    present = sorted(counters[stamp] for stamp in stamps if stamp in counters)
    return present[-1] - present[0] + 1 - len(present)


def endurance(material: Material) -> list[Row]:
    """Growth of each node's memory, over the second half of the cycles."""
    series = _chain(material, 0.0, cycles=600 if material.quick else 10_000)
    rows = []
    for name, samples in series.memory.items():
        half = samples[len(samples) // 2 :]
        cycles = len(series.latency) / 2
        growth = float(np.polyfit(np.linspace(0, cycles, len(half)), half, 1)[0]) * 1e4
        rows.append(
            Row(f"memory of {name}", float(half.mean()), "MiB", "flat", None, growth, None,
                LEAK_QUICK if material.quick else LEAK, note="figure: MiB per 10 000 cycles")
        )  # fmt: skip
    return rows


def _latencies(
    name: str, series: Series, bare: Series | None, median: float | None, worst: float | None
) -> list[Row]:
    """Median and 99 %, beyond the bare transport where there is one; limits None: for information. A latency
    of the frames that came through says nothing where some did not."""
    rows = []
    for label, percent, limit in ((", median", 50, median), (", 99 %", 99, worst)):
        measured = series.percentile(percent)
        base = None if bare is None else bare.percentile(percent)
        rows.append(
            Row(name + label, measured, "ms", "bare transport" if bare else "", base,
                measured - (base or 0.0) if not series.lost else math.inf, None, limit,
                details=series.details if percent == 50 else {})
        )  # fmt: skip
    return rows


# Arrangements --------------------------------------------------------------------------------------


def frame_source(material: Material, rate: float, acknowledged_by: str) -> Any:
    from mems6dof_ros.nodes.system import NodeSpec

    pacing = (
        {"pacing": "rate", "rate": rate}
        if rate
        else {"pacing": "consumer", "acknowledged_by": acknowledged_by}
    )
    settings = {"width_px": material.size, "height_px": material.size, **material.simulation}
    simulation = {f"simulator.{name}": value for name, value in settings.items()}
    return NodeSpec("frame_source", {"source": "simulator", "simulator.loop": CYCLES, **pacing, **simulation})


def _duration(material: Material, sustained: bool = False) -> float:
    if material.quick:
        return 8.0
    return 60.0 if sustained else 30.0


def _bare(material: Material, rate: float) -> Series:
    from mems6dof_ros.nodes.runner import run_system

    source = frame_source(material, rate, topics.LOCALIZATIONS)
    waiting = {**source.parameters, "wait_for_subscribers": [f"{topics.IMAGE}:1"]}
    namespace = f"bench_{os.getpid()}"
    nodes = [replace(source, parameters=waiting)]
    with (
        _listening(topics.LOCALIZATIONS, namespace) as (received, spin),
        run_system(nodes, namespace=namespace, on_line=_quiet) as running,
        ExitStack() as stack,
    ):
        environment = {**os.environ, "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
        command = [
            sys.executable,
            "-m",
            "mems6dof_ros.bench.listener",
            "--ros-args",
            "-r",
            f"__ns:=/{namespace}",
        ]
        listener = subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL)
        stack.callback(_end, listener)
        processes = {**{name: p.pid for name, p in running.processes.items()}, "listener": listener.pid}
        return _measure(received, spin, running.poll, processes, topics.LOCALIZATIONS, _duration(material))


def _chain(
    material: Material,
    rate: float,
    *,
    arrangement: str = "processes",
    tracking: bool = False,
    sustained: bool = False,
    shared: bool = True,
    output: Path | None = None,
    images: bool = False,
    cycles: int = 0,
) -> Series:
    from mems6dof_ros.nodes.recorder import DEFAULT_TOPICS
    from mems6dof_ros.nodes.runner import run_system
    from mems6dof_ros.nodes.system import chain

    nodes = chain(
        frame_source(material, rate, topics.POSE_6DOF),
        calibration=str(material.calibration_path),
        output=str(output) if output else "",
        recorded=[*DEFAULT_TOPICS, topics.IMAGE] if images else DEFAULT_TOPICS,
        watched={topics.POSE_6DOF: "bench"},
        arrangement=arrangement,
    )
    further: dict[str, dict[str, Any]] = defaultdict(dict)
    if tracking:
        further["localizer"] = further["pipeline"] = {"tracking.enabled": True}
    if not shared:
        further["frame_source"] = {"share_frames": False}
    nodes = [replace(node, parameters={**node.parameters, **further[node.executable]}) for node in nodes]
    namespace = f"bench_{os.getpid()}"
    with (
        _listening(topics.POSE_6DOF, namespace) as (received, spin),
        run_system(nodes, namespace=namespace, on_line=_quiet) as running,
    ):
        processes = {name: process.pid for name, process in running.processes.items()}
        duration = 0.0 if cycles else _duration(material, sustained)
        return _measure(received, spin, running.poll, processes, topics.POSE_6DOF, duration, cycles)


def _quiet(line: str) -> None:
    """Nobody reads what the nodes say, but for what is wrong."""
    if "ERROR" in line or "error:" in line:
        print(line, file=sys.stderr)


def _end(process: subprocess.Popen[bytes]) -> None:
    process.terminate()
    process.wait(timeout=10)


# Measuring -----------------------------------------------------------------------------------------


@contextmanager
def _listening(
    topic: str, namespace: str
) -> Iterator[tuple[list[tuple[float, Any]], Callable[[float], None]]]:
    """Serialized messages of ``topic`` with the monotonic time of their arrival, while ``spin`` runs.

    They are looked for now and then: to wake up for each would take processor time from what is measured.
    """
    import rclpy
    from rclpy.signals import SignalHandlerOptions

    from mems6dof_msgs.msg import Localizations, Pose6DOF
    from mems6dof_ros.nodes import transport

    received: list[tuple[float, Any]] = []
    os.environ.update(transport.LOCALHOST_ONLY)
    transport.use_profile(frames=False)
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    try:
        node = rclpy.create_node("bench", namespace=namespace)
        kind = Pose6DOF if topic == topics.POSE_6DOF else Localizations
        subscription = node.create_subscription(kind, topic, lambda _: None, transport.MESSAGES, raw=True)

        def spin(seconds: float) -> None:
            time.sleep(seconds)
            with subscription.handle:
                while (found := subscription.handle.take_message(kind, True)) is not None:
                    received.append((time.monotonic(), found[0]))

        yield received, spin
    finally:
        rclpy.try_shutdown()


def _measure(
    received: list[tuple[float, Any]],
    spin: Callable[[float], None],
    poll: Callable[[], Mapping[str, int]],
    processes: Mapping[str, int],
    topic: str,
    duration: float,
    cycles: int = 0,
) -> Series:
    """After WARM_UP messages, those of ``duration`` s or so many ``cycles``."""

    def wait(done: Callable[[], bool], limit: float) -> None:
        deadline = time.monotonic() + limit
        while not done():
            spin(0.02)
            if codes := poll():
                raise Mems6dofError(f"nodes ended while they were measured: {dict(codes)}")
            if time.monotonic() > deadline:
                raise Mems6dofError(f"no {topic} for {limit:g} s: {len(received)} so far")

    wait(lambda: len(received) >= WARM_UP, START)
    begin, first = time.monotonic(), len(received)
    before = {name: processor_seconds(pid) for name, pid in processes.items()}
    memory: dict[str, list[float]] = {name: [] for name in processes}
    sampled = begin - 1.0

    def done() -> bool:
        nonlocal sampled
        if time.monotonic() - sampled > 0.5:
            sampled = time.monotonic()
            for name, pid in processes.items():
                memory[name].append(memory_of(pid).own)
        return len(received) - first >= cycles if cycles else time.monotonic() - begin >= duration

    wait(done, max(60.0 + duration, cycles / 2))
    after = {name: processor_seconds(pid) for name, pid in processes.items()}
    chosen = received[first:]
    latency, counters = zip(*(_read(data, topic) for _, data in chosen), strict=True)
    return Series(
        rate=(len(chosen) - 1) / (chosen[-1][0] - chosen[0][0]),
        latency=np.array(latency),
        lost=counters[-1] - counters[0] + 1 - len(counters),
        processor={name: (after[name] - before[name]) / len(chosen) * 1e3 for name in processes},
        memory={name: np.array(samples) for name, samples in memory.items()},
    )


def _read(data: bytes, topic: str) -> tuple[float, int]:
    """Latency, s, and frame counter of a serialized result."""
    if topic == topics.POSE_6DOF:
        pose = messages.deserialize(data, "mems6dof_msgs/msg/Pose6DOF")
        return float(pose.latency_total), int(pose.frame_counter)
    found = messages.deserialize(data, "mems6dof_msgs/msg/Localizations")
    spent = messages.nanoseconds(found.publication_time) - messages.nanoseconds(found.frame_publication_time)
    return spent * 1e-9, int(found.frame_counter)


def _disk_rate(directory: Path, size_mb: int = 4000) -> float:
    """MB/s of writing frames one after another, until they are on the disk; of less than a second's it may
    boast."""
    block = np.random.default_rng(0).integers(0, 255, 8_388_608, dtype=np.uint8).tobytes()
    file = DirectFile(directory / "disk")
    begin = time.monotonic()
    while file.tell() < size_mb * 10**6:
        file.write(block)
    file.sync()
    rate = file.tell() / 1e6 / (time.monotonic() - begin)
    file.close()
    (directory / "disk").unlink()
    return rate
