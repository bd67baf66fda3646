"""A measurement with a page open beside it, and without."""

from __future__ import annotations

import asyncio
import contextlib
import math
import statistics
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import aiohttp
import numpy as np

from mems6dof_ros.bench.material import CYCLES, Material
from mems6dof_ros.errors import Mems6dofError
from mems6dof_ros.figures import Figure, at_least, at_most, information
from mems6dof_ros.monitor.validation.browser import READY, Console, chromium, page_socket
from mems6dof_ros.monitor.validation.nodes import DRIVE, monitor, namespace
from mems6dof_ros.nodes.runner import run_system
from mems6dof_ros.nodes.system import NodeSpec, chain, with_tracking
from mems6dof_ros.nodes.watch import watch_poses
from mems6dof_ros.recording import topics

#: Cycles per second that four processes reach on two cores, with something left over.
_FOUR_PROCESSES = 60.0
#: Of a measurement with each kind of page and one without it; seconds before and of each of them.
_ROUNDS, _SETTLE, _LENGTH = 5, 4.0, 12.0


class _Poses:
    """Arrivals of poses, monotonic s, and their latencies from frame to pose, s; heard in a thread."""

    def __init__(self) -> None:
        self._heard: list[tuple[float, float]] = []

    @contextlib.contextmanager
    def listening(self, namespace: str) -> Iterator[None]:
        """Hear them."""
        done = threading.Event()

        def on_pose(pose: Any) -> None:
            self._heard.append((time.monotonic(), pose.latency.total))

        with watch_poses(on_pose, namespace) as spin:

            def hear() -> None:
                while not done.is_set():
                    spin(0.1)

            thread = threading.Thread(target=hear, daemon=True)
            thread.start()
            try:
                yield
            finally:
                done.set()
                thread.join()

    def __len__(self) -> int:
        return len(self._heard)

    def since(self, begin: float) -> tuple[float, float]:
        """Poses per second and their median latency, s, from the monotonic time ``begin`` on."""
        chosen = [(at, latency) for at, latency in list(self._heard) if at >= begin]
        if len(chosen) < 10:
            raise Mems6dofError(
                f"{len(chosen)} poses in {time.monotonic() - begin:.0f} s: too few to compare"
            )
        span = chosen[-1][0] - chosen[0][0]
        return (len(chosen) - 1) / span, statistics.median(latency for _, latency in chosen)


def measure(work: Path, tell: Callable[[str], None], quick: bool = False, **_: Any) -> Iterator[Figure]:
    """Rate and latency of poses with a page open and without, in turns in one run.

    At the drive's rate in the arrangement that reaches it on two cores, source, localizer and pose in one
    process; and, for information, of four processes at a rate that they sustain. *Here* is a browser on this
    machine, which draws without a graphics card; *elsewhere* is a client that takes all that a page takes
    and draws nothing, as if the browser were on another machine.
    """
    tell("calibration of the simulated optics")
    material = Material(work, quick=quick)
    with chromium() as browser:
        tell(f"one process at {DRIVE:.0f} cycles/s, with a page and without")
        yield from _in_turns(material, "pipeline", DRIVE, browser, 2 if quick else _ROUNDS)
        tell(f"four processes at {_FOUR_PROCESSES:.0f} cycles/s")
        for row in _in_turns(material, "processes", _FOUR_PROCESSES, browser, 2):
            yield information(row["quantity"], row["measured"])


def _in_turns(
    material: Material, arrangement: str, rate: float, browser: Any, rounds: int
) -> Iterator[Figure]:
    """Figures of one run of an ``arrangement`` that tracks, of nodes.system.chain."""
    name, poses = namespace(), _Poses()
    pages: Mapping[str, Callable[[str], contextlib.AbstractContextManager[None]]] = {
        "here": lambda url: _browsing(browser, url),
        "elsewhere": _reading,
    }
    with (
        poses.listening(name),
        run_system(
            _tracking(material, arrangement, rate), namespace=name, on_line=lambda line: None
        ) as running,
    ):
        deadline = time.monotonic() + 240.0
        while len(poses) < 4 * CYCLES:
            if running.poll() or time.monotonic() > deadline:
                raise Mems6dofError(f"no poses to compare: {len(poses)}, nodes ended {running.poll()}")
            time.sleep(0.1)

        def listen() -> tuple[float, float]:
            time.sleep(_SETTLE)
            begin = time.monotonic()
            time.sleep(_LENGTH)
            return poses.since(begin)

        without, ratios = [listen()], defaultdict(list)
        for _ in range(rounds):
            for where, opened in pages.items():
                with monitor(name) as (url, _pid), opened(url):
                    with_page = listen()
                without.append(listen())
                # Against what was just before and just after it: a machine drifts.
                ratios[where].append(np.array(with_page) / np.mean(without[-2:], axis=0))
    base_rate, base_latency = np.median(without, axis=0)
    title = f"{arrangement}, {rate:.0f}/s"
    yield information(f"{title}: poses per second, no page", base_rate)
    yield information(f"{title}: median latency, ms, no page", base_latency * 1e3)
    for where, found in ratios.items():
        rates, latencies = np.median(found, axis=0)
        # Of the median of a normal distribution: sqrt(pi / 2) times that of the mean.
        error = math.sqrt(math.pi / 2 / rounds) * np.std(found, axis=0, ddof=1)
        yield at_least(f"{title}: rate with a page {where}, of that without", rates, 0.95)
        yield information("    its standard error", error[0])
        yield at_most(f"{title}: latency with a page {where}, of that without", latencies, 1.05)
        yield information("    its standard error", error[1])


def _tracking(material: Material, arrangement: str, rate: float) -> list[NodeSpec]:
    settings = {"width_px": material.size, "height_px": material.size, **material.simulation}
    source = {"source": "simulator", "simulator.loop": CYCLES, "pacing": "rate", "rate": rate}
    nodes = chain(
        NodeSpec("frame_source", source | {f"simulator.{key}": value for key, value in settings.items()}),
        calibration=str(material.calibration_path),
        watched={topics.POSE_6DOF: "watch"},
        arrangement=arrangement,
    )
    return with_tracking(nodes)


@contextlib.contextmanager
def _browsing(browser: Any, url: str) -> Iterator[None]:
    shown = Console().open(browser, url)
    shown.wait_for_function(READY)
    yield
    shown.context.close()


@contextlib.contextmanager
def _reading(url: str) -> Iterator[None]:
    """Take all that a page takes."""
    done = threading.Event()

    async def read() -> None:
        async with aiohttp.ClientSession() as session, page_socket(session, url) as socket:
            await socket.send_json({"type": "pictures", "on": True})
            async for message in socket:
                if done.is_set():
                    return
                if message.type is aiohttp.WSMsgType.BINARY and message.data[0] == 2:
                    await socket.send_json({"type": "seen"})

    thread = threading.Thread(target=lambda: asyncio.run(read()), daemon=True)
    thread.start()
    yield
    done.set()
    thread.join(timeout=5)
