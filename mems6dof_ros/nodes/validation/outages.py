"""What becomes of a run when one of its nodes is killed, or hangs, as figures of `mems6dof validate lab`.

Each node in turn is killed (SIGKILL) in the middle of a live run at RATE and started again by the runner;
somebody beside them counts frames and poses.
"""

from __future__ import annotations

import contextlib
import math
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from mems6dof_msgs.msg import ControllerState, FrameInfo, Pose6DOF
from mems6dof_ros.analysis.simulated import calibrate_simulated
from mems6dof_ros.calibration.file import save_calibration
from mems6dof_ros.errors import Mems6dofError
from mems6dof_ros.figures import Figure, at_most, exactly, information
from mems6dof_ros.nodes import transport
from mems6dof_ros.nodes.closed_loop import PATIENT, data_sheet
from mems6dof_ros.nodes.loop_client import WATCHED, loop_client
from mems6dof_ros.nodes.runner import RunningSystem, run_system
from mems6dof_ros.nodes.system import NodeSpec, chain, commanded
from mems6dof_ros.recording import topics
from mems6dof_ros.recording.bag import BagReader
from mems6dof_ros.recording.recover import recover
from mems6dof_ros.simulation.settings import SimulationSettings

#: A gear that fits into a small field, so that the nodes are quick.
SMALL = {"width_px": 512, "height_px": 512, "gear_diameter": 60e-6, "hub_diameter": 8e-6, "particles": 30}
#: Motion cycles per second of the run.
RATE = 20.0
VICTIMS = ("localizer", "pose_estimator", "recorder", "monitor", "frame_source")
#: Seconds that a node hangs (SIGSTOP).
HANG = 8.0
_PATIENCE = 60.0  # s


@dataclass(frozen=True)
class _Seen:
    """A frame, or the pose of one: its counter, when it was heard, monotonic s, and whether it is valid."""

    counter: int
    at: float
    valid: bool = True


class Witness:
    """Hears of every frame and every pose."""

    def __init__(self, node: Node, check: Callable[[], None]) -> None:
        self.frames: list[_Seen] = []
        self.poses: list[_Seen] = []
        self._check = check
        valid = (Pose6DOF.STATUS_TRACKING, Pose6DOF.STATUS_DEGRADED)

        def on_frame(message: FrameInfo) -> None:
            self.frames.append(_Seen(message.frame_counter, time.monotonic()))

        def on_pose(message: Pose6DOF) -> None:
            self.poses.append(_Seen(message.frame_counter, time.monotonic(), message.status in valid))

        node.create_subscription(FrameInfo, topics.FRAME_INFO, on_frame, transport.MESSAGES)
        node.create_subscription(Pose6DOF, topics.POSE_6DOF, on_pose, transport.MESSAGES)

    def until(self, condition: Callable[[], Any], what: str) -> None:
        """Wait for ``condition``; Mems6dofError says that ``what`` did not come."""
        deadline = time.monotonic() + _PATIENCE
        while not condition():
            self._check()
            if time.monotonic() > deadline:
                raise Mems6dofError(f"no {what} within {_PATIENCE:g} s")
            time.sleep(0.01)


