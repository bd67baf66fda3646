"""The recorder killed at full rate, as figures of `mems6dof validate lab`."""

from __future__ import annotations

import contextlib
import io
import os
import random
import shutil
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from mcap.reader import make_reader
from mcap.records import Message
from mcap.stream_reader import StreamReader
from rosbags.highlevel import AnyReader

from mems6dof_ros.cli.main import main
from mems6dof_ros.errors import Mems6dofError
from mems6dof_ros.figures import Figure, exactly, information
from mems6dof_ros.recording.recover import mcap_files
from mems6dof_ros.recording.validation.processes import kill, traffic, until, witnessed_recorder
from mems6dof_ros.recording.validation.traffic import CYCLE, Journal

KILLS = 50


@dataclass(frozen=True)
class Death:
    """What became of one recorder: messages it had ``written``; how many of them ``must`` come back, all but
    those of the last cycle and what follows it; how many were readable ``before`` and ``after`` recovery, by
    two readers; ``age`` ms before the kill of the oldest that did not come back; ``rate`` cycles/s."""

    written: int
    must: int
    before: int
    after: int
    indexed: int
    age: float
    rate: float


def figures(work: Path, seed: int, tell: Callable[[str], None], kills: int = KILLS) -> Iterator[Figure]:
    """All figures: ``kills`` at the highest rate with small frames, some with full ones."""
    # By themselves: what others in the domain do to the ports of the killed is not what is measured.
    os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
    for size, rate, number in ((64, 250.0, kills), (2048, 30.0, max(kills // 10, 1))):
        tell(f"kill the recorder {number} times, {size} x {size} px at {rate:g}/s")
        lives = list(die(work / f"killed_{size}", seed, number, size, rate))
        deaths = [death for death in lives if death]
        name = f"SIGKILL, {size} px"
        silent = len(lives) - len(deaths)
        yield exactly(f"{name}: starts after which no message came within a minute", silent, 0)
        yield information(f"{name}: kills", len(deaths))
        yield information(f"{name}: cycles/s recorded, median", float(np.median([d.rate for d in deaths])))
        yield information(f"{name}: messages written", sum(d.written for d in deaths))
        lost = sum(max(d.must - d.after, 0) for d in deaths)
        yield exactly(f"{name}: written more than one cycle before and not recovered", lost, 0)
        unread = sum(max(d.must - d.before, 0) for d in deaths)
        yield exactly(f"{name}: of these not readable before recovery (mcap's StreamReader)", unread, 0)
        differing = sum(d.after != d.indexed for d in deaths)
        yield exactly(f"{name}: bags of which rosbags and mcap read different numbers", differing, 0)
        oldest = max(d.age for d in deaths)
        yield information(f"{name}: oldest message that did not come back, ms before", oldest)


def die(work: Path, seed: int, kills: int, size: int, rate: float) -> Iterator[Death | None]:
    """Kill a recorder at a random moment, ``kills`` times, while ``rate`` cycles per second pass.

    None for one that heard nothing within a minute; what it listens to is then started anew, too.
    """
    rng = random.Random(seed)
    namespace = f"crash_{os.getpid()}"
    bag, noted = work / "bag", work / "journal"
    work.mkdir(parents=True)
    with contextlib.ExitStack() as stack:
        publisher = stack.enter_context(traffic(namespace, rate, size))
        for _ in range(kills):
            shutil.rmtree(bag, ignore_errors=True)
            with witnessed_recorder(namespace, bag, noted, split_duration=0.7) as (process, journal):
                try:
                    until(lambda: len(journal.written[0]), "message recorded", process, publisher)
                    time.sleep(rng.uniform(0.05, 1.5))
                except Mems6dofError:
                    stack.close()
                    publisher = stack.enter_context(traffic(namespace, rate, size))
                    silent = True
                else:
                    silent = False
                killed = kill(process)
            yield None if silent else _examine(bag, journal, killed)


def _examine(bag: Path, journal: Journal, killed: int) -> Death:
    times, ends = journal.written
    cycles = np.flatnonzero(ends)
    must = int(cycles[-2]) + 1 if len(cycles) > 1 else 0
    before = sum(_readable(path) for path in mcap_files(bag))
    with contextlib.redirect_stdout(io.StringIO()):
        if main(["recover", str(bag)]):
            return Death(len(times), must, before, 0, -1, np.inf, 0.0)
    with AnyReader([bag]) as reader:
        after = sum(1 for _ in reader.messages())
    indexed = 0
    for path in mcap_files(bag):
        with path.open("rb") as stream:
            indexed += sum(1 for _ in make_reader(stream).iter_messages())
    age = (killed - times[after]) * 1e-6 if after < len(times) else 0.0
    seconds = max(times[-1] - times[0], 1) * 1e-9
    return Death(len(times), must, before, after, indexed, float(age), len(times) / len(CYCLE) / seconds)


def _readable(path: Path) -> int:
    """Messages that a reader finds which takes records as they come."""
    count = 0
    with path.open("rb") as stream, contextlib.suppress(Exception):  # the cut itself
        for record in StreamReader(stream).records:
            count += isinstance(record, Message)
    return count
