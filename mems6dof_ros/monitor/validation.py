"""The live page as its users and its enemies find it: loaded, steered, left open, attacked.

What a browser shows is read from a real one: headless Chromium, driven by playwright. Both are optional;
without them there is nothing to measure here but the attacks and the Foxglove protocol.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import math
import os
import shutil
import statistics
import struct
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path
from typing import Any

import aiohttp
import numpy as np

from mems6dof_ros.errors import Mems6dofError
from mems6dof_ros.figures import Figure, at_least, at_most, exactly, information
from mems6dof_ros.monitor.attacks import ATTACKS, Attack, wrong_token
from mems6dof_ros.monitor.feed import Feed
from mems6dof_ros.monitor.history import COLUMNS
from mems6dof_ros.monitor.server import MonitorServer
from mems6dof_ros.monitor.synthetic import Machine
from mems6dof_ros.recording import topics

#: Cycles per second of the drive.
DRIVE = 90.0
_START = 30.0  # s that a node may take to serve
_SERVICES = ("frame_source/stop", "frame_source/start", "pose_estimator/set_reference", "recorder/start")
_SCREENS = {"laptop": (1366, 768), "projector": (1920, 1080)}
_READY = "() => mems6dof.charts[0].data?.y.length > 0"
_PICTURES = "[...document.querySelectorAll('canvas')].map((canvas) => canvas.toDataURL())"


# Browser, nodes ------------------------------------------------------------------------------------


@contextlib.contextmanager
def chromium() -> Iterator[Any]:
    """A headless browser (of playwright); Mems6dofError where there is none."""
    try:
        from playwright.sync_api import Error, sync_playwright
    except ModuleNotFoundError as error:
        raise Mems6dofError("the page is measured by playwright: pip install playwright") from error
    names = ("chromium", "chromium-browser", "google-chrome")
    path = next(filter(None, map(shutil.which, names)), None)
    with sync_playwright() as library:
        arguments = ["--no-sandbox", "--disable-gpu", "--disable-background-networking"]
        try:
            browser = library.chromium.launch(executable_path=path, args=arguments)
        except Error as error:
            raise Mems6dofError(f"no browser: install one of {', '.join(names)}") from error
        try:
            yield browser
        except Error as error:
            raise Mems6dofError(f"browser: {error.message.splitlines()[0]}") from error
        browser.close()


class Console:
    """Everything that pages complain of."""

    def __init__(self) -> None:
        self.complaints: list[str] = []

    def open(self, browser: Any, url: str, size: tuple[int, int] = (1366, 768), **options: Any) -> Any:
        """A page in a profile of its own."""
        viewport = {"width": size[0], "height": size[1]}
        page = browser.new_context(viewport=viewport, **options).new_page()
        add = self.complaints.append
        page.on("console", lambda m: add(m.text) if m.type in ("error", "warning") else None)
        page.on("pageerror", lambda error: add(str(error)))
        page.on("requestfailed", lambda request: add(request.url))
        page.goto(url)
        return page


@contextlib.contextmanager
def monitor(namespace: str) -> Iterator[tuple[str, int]]:
    """A monitor node: the address of its page, its process id."""
    from mems6dof_ros.nodes.system import NodeSpec

    with _node(NodeSpec("monitor", {"port": 0}), namespace, "live page: ") as found:
        yield found


@contextlib.contextmanager
def _node(spec: Any, namespace: str, says: str = "") -> Iterator[tuple[str, int]]:
    """A node as a process, once it has said so: what came after it on that line, and its process id."""
    from mems6dof_ros.nodes.system import run_system

    said: list[str] = []
    lines: list[str] = []

    def on_line(line: str) -> None:
        lines.append(line)
        if says in line:
            said.append(line.partition(says)[2])

    with run_system([spec], namespace=namespace, on_line=on_line) as running:
        deadline = time.monotonic() + _START
        while says and not said:
            if running.poll() or time.monotonic() > deadline:
                raise Mems6dofError(f"{spec.executable} does not start: {'; '.join(lines[-3:])}")
            time.sleep(0.02)
        yield said[0] if says else "", running.processes[spec.executable].pid


def _synthetic(namespace: str, **parameters: Any) -> Any:
    from mems6dof_ros.nodes.system import NodeSpec

    return _node(NodeSpec("synthetic_gear", parameters), namespace, "active")


def _namespace() -> str:
    return f"validate_{os.getpid()}"


# The page in a browser ------------------------------------------------------------------------------


def page(work: Path, tell: Callable[[str], None], **_: Any) -> Iterator[Figure]:
    """Loading, movement, buttons, and silence on the console, at 90 cycles/s."""
    console = Console()
    with _synthetic(_namespace(), rate=DRIVE), monitor(_namespace()) as (url, _pid), chromium() as browser:
        tell("the page is loaded and steered")
        times = []
        for attempt in range(5):
            started = time.monotonic()
            shown = console.open(browser, url)
            shown.wait_for_function(_READY)
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
        yield at_least("page: micrographs with overlay per second", micrographs, 2.0)
        yield at_least("page: cycles shown per second, of 90", cycles, 0.95 * DRIVE)
        particles = shown.evaluate("mems6dof.micrograph.overlay.x_px.length")
        yield at_least("page: particles on the micrograph", particles, 20)
        yield exactly(
            f"page: buttons that work, of {len(_SERVICES) + 6}", _press(shown, work), len(_SERVICES) + 6
        )
        for scheme in ("light", "dark"):
            for screen, size in _SCREENS.items():
                other = console.open(browser, url, size, color_scheme=scheme)
                other.wait_for_function(_READY)
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


def _last(shown: Any, column: str) -> float:
    return float(shown.evaluate(f"mems6dof.view.history.last('{column}')"))


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


# Beside a measurement -------------------------------------------------------------------------------


class _Poses:
    """Arrivals of poses, monotonic s, and their latencies from frame to pose, s; heard in a thread."""

    def __init__(self) -> None:
        self._heard: list[tuple[float, float]] = []

    @contextlib.contextmanager
    def listening(self, namespace: str) -> Iterator[None]:
        """Hear them."""
        from mems6dof_ros.nodes.watch import watch_poses

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


def beside(work: Path, tell: Callable[[str], None], quick: bool = False, **_: Any) -> Iterator[Figure]:
    """Rate and latency of poses with a page open and without, in turns in one run.

    At the drive's rate in the arrangement that reaches it on two cores, source, localizer and pose in one
    process; and, for information, of four processes at the highest rate that they reach: they leave
    nothing for others. *Here* is a browser on this machine, which draws without a graphics card;
    *elsewhere* is a client that takes all that a page takes and draws nothing, as if the browser were on
    another machine.
    """
    from mems6dof_ros.bench.material import Material

    tell("calibration of the simulated optics")
    material = Material(work, quick=quick)
    with chromium() as browser:
        tell(f"one process at {DRIVE:.0f} cycles/s, with a page and without")
        yield from _in_turns(material, DRIVE, browser, f"{DRIVE:.0f} cycles/s", quick)
        tell("four processes at their highest rate")
        for row in _in_turns(material, 0.0, browser, "four processes, highest rate", quick):
            yield information(row["quantity"], row["measured"])


def _in_turns(material: Any, rate: float, browser: Any, name: str, quick: bool) -> Iterator[Figure]:
    """Figures of one run: at ``rate`` of one process that tracks, or 0: of four at their highest."""
    from mems6dof_ros.bench.material import CYCLES
    from mems6dof_ros.nodes.system import NodeSpec, chain, run_system

    namespace, poses = _namespace(), _Poses()
    pacing = (
        {"pacing": "rate", "rate": rate}
        if rate
        else {"pacing": "consumer", "acknowledged_by": topics.POSE_6DOF}
    )
    settings = {"width_px": material.size, "height_px": material.size, **material.simulation}
    simulation = {f"simulator.{key}": value for key, value in settings.items()}
    source = NodeSpec(
        "frame_source", {"source": "simulator", "simulator.loop": CYCLES, **pacing, **simulation}
    )
    nodes = chain(
        source,
        calibration=str(material.calibration_path),
        watched={topics.POSE_6DOF: "watch"},
        arrangement="pipeline" if rate else "processes",
    )
    if rate:
        nodes = [replace(node, parameters={**node.parameters, "tracking.enabled": True}) for node in nodes]
    pages: Mapping[str, Callable[[str], contextlib.AbstractContextManager[None]]] = {
        "here": lambda url: _browsing(browser, url),
        "elsewhere": _reading,
    }
    settle, length, rounds = (3.0, 6.0, 1) if quick else (5.0, 15.0, 3)
    with (
        poses.listening(namespace),
        run_system(nodes, namespace=namespace, on_line=lambda line: None) as running,
    ):
        deadline = time.monotonic() + 240.0
        while len(poses) < 4 * CYCLES:
            if running.poll() or time.monotonic() > deadline:
                raise Mems6dofError(f"no poses to compare: {len(poses)}, nodes ended {running.poll()}")
            time.sleep(0.1)

        def measure() -> tuple[float, float]:
            time.sleep(settle)
            begin = time.monotonic()
            time.sleep(length)
            return poses.since(begin)

        without, ratios = [measure()], defaultdict(list)
        for _ in range(rounds):
            for where, opened in pages.items():
                with monitor(namespace) as (url, _pid), opened(url):
                    rate_with, latency_with = measure()
                without.append(measure())
                rates, latencies = np.mean(without[-2:], axis=0)
                ratios[where].append((rate_with / rates, latency_with / latencies))
    base_rate, base_latency = np.median(without, axis=0)
    yield information(f"{name}: poses per second, no page", base_rate)
    yield information(f"{name}: median latency, ms, no page", base_latency * 1e3)
    for where, found in ratios.items():
        rates, latencies = np.median(found, axis=0)
        yield at_least(f"{name}: rate with a page {where}, of that without", rates, 0.95)
        yield at_most(f"{name}: latency with a page {where}, of that without", latencies, 1.05)


@contextlib.contextmanager
def _browsing(browser: Any, url: str) -> Iterator[None]:
    shown = Console().open(browser, url)
    shown.wait_for_function(_READY)
    yield
    shown.context.close()


@contextlib.contextmanager
def _reading(url: str) -> Iterator[None]:
    """Take all that a page takes."""
    done = threading.Event()

    async def read() -> None:
        async with aiohttp.ClientSession() as session, _page_socket(session, url) as socket:
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


def _page_socket(session: aiohttp.ClientSession, url: str) -> Any:
    return session.ws_connect(f"{url}live", headers={"Origin": url.rstrip("/")}, max_msg_size=0)


# Left open ------------------------------------------------------------------------------------------


def endurance(
    work: Path, tell: Callable[[str], None], quick: bool = False, seconds: float = 600.0, **_: Any
) -> Iterator[Figure]:
    """Memory, lag and completeness of a page that stays open at 90 cycles/s for ``seconds``.

    Growth is that from the second sixth to the last; lag is from the middle of an exposure, which is when the
    poses are made here, to the cycle being known to the page.
    """
    if quick:
        seconds = min(seconds, 60.0)
    console, namespace = Console(), _namespace()
    with (
        _synthetic(namespace, rate=DRIVE, image_every=1),
        monitor(namespace) as (url, pid),
        chromium() as browser,
    ):
        shown = console.open(browser, url)
        shown.wait_for_function(_READY)
        inspector = shown.context.new_cdp_session(shown)
        inspector.send("Performance.enable")
        renderers = _renderers()
        start, spent = time.monotonic(), (_processor_seconds(pid), sum(map(_processor_seconds, renderers)))
        first = _last(shown, "cycle")
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
            samples.append((heap, sum(map(_memory, renderers)), _memory(pid), statistics.median(lags), nodes))
        passed = time.monotonic() - start
        busy = _processor_seconds(pid) - spent[0], sum(map(_processor_seconds, renderers)) - spent[1]
        cycles = shown.evaluate("[...mems6dof.view.history.columns.cycle.slice(mems6dof.view.history.first,"
                                " mems6dof.view.history.end)]")  # fmt: skip
        shown_rate = (cycles[-1] - first) / passed
    sixth = max(len(samples) // 6, 1)
    early = np.median(samples[sixth : 2 * sixth + 1], axis=0)
    late = np.median(samples[-sixth:], axis=0)
    heap, renderer, node, lag, elements = late - early
    minutes = f"{seconds / 60:.3g} min at 90/s"
    yield at_least(f"{minutes}: cycles that reached the page per second", shown_rate, 0.98 * DRIVE)
    yield exactly(f"{minutes}: cycles missing in the page", int(np.sum(np.diff(cycles) != 1)), 0)
    yield at_most(f"{minutes}: growth of the page's heap, MB, of {early[0]:.1f}", heap, 2.0)
    yield at_most(f"{minutes}: growth of the renderer's memory, MB, of {early[1]:.0f}", renderer, 20.0)
    yield at_most(f"{minutes}: growth of the node's memory, MB, of {early[2]:.0f}", node, 5.0)
    yield at_most(f"{minutes}: growth of the elements of the page, of {early[4]:.0f}", elements, 250)
    yield at_most(f"{minutes}: growth of the lag, ms, of {early[3] * 1e3:.0f}", lag * 1e3, 20.0)
    yield information("processor time of the monitor node per cycle, ms", busy[0] / passed / DRIVE * 1e3)
    yield information("processor time of the page per second, s", busy[1] / passed)
    for complaint in console.complaints:
        tell(f"console: {complaint}")
    yield exactly(f"{minutes}: errors and warnings on the console", len(console.complaints), 0)


def _renderers() -> list[int]:
    """Process ids of what draws the pages of this process's browsers."""
    parents: dict[int, int] = {}
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            pid = int(folder.name)
            parents[pid] = int((folder / "stat").read_text(encoding="utf-8").rpartition(")")[2].split()[1])
            if b"--type=renderer" in (folder / "cmdline").read_bytes():
                found.append(pid)

    def ours(pid: int) -> bool:
        while pid > 1:
            if pid == os.getpid():
                return True
            pid = parents.get(pid, 0)
        return False

    return [pid for pid in found if ours(pid)]