@contextlib.contextmanager
def witness(check: Callable[[], None] = lambda: None) -> Iterator[Witness]:
    """A Witness on this machine, with a thread of its own; ``check`` is called while it waits."""
    for name, value in transport.LOCALHOST_ONLY.items():
        os.environ.setdefault(name, value)
    transport.use_profile(frames=False)
    context = Context()
    rclpy.init(args=[], context=context, signal_handler_options=SignalHandlerOptions.NO)
    node = Node("witness", context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    ending = threading.Event()

    def spin() -> None:
        while not ending.is_set():
            executor.spin_once(timeout_sec=0.1)

    seen = Witness(node, check)
    thread = threading.Thread(target=spin, name="witness", daemon=True)
    thread.start()
    try:
        yield seen
    finally:
        ending.set()
        thread.join()
        executor.shutdown()
        node.destroy_node()
        rclpy.shutdown(context=context)


def figures(work: Path, seed: int, tell: Callable[[str], None]) -> Iterator[Figure]:
    """All figures."""
    settings = SimulationSettings(**SMALL, seed=seed, optics_seed=seed)  # type: ignore[arg-type]
    tell("calibrate simulated optics")
    calibration = work / "optics.yaml"
    save_calibration(calibrate_simulated(settings, beads=30).calibration, calibration)
    yield from outages(settings, calibration, work, tell)
    tell("kill controller")
    yield from controller_outage(settings, calibration, work)


def outages(
    settings: SimulationSettings,
    calibration: Path,
    work: Path,
    tell: Callable[[str], None] = lambda text: None,
    victims: Sequence[str] = VICTIMS,
) -> Iterator[Figure]:
    """Of one live run, in which the ``victims`` are killed, and pose_estimator hangs."""
    options = {f"simulator.{name}": value for name, value in settings.to_dict().items()}
    source = NodeSpec("frame_source", {"pacing": "rate", "rate": RATE, "simulator.loop": 40, **options})
    nodes = chain(
        source,
        calibration=str(calibration),
        output=str(work / "bag"),
        queue_policy="drop_oldest",
        monitor=NodeSpec("monitor", {"port": 0}),
    )
    nodes = [replace(node, respawn=True) for node in nodes]
    struck: dict[str, float] = {}
    with (
        (work / "outages.log").open("w", encoding="utf-8") as log,
        witness() as seen,
        run_system(nodes, on_line=lambda line: print(line, file=log, flush=True)) as system,
    ):
        seen.until(lambda: len(seen.poses) > RATE, "poses")
        for victim in victims:
            tell(f"kill {victim}")
            struck[victim] = time.monotonic()
            yield from _outage(seen, system, victim)
        tell("stop pose_estimator for a while")
        yield from _hang(seen, system)
        system.stop()
        time.sleep(0.5)  # until the last has been heard
    if "recorder" in victims:
        yield from _records(work / "bag", seen.poses, struck["recorder"])


def _outage(seen: Witness, system: RunningSystem, victim: str) -> Iterator[Figure]:
    poses, begin = len(seen.poses), time.monotonic()
    system.processes[victim].kill()
    seen.until(lambda: system.respawned[victim] == 1, f"new {victim}")
    measures = victim not in ("recorder", "monitor")
    if measures:
        seen.until(lambda: seen.poses[-1].at > begin + 1.5, "poses")
    settled = time.monotonic() + 4.0
    seen.until(lambda: time.monotonic() > settled, "end")
    after = [pose for pose in seen.poses[poses:] if not measures or pose.at > begin + 1.0]
    yield at_most(f"{victim} killed: cycles without a valid pose once poses return", _invalid(after), 1)
    silence = float(np.diff([pose.at for pose in seen.poses[poses - 1 :]]).max())
    yield information(f"{victim} killed: longest time without a pose, s", silence)
    if victim == "frame_source":
        yield from _begun_anew(seen, poses)
        return
    counters = [pose.counter for pose in seen.poses[poses - 1 :]]
    heard = {frame.counter for frame in seen.frames if counters[0] < frame.counter < counters[-1]}
    missing, told = len(heard - set(counters)), sum(np.diff(counters) - 1)
    yield exactly(f"{victim} killed: missing poses that frame_counter does not tell", missing - told, 0)
    if not measures:
        yield exactly(f"{victim} killed: frames without a pose", missing, 0)


def _begun_anew(seen: Witness, poses: int) -> Iterator[Figure]:
    """Of frames that count from 0 again after so many ``poses``."""
    last = seen.poses[poses - 1].counter
    first = next(k for k, frame in enumerate(seen.frames) if k and frame.counter < seen.frames[k - 1].counter)
    frames = seen.frames[first:]
    begin = next(k for k, pose in enumerate(seen.poses) if k >= poses and pose.counter < last)
    anew = seen.poses[begin:]
    valid = next((pose for pose in anew if pose.valid), None)
    late = valid.counter if valid else math.inf
    yield at_most(
        "frame_source killed: frames from its new first one to the first with a valid pose", late, 1
    )
    counters = {pose.counter for pose in anew}
    heard = {frame.counter for frame in frames if frame.counter <= max(counters)}
    yield exactly("frame_source killed: frames of the new one without a pose", len(heard - counters), 0)
    waited = (anew[0].at - frames[0].at) * RATE
    yield at_most("frame_source killed: from its new first frame to the first pose, cycles", waited, 1)


def _invalid(poses: Sequence[_Seen]) -> int:
    return next((k for k, pose in enumerate(poses) if pose.valid), len(poses))


def _hang(seen: Witness, system: RunningSystem) -> Iterator[Figure]:
    process = system.processes["pose_estimator"]
    process.send_signal(signal.SIGSTOP)
    resumes = time.monotonic() + HANG
    seen.until(lambda: time.monotonic() > resumes, "end of the hang")
    process.send_signal(signal.SIGCONT)
    newest = seen.frames[-1].counter
    seen.until(lambda: seen.poses[-1].counter >= newest, "pose after the hang")
    caught_up = time.monotonic() - resumes
    yield at_most(f"pose_estimator hung for {HANG:g} s: until the newest frame has its pose, s", caught_up, 2)
    gaps = [pose.counter for pose in seen.poses if pose.at > resumes]
    yield exactly("pose_estimator hung: nodes that ended", len(system.poll()), 0)
    yield at_most("pose_estimator hung: poses out of order afterwards", sum(np.diff(gaps) <= 0), 0)


def _records(bag: Path, poses: Sequence[_Seen], killed_at: float) -> Iterator[Figure]:
    """The bag of the recorder that was killed, recovered, and the one that went on beside it."""
    recover(bag)
    before = [pose.counter for pose in poses if pose.at < killed_at - 1 / RATE]
    recorded = _counters(bag)
    missing = len(set(before) - set(recorded))
    yield exactly("recorder killed: poses older than a cycle that are not in its bag", missing, 0)
    recorded = _counters(bag.with_name(f"{bag.name}_1"))
    after = [pose.counter for pose in poses if pose.at > killed_at]
    begin = after.index(recorded[0])
    lost = len(after) - begin - len(recorded)
    yield exactly("recorder killed: poses that the bag beside it lacks from its first on", lost, 0)


def _counters(bag: Path) -> list[int]:
    with BagReader(bag) as reader:
        return [recorded.message.frame_counter for recorded in reader.messages([f"/{topics.POSE_6DOF}"])]


def controller_outage(settings: SimulationSettings, calibration: Path, work: Path) -> Iterator[Figure]:
    """A controller killed in the middle of a motion: the drive comes to rest, the next one takes targets."""
    drive = data_sheet(settings)
    told = {f"drive.{name}": getattr(drive, name) for name in ("step", "scatter", "backlash")}
    controller = NodeSpec("controller", {**told, **PATIENT}, respawn=True)
    nodes = chain(
        commanded(**settings.to_dict()), calibration=str(calibration), controller=controller, watched=WATCHED
    )
    lines: list[str] = []
    with loop_client() as client, run_system(nodes, on_line=lines.append) as system:
        client.ready()
        cycles = client.cycles
        client.send(3.0)
        client.until(lambda: client.cycles >= cycles + 5, "motion")
        system.processes["controller"].kill()
        idle = "[controller] INFO idle"
        client.until(lambda: lines.count(idle) == 2, "new controller")
        rest = time.monotonic() + 2.0
        client.until(lambda: time.monotonic() > rest, "rest")
        before = client.cycles
        rest = time.monotonic() + 1.0
        client.until(lambda: time.monotonic() > rest, "rest")
        yield exactly("controller killed: motion cycles without one", client.cycles - before, 0)
        target = client.received[topics.POSE_6DOF][-1].psi + 0.5
        state = client.go(target)
        arrived = state.state == ControllerState.STATE_ARRIVED
        (work / "controller.log").write_text("\n".join(lines), encoding="utf-8")
        yield exactly("controller killed: next target reached by the new one", arrived, 1)
