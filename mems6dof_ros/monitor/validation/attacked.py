"""The page under attack: refused, told to the log, nothing disturbed."""

from __future__ import annotations

import asyncio
import contextlib
import struct
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path
from typing import Any

import aiohttp
import numpy as np

from mems6dof_ros.figures import Figure, at_least, exactly
from mems6dof_ros.monitor.attacks import ATTACKS, Attack, wrong_token
from mems6dof_ros.monitor.feed import Feed
from mems6dof_ros.monitor.history import COLUMNS
from mems6dof_ros.monitor.server import MonitorServer
from mems6dof_ros.monitor.synthetic import Machine
from mems6dof_ros.monitor.validation.browser import page_socket
from mems6dof_ros.monitor.validation.nodes import DRIVE


def measure(work: Path, tell: Callable[[str], None], **_: Any) -> Iterator[Figure]:
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

        async with aiohttp.ClientSession(cookies=cookies) as session, page_socket(session, url) as socket:
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
