"""The page in a browser: loading, movement, buttons, and silence on the console."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from mems6dof_ros.figures import Figure, at_least, at_most, exactly
from mems6dof_ros.monitor.validation.browser import READY, Console, chromium
from mems6dof_ros.monitor.validation.nodes import DRIVE, monitor, namespace, synthetic

_SERVICES = ("frame_source/stop", "frame_source/start", "pose_estimator/set_reference", "recorder/start")
_SCREENS = {"laptop": (1366, 768), "projector": (1920, 1080)}
_PICTURES = "[...document.querySelectorAll('canvas')].map((canvas) => canvas.toDataURL())"


def measure(work: Path, tell: Callable[[str], None], **_: Any) -> Iterator[Figure]:
    """Loading, movement, buttons, and silence on the console, at 90 cycles/s."""
    console = Console()
    with synthetic(namespace(), rate=DRIVE), monitor(namespace()) as (url, _pid), chromium() as browser:
        tell("the page is loaded and steered")
        times = []
        for attempt in range(5):
            started = time.monotonic()
            shown = console.open(browser, url)
            shown.wait_for_function(READY)
            times.append(time.monotonic() - started)
            if attempt < 4:
                shown.context.close()
        yield at_most("page: from its address to drawn plots, s, median of 5", statistics.median(times), 2.0)
        shown.wait_for_function(
            "() => mems6dof.view.history.length > 200 && mems6dof.micrograph.overlay?.bodies"
        )
        before, begin, started = shown.evaluate(_PICTURES), _progress(shown), time.monotonic()
        time.sleep(5.0)
        end, passed = _progress(shown), time.monotonic() - started
        plots, micrographs, cycles = ((late - early) / passed for early, late in zip(begin, end, strict=True))
        moving = sum(one != other for one, other in zip(before, shown.evaluate(_PICTURES), strict=True))
        yield exactly(f"page: pictures that move, of {len(before)}", moving, len(before))
        yield at_least("page: plots drawn per second", plots, 5.0)
        yield at_least("page: micrographs with overlay per second", micrographs, 1.5)
        yield at_least("page: cycles shown per second, of 90", cycles, 0.95 * DRIVE)
        particles = shown.evaluate("mems6dof.micrograph.overlay.x_px.length")
        yield at_least("page: particles on the micrograph", particles, 20)
        yield exactly(
            f"page: buttons that work, of {len(_SERVICES) + 6}", _press(shown, work), len(_SERVICES) + 6
        )
        for scheme in ("light", "dark"):
            for screen, size in _SCREENS.items():
                other = console.open(browser, url, size, color_scheme=scheme)
                other.wait_for_function(READY)
                beyond = other.evaluate("document.documentElement.scrollWidth - innerWidth")
                yield at_most(f"page: px beyond the width of a {screen}, {scheme}", beyond, 0)
                other.context.close()
        shown.context.close()
    for complaint in console.complaints:
        tell(f"console: {complaint}")
    yield exactly("page: errors and warnings on the console", len(console.complaints), 0)


def _progress(shown: Any) -> list[float]:
    """Drawings so far of the plots and of the micrograph, and the last cycle."""
    counts = "[mems6dof.charts[0].drawn, mems6dof.micrograph.drawn, mems6dof.view.history.last('cycle')]"
    return list(shown.evaluate(counts))


def _press(shown: Any, work: Path) -> int:
    """Press every button; returns how many did what they say."""
    done = 0
    for service in _SERVICES:
        shown.wait_for_selector(f"[data-service='{service}']:enabled")
        shown.click(f"[data-service='{service}']")
        # An answer, or that there is none within the time that the page allows.
        shown.wait_for_function(
            "service => document.getElementById('answer').textContent.match(`✓ ${service}|✗`)", arg=service
        )
        done += shown.inner_text("#answer") == f"✓ {service} done"
        shown.evaluate("document.getElementById('answer').textContent = ''")
        if service == "frame_source/stop":
            shown.wait_for_function("() => document.getElementById('status-name').textContent === 'STALE'")
    shown.click("[data-window='80']")
    shown.wait_for_function("() => mems6dof.view.high - mems6dof.view.low <= 80")
    shown.click("#pause")
    frozen = shown.evaluate("mems6dof.view.high")
    time.sleep(0.5)
    done += 1 + (shown.evaluate("mems6dof.view.high") == frozen)
    for kind in ("csv", "png"):
        with shown.expect_download() as download:
            shown.click(f"#export-{kind}")
        download.value.save_as(work / f"shown.{kind}")
        done += (work / f"shown.{kind}").stat().st_size > 1000
    shown.click("#follow")
    shown.wait_for_function("frozen => mems6dof.view.high > frozen", arg=frozen)
    theme = "document.documentElement.dataset.theme"
    before = shown.evaluate(theme)
    shown.click("#theme")
    return done + 1 + (shown.evaluate(theme) != before)
