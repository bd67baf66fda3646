"""The source on one host and the rest on another, as figures of `mems6dof validate lab`.

Two network namespaces stand for two hosts: their addresses differ, by which Fast DDS tells hosts apart, and
their only way to each other is a pair of virtual interfaces with an MTU of 1500. That the frames took it is
counted by the interface. Needs root and the tool ip.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import shutil
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from mems6dof_ros.figures import Figure, between, exactly, information, remark
from mems6dof_ros.nodes.runner import run_system
from mems6dof_ros.nodes.system import NodeSpec, chain
from mems6dof_ros.recording import topics
from mems6dof_ros.recording.bag import BagReader
from mems6dof_ros.simulation.settings import SimulationSettings
from mems6dof_ros.sources.simulator import camera_noise

_TIMEOUT = 300.0  # s
#: Whatever limits discovery here must not limit it there.
_UNLIMITED = ("env", "ROS_AUTOMATIC_DISCOVERY_RANGE=SUBNET")


def figures(work: Path, seed: int, tell: Callable[[str], None]) -> Iterator[Figure]:
    """All figures, or a remark on what is missing here."""
    if reason := why_not():
        yield remark(f"across machines: {reason}")
        return
    tell("full frames from one network namespace to another")
    yield from across_machines(work, size=2048, cycles=60, rate=5.0, seed=seed)


def why_not() -> str:
    """Why there can be no two hosts here; empty: there can."""
    if os.geteuid() != 0:
        return "not measured: needs root"
    if not shutil.which("ip"):
        return "not measured: needs the tool ip (iproute2)"
    try:
        with two_hosts():
            return ""
    except subprocess.CalledProcessError as error:
        return f"not measured: {(error.stderr or '').strip() or 'network namespaces are not permitted'}"


@contextlib.contextmanager
def two_hosts() -> Iterator[tuple[tuple[str, ...], tuple[str, ...]]]:
    """Two hosts on one network; yields what commands on each begin with."""
    names = [f"mems6dof_{os.getpid()}_{host}" for host in "ab"]
    links = [f"m6{host}{os.getpid()}" for host in "ab"]
    try:
        for name in names:
            _ip("netns", "add", name)
        _ip("link", "add", links[0], "type", "veth", "peer", "name", links[1])
        for number, (name, link) in enumerate(zip(names, links, strict=True), 1):
            _ip("link", "set", link, "netns", name)
            _ip("-n", name, "addr", "add", f"10.66.0.{number}/24", "dev", link)
            for device in ("lo", link):
                _ip("-n", name, "link", "set", device, "up")
        first, second = (("ip", "netns", "exec", name, *_UNLIMITED) for name in names)
        yield first, second
    finally:
        for name in names:  # their links go with them
            subprocess.run(["ip", "netns", "delete", name], capture_output=True)


def _ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True, capture_output=True, text=True)


def across_machines(
    work: Path, *, size: int, cycles: int, rate: float, seed: int = 1, **simulation: Any
) -> Iterator[Figure]:
    """``cycles`` frames of ``size`` px at ``rate`` Hz from one host, localized and recorded on the other."""
    settings = SimulationSettings(width_px=size, height_px=size, seed=seed, **simulation)
    options = {**settings.to_dict(), "cycles": cycles, "loop": 20}
    parameters = {f"simulator.{name}": value for name, value in options.items()}
    bag = work / "bag"
    source, localizer, *others = chain(
        # These two hosts are one, but two would have no memory in common.
        NodeSpec("frame_source", {"pacing": "rate", "rate": rate, "share_frames": False, **parameters}),
        calibration="",
        output=str(bag),
    )
    noise = {
        f"camera.{name}": float(np.mean(value))  # of a pixel-wise one, what is typical
        for name, value in dataclasses.asdict(camera_noise(settings)).items()
    }
    others = [replace(localizer, parameters={**localizer.parameters, **noise}), *others]
    with (
        (work / "network.log").open("w", encoding="utf-8") as log,
        two_hosts() as (here, there),
    ):

        def note(line: str) -> None:
            print(line, file=log, flush=True)

        with (
            run_system(others, prefix=there, on_line=note) as receiving,
            run_system([source], prefix=here, on_line=note) as sending,
        ):
            deadline = time.monotonic() + _TIMEOUT
            while not sending.poll() and not receiving.poll() and time.monotonic() < deadline:
                time.sleep(0.1)
            codes = {**sending.stop(), **receiving.stop()}
        carried = _received_bytes(there)
    with BagReader(bag) as reader:
        found = [recorded.message for recorded in reader.messages([f"/{topics.LOCALIZATIONS}"])]
        poses = reader.counts[f"/{topics.POSE_6DOF}"]
    yield exactly("across machines: nodes that failed", sum(map(bool, codes.values())), 0)
    yield exactly(f"across machines: frames of {size} px at {rate:g}/s localized", len(found), cycles)
    yield exactly("across machines: poses", poses, cycles)
    expense = carried / (2 * size**2 * cycles)
    yield between("across machines: bytes on the wire for each of a frame", expense, 1, 2)
    transported = np.array([message.latency_frame_transport for message in found]) * 1e3
    for name, percent in (("median", 50), ("99 %", 99)):
        latency = float(np.percentile(transported, percent))
        yield information(f"across machines: {name} time of a frame on its way, ms", latency)


def _received_bytes(host: Sequence[str]) -> int:
    """By the interface of a host, since it came up."""
    command = (*host, "ip", "-json", "-stats", "link")
    links = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    return sum(link["stats64"]["rx"]["bytes"] for link in links if link["ifname"] != "lo")
