"""A page that stays open: memory, lag and completeness."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from mems6dof_ros.bench.processes import memory_of, processor_seconds
from mems6dof_ros.figures import Figure, at_least, at_most, exactly, information
from mems6dof_ros.monitor.validation import browser
from mems6dof_ros.monitor.validation.nodes import DRIVE, monitor, namespace, synthetic


def measure(
    work: Path, tell: Callable[[str], None], quick: bool = False, seconds: float = 600.0, **_: Any
) -> Iterator[Figure]:
    """Memory, lag and completeness of a page that stays open at 90 cycles/s for ``seconds``.

    Growth is that from the second sixth to the last; lag is from the middle of an exposure, which is when the
    poses are made here, to the cycle being known to the page.
    """
    if quick:
        seconds = min(seconds, 60.0)
    console, name = browser.Console(), namespace()
    with (
        synthetic(name, rate=DRIVE, image_every=1),
        monitor(name) as (url, pid),
        browser.chromium() as chromium,
    ):
        shown = console.open(chromium, url)
        shown.wait_for_function(browser.READY)
        inspector = shown.context.new_cdp_session(shown)
        inspector.send("Performance.enable")
        renderers = browser.renderers()
        start, spent = time.monotonic(), (processor_seconds(pid), sum(map(processor_seconds, renderers)))
        first = shown.evaluate("mems6dof.view.history.last('cycle')")
        samples = []
        while (passed := time.monotonic() - start) < seconds:
            tell(f"page open for {passed:.0f} of {seconds:.0f} s")
            pause = time.monotonic() + seconds / 60
            lags = []
            while time.monotonic() < pause:
                lags.append(shown.evaluate("Date.now() / 1000 - mems6dof.view.history.last('stamp')"))
                time.sleep(0.2)
            inspector.send("HeapProfiler.collectGarbage")
            metrics = {m["name"]: m["value"] for m in inspector.send("Performance.getMetrics")["metrics"]}
            heap, nodes = metrics["JSHeapUsedSize"] / 1e6, metrics["Nodes"]
            rendering, serving = sum(memory_of(one).own for one in renderers), memory_of(pid).own
            samples.append((heap, rendering, serving, statistics.median(lags), nodes))
        passed = time.monotonic() - start
        busy = processor_seconds(pid) - spent[0], sum(map(processor_seconds, renderers)) - spent[1]
        cycles = shown.evaluate(
            "(({ cycle, first, end }) => [...cycle.slice(first, end)])(mems6dof.view.history)"
        )
        shown_rate = (cycles[-1] - first) / passed
    sixth = max(len(samples) // 6, 1)
    early = np.median(samples[sixth : 2 * sixth + 1], axis=0)
    late = np.median(samples[-sixth:], axis=0)
    heap, renderer, node, lag, elements = late - early
    minutes = f"{seconds / 60:.3g} min at 90/s"
    yield at_least(f"{minutes}: cycles that reached the page per second", shown_rate, 0.98 * DRIVE)
    yield exactly(f"{minutes}: cycles missing in the page", int(np.sum(np.diff(cycles) != 1)), 0)
    yield at_most(f"{minutes}: growth of the page's heap, MB, of {early[0]:.1f}", heap, 2.0)
    yield at_most(f"{minutes}: growth of the renderer's memory, MiB, of {early[1]:.0f}", renderer, 20.0)
    yield at_most(f"{minutes}: growth of the node's memory, MiB, of {early[2]:.0f}", node, 5.0)
    yield at_most(f"{minutes}: growth of the elements of the page, of {early[4]:.0f}", elements, 50)
    yield at_most(f"{minutes}: growth of the lag, ms, of {early[3] * 1e3:.0f}", lag * 1e3, 20.0)
    yield information("processor time of the monitor node per cycle, ms", busy[0] / passed / DRIVE * 1e3)
    yield information("processor time of the page per second, s", busy[1] / passed)
    for complaint in console.complaints:
        tell(f"console: {complaint}")
    yield exactly(f"{minutes}: errors and warnings on the console", len(console.complaints), 0)