def _processor_seconds(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _memory(pid: int) -> float:
    """Resident memory that is not a file's, MB."""
    for line in Path(f"/proc/{pid}/status").read_text(encoding="utf-8").splitlines():
        if line.startswith("RssAnon:"):
            return int(line.split()[1]) * 1024 / 1e6
    return math.nan


# Foxglove -------------------------------------------------------------------------------------------


async def foxglove_messages(
    url: str, wanted: Mapping[str, int]
) -> tuple[dict[str, Any], dict[str, list[Any]]]:
    """What a client that shares no code with the bridge gets: the channels advertised by topic, and so many
    decoded messages of each topic wanted, with the schemas that it is sent."""
    from mcap.records import Schema
    from mcap_ros2.decoder import DecoderFactory

    channels: dict[str, Any] = {}
    decoded: dict[str, list[Any]] = {topic: [] for topic in wanted}
    decoders: dict[int, tuple[str, Any]] = {}
    async with (
        aiohttp.ClientSession() as session,
        session.ws_connect(url, protocols=["foxglove.sdk.v1"], max_msg_size=0) as socket,
    ):
        while any(len(decoded[topic]) < count for topic, count in wanted.items()):
            message = await socket.receive(30)
            if message.type is aiohttp.WSMsgType.TEXT:
                for channel in json.loads(message.data).get("channels", []):
                    topic = channel["topic"]
                    channels[topic] = channel
                    if topic not in wanted:
                        continue
                    number = len(decoders)
                    schema = Schema(
                        1, channel["schema"].encode(), channel["schemaEncoding"], channel["schemaName"]
                    )
                    decoders[number] = topic, DecoderFactory().decoder_for(channel["encoding"], schema)
                    request = {"id": number, "channelId": channel["id"]}
                    await socket.send_json({"op": "subscribe", "subscriptions": [request]})
            elif message.type is aiohttp.WSMsgType.BINARY and message.data[0] == 1:  # message data
                number, _ = struct.unpack_from("<IQ", message.data, 1)
                topic, decode = decoders[number]
                decoded[topic].append(decode(message.data[13:]))
    return channels, decoded


def foxglove(work: Path, tell: Callable[[str], None], **_: Any) -> Iterator[Figure]:
    """Poses and the rest through the bridge, read by a client that knows only the protocol."""
    from mems6dof_ros.nodes.recorder import KNOWN_TYPES
    from mems6dof_ros.nodes.system import NodeSpec

    namespace = _namespace()
    counts = {topics.POSE_6DOF: 300, topics.LOCALIZATIONS: 100, topics.FRAME_INFO: 100, topics.IMAGE: 2}
    wanted = {f"/{namespace}/{topic}": count for topic, count in counts.items()}
    bridge = NodeSpec("foxglove_bridge", {"port": 0})
    with (
        _synthetic(namespace, image_every=1),
        _node(bridge, namespace, "Foxglove WebSocket: ") as (url, _pid),
    ):
        tell("a client that shares no code with the bridge listens to it")
        channels, decoded = asyncio.run(asyncio.wait_for(foxglove_messages(url, wanted), 60))
    poses = decoded[f"/{namespace}/{topics.POSE_6DOF}"]
    yield at_least("Foxglove: topics with their definitions", len(channels), len(KNOWN_TYPES))
    missing = int(np.sum(np.diff([pose.cycle for pose in poses]) != 1))
    yield exactly(f"Foxglove: cycles missing among {len(poses)} poses decoded", missing, 0)
    turned = np.diff([pose.psi for pose in poses if pose.status == 1])
    yield at_most(
        "Foxglove: median rotation per cycle, off by, mrad",
        abs(float(np.median(turned)) - math.radians(4.5)) * 1e3,
        2.0,
    )
    particles = [len(found.x) for found in decoded[f"/{namespace}/{topics.LOCALIZATIONS}"]]
    yield at_least("Foxglove: particles in each of 100 frames", min(particles), 20)
    image = decoded[f"/{namespace}/{topics.IMAGE}"][0]
    yield exactly("Foxglove: bytes missing of an image", image.step * image.height - len(image.data), 0)


# Attacked -------------------------------------------------------------------------------------------


def attacks(work: Path, tell: Callable[[str], None], **_: Any) -> Iterator[Figure]:
    """Each attack while a page watches 90 cycles/s: refused, told to the log, no cycle missed by the page."""
    for name, attack in {**ATTACKS, "wrong token": wrong_token}.items():
        tell(f"attack: {name}")
        refused, logged, missed = attacked(
            attack, token="a token of 21 signs" if attack is wrong_token else ""
        )
        yield exactly(f"attack: {name}: refused", refused, 1)
        yield at_least(f"attack: {name}: lines in the log", logged, 1)
        yield exactly(f"attack: {name}: cycles missed by a page that watches", missed, 0)


def attacked(attack: Attack, token: str = "") -> tuple[bool, int, int]:
    """Whether a server refused it, the lines that it logged, and the rows that a page missed meanwhile."""
    feed, machine = Feed(100_000), Machine(size=128)
    log: list[str] = []
    feed.set_instrument({"services": {"frame_source/stop": True}})

    def call(service: str, value: float | None) -> Future[tuple[bool, str]]:
        raise AssertionError(f"{service} was called")

    server = MonitorServer(feed, call, token=token, log=log.append)
    url = server.start().partition("?")[0]
    done = threading.Event()

    pose = machine.cycle(0, image=False)[2]
    feed.add_pose(pose)

    def measure() -> None:
        for number in range(1, 100_000):
            if done.wait(1 / DRIVE):
                return
            feed.add_pose(replace(pose, cycle=number, frame_counter=number))

    async def watch_under_attack() -> tuple[bool, int]:
        cookies = {"mems6dof_monitor": token} if token else None
        cycles: list[int] = []

        async def watch(socket: Any) -> None:
            async for message in socket:
                if message.type is aiohttp.WSMsgType.BINARY and message.data[:4] == b"\x01\x00\x00\x00":
                    _, _, rows, columns = struct.unpack_from("<4I", message.data)
                    table = np.frombuffer(message.data, "<f8", offset=16).reshape(rows, columns)
                    cycles.extend(table[:, list(COLUMNS).index("cycle")].astype(int).tolist())

        async with aiohttp.ClientSession(cookies=cookies) as session, _page_socket(session, url) as socket:
            watching = asyncio.create_task(watch(socket))
            await asyncio.sleep(0.5)
            refused = await attack(url)
            newest = feed.state()["bodies"][0]["cycle"]
            deadline = time.monotonic() + 2.0
            while time.monotonic() < deadline and (not cycles or cycles[-1] < newest) and not watching.done():
                await asyncio.sleep(0.02)
            watching.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await watching
        return refused, newest - cycles[0] + 1 - sum(cycle <= newest for cycle in cycles)

    measuring = threading.Thread(target=measure, daemon=True)
    measuring.start()
    try:
        refused, missed = asyncio.run(asyncio.wait_for(watch_under_attack(), 60))
    finally:
        done.set()
        measuring.join()
        server.stop()
    return refused, len(log), missed


#: Part of the table to what measures it.
PARTS: Mapping[str, Callable[..., Iterator[Figure]]] = {
    "page": page,
    "beside": beside,
    "endurance": endurance,
    "foxglove": foxglove,
    "attacks": attacks,
}
