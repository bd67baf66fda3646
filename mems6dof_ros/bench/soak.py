"""The instrument left alone: every node, recorder and monitor included, at the highest rate they sustain."""

from __future__ import annotations

import os
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from mems6dof_ros.bench.material import Material
from mems6dof_ros.bench.nodes import START, frame_source
from mems6dof_ros.bench.processes import Memory, memory_of
from mems6dof_ros.errors import Mems6dofError
from mems6dof_ros.figures import Figure, at_least, at_most, exactly, information
from mems6dof_ros.pose.cycle_pose import Status
from mems6dof_ros.recording import topics
from mems6dof_ros.recording.bag import BagReader

#: Seconds from one look at the memory to the next.
PERIOD = 2.0
#: MiB per hour that count as flat: a leak of one pose message per cycle would be 300.
FLAT = 30.0
#: MiB of a frame's buffer, and who holds some: one more than before is no leak.
FRAME, HOLD_FRAMES = 8.0, ("frame_source", "localizer", "monitor")
#: Files of the bag: the recorder keeps the index of the last one, so that its memory is a sawtooth.
FILES = 9


def soak(minutes: float, work: Path, tell: Callable[[str], None]) -> Iterator[Figure]:
    """Rows of `mems6dof validate lab --soak MINUTES`; ``work``: a directory on a disk with room for 0.4 GB of
    localizations a minute. Raises Mems6dofError where a node ends before its time."""
    from mems6dof_ros.nodes.runner import run_system
    from mems6dof_ros.nodes.system import NodeSpec, chain

    material = Material(work, quick=True)
    tell("calibrating")
    calibration, bag = str(material.calibration_path), work / "soak"
    source = frame_source(material, 0.0, topics.POSE_6DOF)
    nodes = chain(source, calibration=calibration, output=str(bag), monitor=NodeSpec("monitor", {"port": 0}))
    nodes = [
        replace(node, parameters={**node.parameters, "split_duration": 60 * minutes / FILES})
        if node.executable == "recorder"
        else node
        for node in nodes
    ]
    namespace, complaints = f"soak_{os.getpid()}", []
    memory: dict[str, list[Memory]] = defaultdict(list)

    def hear(line: str) -> None:
        if "WARN" in line or "ERROR" in line or "error" in line:
            complaints.append(line)

    with run_system(nodes, namespace=namespace, on_line=hear) as system:
        deadline = time.monotonic() + START
        while not (bag.is_dir() and sum(path.stat().st_size for path in bag.iterdir()) > 2**20):
            if time.monotonic() > deadline or system.poll():
                raise Mems6dofError(f"nothing recorded within {START:g} s: {complaints or 'no complaints'}")
            time.sleep(PERIOD)
        begin = time.monotonic()
        while (elapsed := time.monotonic() - begin) < 60 * minutes:
            tell(f"{elapsed / 60:.1f} of {minutes:g} minutes")
            if ended := system.poll():
                raise Mems6dofError(f"nodes ended after {elapsed:.0f} s: {ended}; {complaints}")
            pause = min(60.0, 60 * minutes - elapsed)
            until = time.monotonic() + pause
            while time.monotonic() < until:
                for name, process in system.processes.items():
                    memory[name].append(memory_of(process.pid))
                time.sleep(min(PERIOD, max(until - time.monotonic(), 0.0)))
        codes = system.stop()

    tell("reading the bag")
    counters, status, received = [], [], []
    with BagReader(bag) as reader:
        localizations = next(n for topic, n in reader.counts.items() if topic.endswith(topics.LOCALIZATIONS))
        for message in reader.messages([f"/{namespace}/{topics.POSE_6DOF}"]):
            counters.append(int(message.message.frame_counter))
            status.append(int(message.message.status))
            received.append(message.log_time_ns * 1e-9)
    span, count = received[-1] - received[0], len(counters)
    valid = sum(each in (Status.TRACKING, Status.DEGRADED) for each in status)
    thirds = np.array_split(np.array(received), 3)
    rates = [len(part) / (part[-1] - part[0]) for part in thirds]
    yield at_least("minutes", span / 60, minutes)
    yield information("poses recorded", count)
    yield information("poses per second", count / span)
    yield information("rate of the last third over that of the first", rates[-1] / rates[0])
    yield exactly("frames without a recorded pose", counters[-1] - counters[0] + 1 - count, 0)
    yield at_most("poses that are not valid (the first founds the reference)", count - valid, 1)
    yield exactly("localizations less poses recorded", localizations - count, 0)
    yield exactly("complaints in the logs", len(complaints), 0)
    yield exactly("nodes that did not end in good order", sum(code != 0 for code in codes.values()), 0)
    for name, samples in memory.items():
        yield from _flatness(name, samples, 60 * minutes)


def _flatness(name: str, samples: Sequence[Memory], seconds: float) -> Iterator[Figure]:
    """The first third is for warming up; what matters of the others is their largest, for memory is taken in
    buffers, and returned at the end of a file."""
    _, middle, last = np.array_split(np.array(samples), 3)
    growth = last[:, 0].max() - middle[:, 0].max()
    limit = FLAT * seconds / 3 / 3600 + (FRAME if name in HOLD_FRAMES else 0.0)
    yield information(f"{name}: own memory, MiB", last[:, 0].max())
    yield information(f"{name}: shared memory touched, MiB", last[:, 1].max())
    yield at_most(f"{name}: growth of its own memory from the middle to the last third, MiB", growth, limit)
