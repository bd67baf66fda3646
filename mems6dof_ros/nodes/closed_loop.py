"""The closed loop as it runs: the nodes as processes, a client beside them, and what they are put through."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mems6dof_msgs.msg import ControllerState
from mems6dof_ros.control.controller import State
from mems6dof_ros.control.position import DriveSettings
from mems6dof_ros.control.validation import Move
from mems6dof_ros.errors import Mems6dofError
from mems6dof_ros.nodes.loop_client import WATCHED, LoopClient, loop_client, psi_truth
from mems6dof_ros.nodes.runner import RunningSystem, run_system
from mems6dof_ros.nodes.system import NodeSpec, chain, commanded
from mems6dof_ros.recording import topics
from mems6dof_ros.recording.messages import nanoseconds
from mems6dof_ros.simulation.settings import SimulationSettings

#: Deadlines for a machine that renders, measures and controls at once, perhaps with other work.
PATIENT = {"max_pose_age": 10.0, "pose_timeout": 10.0, "acknowledge_timeout": 10.0, "command_lifetime": 10.0}


def data_sheet(settings: SimulationSettings) -> DriveSettings:
    """What would be known of the simulated drive: its nominal numbers, not its own errors."""
    return DriveSettings(
        step=abs(settings.step), scatter=max(settings.step_jitter, 1e-9), backlash=settings.backlash
    )


@contextlib.contextmanager
def closed_loop(
    settings: SimulationSettings,
    calibration: Path,
    log: Path,
    bag: str = "",
    on_page: Callable[[str], None] | None = None,
    **limits: Any,
) -> Iterator[tuple[LoopClient, RunningSystem]]:
    """The nodes, ready, with a client; ``log`` gets what they print, ``bag`` what they publish but for the
    images, ``on_page`` the address of a live page. ``limits``: parameters of the controller. Raises
    Mems6dofError where a node fails by itself."""
    drive = data_sheet(settings)
    told = {f"drive.{name}": getattr(drive, name) for name in ("step", "scatter", "backlash")}
    nodes = chain(
        commanded(**settings.to_dict()),
        calibration=str(calibration),
        output=bag,
        controller=NodeSpec("controller", {**told, **PATIENT, **limits}),
        watched=WATCHED,
        monitor=NodeSpec("monitor", {"port": 0}) if on_page else None,
    )
    systems: list[RunningSystem] = []

    def check() -> None:
        failed = {name: code for name, code in systems[0].poll().items() if code > 0}
        if failed:
            tail = "\n".join(log.read_text(encoding="utf-8").splitlines()[-5:])
            raise Mems6dofError(f"nodes failed: {failed}; see {log}, which ends:\n{tail}")

    with log.open("w", encoding="utf-8") as lines:

        def on_line(line: str) -> None:
            print(line, file=lines, flush=True)
            if on_page and line.startswith("[monitor] live page:"):
                on_page(line.rsplit(" ", 1)[-1])

        with loop_client(check) as client, run_system(nodes, on_line=on_line) as system:
            systems.append(system)
            client.ready(listeners=2 if bag else 1)  # the recorder listens too
            yield client, system


def approach(
    client: LoopClient,
    settings: SimulationSettings,
    targets: Sequence[float],
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[Move]:
    """Go to ``targets`` rad, one after another."""
    moves, psi = [], 0.0
    for k, target in enumerate(targets, 1):
        distance = abs(target - psi)
        state = client.go(target)
        if state.state == ControllerState.STATE_ARRIVED:
            psi = float(psi_truth(client, [state.header.stamp])[0])
        fewest = int(np.ceil(distance / abs(settings.step)))
        moves.append(Move(target, psi - target, state.cycles, fewest, State(state.state), state.reason))
        progress(k, len(targets))
    return moves


def safe_stops(settings: SimulationSettings, calibration: Path, log: Path) -> Iterator[tuple[str, int, str]]:
    """What is lost in the middle of a motion, the motion cycles whose frames were exposed after that, and the
    reason that the controller gives."""
    with closed_loop(settings, calibration, log, pose_timeout=5.0) as (client, system):
        yield (
            "view: lens covered",
            *_interrupted(client, lambda: client.call("frame_source/cover", True), since=_first_dark),
        )
        client.call("frame_source/cover", False)
        yield "drive: disabled", *_interrupted(client, lambda: client.call("actuation_enable", False))
        client.call("actuation_enable", True)
        yield "node: localizer killed", *_interrupted(client, system.processes["localizer"].kill)
    with closed_loop(settings, calibration, log) as (client, system):
        kill = system.processes["controller"].kill
        yield "node: controller killed", *_interrupted(client, kill, rests=False)


def _interrupted(
    client: LoopClient,
    strike: Callable[[], None],
    since: Callable[[LoopClient, int], int] = lambda client, struck_ns: struck_ns,
    rests: bool = True,
) -> tuple[int, str]:
    """Cycles exposed after the time ``since``, by default of ``strike``, and the controller's reason."""
    start, states = client.cycles, len(client.states)
    here = client.states[-1].target if client.states else 0.0
    client.send(here + 3.0)
    client.until(lambda: len(client.states) > states, "command")
    client.until(lambda: client.cycles >= start + 5 or client.states[-1].reason, "motion")
    if client.states[-1].reason:
        raise Mems6dofError(f"closed loop: stopped before it was interrupted: {client.states[-1].reason}")
    strike()
    struck_ns = time.time_ns()
    reason = "-"
    if rests:
        state = client.rest(states)
        if state.state != ControllerState.STATE_STOPPED:
            raise Mems6dofError("closed loop: the controller went on")
        reason = state.reason
    quiet_until = time.monotonic() + 1.0
    client.until(lambda: time.monotonic() > quiet_until, "second")
    begun_ns = since(client, struck_ns)
    exposed = [nanoseconds(truth.header.stamp) for truth in client.received[topics.TRUTH]]
    return sum(stamp > begun_ns for stamp in exposed), reason


def _first_dark(client: LoopClient, struck_ns: int) -> int:
    """Stamp, ns, of the first frame without light."""
    return next(
        nanoseconds(truth.header.stamp) for truth in client.received[topics.TRUTH] if not any(truth.electrons)
    )
