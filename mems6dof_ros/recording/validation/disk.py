"""The record while the disk is full, slow, or as it should be, as figures of `mems6dof validate lab`."""

from __future__ import annotations

import contextlib
import os
import subprocess
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus

from mems6dof_msgs.msg import Pose6DOF
from mems6dof_ros.analysis.check import check_bag
from mems6dof_ros.analysis.recording import load_recording
from mems6dof_ros.errors import Mems6dofError
from mems6dof_ros.figures import Figure, at_least, exactly, information, remark
from mems6dof_ros.nodes.recorder import DEFAULT_TOPICS
from mems6dof_ros.nodes.runner import run_system
from mems6dof_ros.nodes.system import NodeSpec, chain
from mems6dof_ros.nodes.validation.bystander import Bystander
from mems6dof_ros.recording import topics
from mems6dof_ros.recording.bag import BagReader
from mems6dof_ros.recording.validation.bags import SMALL, with_camera
from mems6dof_ros.recording.validation.processes import witnessed_recorder
from mems6dof_ros.simulation.settings import SimulationSettings

#: Of the disk that is filled, and what the recorder must leave of it, MiB.
DISK, RESERVE = 48, 8
#: Bytes per second of the slow disk; the recorder is given far more.
SLOW = 2e6
RATE = 20.0  # Hz, at which a machine that does other things too measures small frames
SECONDS = 10.0  # that are counted before and after


def figures(work: Path, seed: int, tell: Callable[[str], None], seconds: float = SECONDS) -> Iterator[Figure]:
    """All figures; a machine that lets nobody mount a disk has one row less, and says so."""
    tell("a disk that becomes full")
    try:
        with small_disk(work / "disk") as disk:
            yield from full(disk, seed, seconds)
    except PermissionError as reason:
        yield remark(f"full disk: not measured, {reason}")
    tell("a disk that is too slow")
    yield from slow(work / "slow", seed, seconds)
    tell("a recorder beside a run")
    yield from beside(work / "beside", seed, seconds)


def full(disk: Path, seed: int, seconds: float) -> Iterator[Figure]:
    """The instrument runs on while its recorder fills ``disk`` with frames."""
    with _instrument(seed, disk / "bag", minimum_free_mebibytes=RESERVE) as watch:
        before = watch.rate(seconds / 2)
        watch.until(lambda: watch.alarms, "recording stopped by a full disk")
        after = watch.rate(seconds)
        alarms, gaps = list(watch.alarms), watch.gaps
    yield at_least("full disk: pose rate after, of that before", after / before, 0.97)
    yield exactly("full disk: poses missing", gaps, 0)
    yield at_least("full disk: seconds that the diagnostics say so at level ERROR", len(alarms), seconds - 2)
    yield exactly("full disk: nodes that failed", watch.failed, 0)
    yield from _valid("full disk", disk / "bag")
    left = os.statvfs(disk).f_bavail * os.statvfs(disk).f_frsize / 2**20
    yield at_least("full disk: MiB left on it, of 8 reserved", left, RESERVE - 2)


def slow(work: Path, seed: int, seconds: float) -> Iterator[Figure]:
    """A recorder that writes SLOW bytes per second is given more, and drops the oldest, counted."""
    work.mkdir(parents=True)
    with _instrument(seed, None) as watch:
        before = watch.rate(seconds / 2)
        options = {"queue_mebibytes": 4, "split_duration": 2.0}
        with witnessed_recorder(watch.namespace, work / "bag", work / "journal", SLOW, **options):
            watch.until(lambda: watch.total("recorder", "lost"), "loss of the recorder")
            during = watch.rate(seconds)
            warned = watch.warnings
            answer = watch.stop_recording()
            counts = watch.counts_settled("recorder")["recorder"]
        gaps = watch.gaps
    with BagReader(work / "bag") as bag:
        written = sum(bag.counts.values())
    yield at_least("slow disk: pose rate meanwhile, of that before", during / before, 0.97)
    yield exactly("slow disk: poses missing", gaps, 0)
    yield at_least("slow disk: seconds that the diagnostics say so", warned, seconds / 2)
    yield information("slow disk: messages received", counts["messages"])
    yield information("slow disk: messages lost, counted", counts["lost"])
    yield exactly(
        "slow disk: received, neither written nor counted", counts["messages"] - written - counts["lost"], 0
    )
    yield exactly("slow disk: ~/stop refused", not answer.success, 0)
    problems = [problem for problem in check_bag(work / "bag").problems if "announced" in problem]
    yield exactly("slow disk: counts that contradict the files", len(problems), 0)


def beside(work: Path, seed: int, seconds: float) -> Iterator[Figure]:
    """A recorder of everything, frames too, beside a run to its end, in files of half a second."""
    cycles = round(RATE * seconds)
    paced = {"pacing": "consumer", "acknowledged_by": topics.POSE_6DOF, "simulator.cycles": cycles}
    source = NodeSpec("frame_source", {**_simulated(seed), **paced}, ends_system=True)
    recorded = [*DEFAULT_TOPICS, topics.IMAGE]
    nodes = chain(source, calibration="", output=str(work / "bag"), recorded=recorded)
    nodes = [_with(node, "recorder", split_duration=0.5) for node in with_camera(nodes, _settings(seed))]
    work.mkdir(parents=True)
    with run_system(nodes, namespace=f"disk_{os.getpid()}", on_line=lambda line: None) as system:
        system.wait("frame_source", timeout=300.0)
        codes = system.stop()
    recording = load_recording(work / "bag")
    files = len(list((work / "bag").glob("*.mcap")))
    yield exactly("beside a run: nodes that failed", sum(map(bool, codes.values())), 0)
    yield exactly("beside a run: frames recorded", recording.frames, cycles)
    yield exactly("beside a run: poses recorded", sum(map(len, recording.poses.values())), cycles)
    yield at_least("beside a run: files of half a second", files, 2)
    yield exactly("beside a run: problems that check names", len(check_bag(work / "bag").problems), 0)


@contextlib.contextmanager
def small_disk(path: Path, mebibytes: int = DISK) -> Iterator[Path]:
    """A disk in memory; PermissionError where nobody may mount one."""
    path.mkdir(parents=True, exist_ok=True)
    command = ["mount", "-t", "tmpfs", "-o", f"size={mebibytes}m", "tmpfs", str(path)]
    try:
        subprocess.run(command, check=True, capture_output=True, text=True)
    except (OSError, subprocess.CalledProcessError) as error:
        raise PermissionError(f"a disk of one's own needs root: {error}") from None
    try:
        yield path
    finally:
        subprocess.run(["umount", "--lazy", str(path)], check=True)


class _Watch(Bystander):
    """Who counts the poses and reads the diagnostics."""

    def __init__(self, namespace: str) -> None:
        super().__init__(namespace)
        self.alarms: list[str] = []  # of the recorder, level ERROR
        self.warnings = 0  # of it, level WARN, about the disk
        self.failed = 0  # nodes, at the end
        self._cycles: list[int] = []
        self._recent: list[float] = []
        self.listen(Pose6DOF, topics.POSE_6DOF, self._on_pose)
        self.listen(DiagnosticArray, "/diagnostics", self._on_alarm)

    def _on_pose(self, pose: Any) -> None:
        self._cycles.append(pose.cycle)
        self._recent.append(time.monotonic())

    def _on_alarm(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name == f"{self.namespace}/recorder":
                if status.level == DiagnosticStatus.ERROR:
                    self.alarms.append(status.message)
                self.warnings += status.level == DiagnosticStatus.WARN and "disk" in status.message

    @property
    def gaps(self) -> int:
        """Cycles without a pose between the first and the last."""
        return self._cycles[-1] - self._cycles[0] + 1 - len(self._cycles)

    def rate(self, seconds: float) -> float:
        """Poses per second from now on."""
        self.until(lambda: self._recent, "pose")
        first = len(self._recent)
        time.sleep(seconds)
        times = self._recent[first:]
        return (len(times) - 1) / (times[-1] - times[0])

    def total(self, node: str, what: str) -> int:
        """Of its last diagnostics."""
        return int(self.diagnostics.get(node, {}).get(what, 0))

    def stop_recording(self) -> Any:
        """The answer of the recorder, when it has written what waits."""
        from std_srvs.srv import Trigger

        client = self.node.create_client(Trigger, "recorder/stop")
        self.until(client.service_is_ready, "recorder")
        answer = client.call_async(Trigger.Request())
        self.until(answer.done, "answer of the recorder")
        return answer.result()


@contextlib.contextmanager
def _instrument(seed: int, output: Path | None, **of_recorder: Any) -> Iterator[_Watch]:
    """The chain at RATE with a small gear, watched; where there is an output, with a recorder of all."""
    source = NodeSpec("frame_source", {**_simulated(seed), "pacing": "rate", "rate": RATE})
    nodes = chain(
        source,
        calibration="",
        output=str(output or ""),
        recorded=[*DEFAULT_TOPICS, topics.IMAGE],
        watched={topics.POSE_6DOF: "bystander"},
    )
    nodes = [_with(node, "recorder", **of_recorder) for node in with_camera(nodes, _settings(seed))]
    namespace = f"disk_{os.getpid()}"
    watch, lines = _Watch(namespace), list[str]()
    with watch, run_system(nodes, namespace=namespace, on_line=lines.append) as system:

        def check() -> None:
            if ended := system.poll():
                raise Mems6dofError(f"{', '.join(ended)} ended: {' '.join(lines[-2:])}")

        watch.check = check
        yield watch
        watch.check = lambda: None
        watch.failed = sum(map(bool, system.stop().values()))


def _settings(seed: int) -> SimulationSettings:
    return SimulationSettings.from_dict({**SMALL, "seed": seed})


def _simulated(seed: int) -> dict[str, Any]:
    """Parameters of a source that can deliver at any rate."""
    settings = {f"simulator.{name}": value for name, value in {**SMALL, "seed": seed}.items()}
    return {"source": "simulator", "simulator.loop": 16, **settings}


def _with(node: NodeSpec, executable: str, **parameters: Any) -> NodeSpec:
    if node.executable != executable:
        return node
    return replace(node, parameters={**node.parameters, **parameters})


def _valid(name: str, bag: Path) -> Iterator[Figure]:
    """All that was written can be read, and is complete but for the end."""
    found = check_bag(bag)
    poses = next(count for topic, (_, count) in found.topics.items() if topic.endswith(topics.POSE_6DOF))
    yield at_least(f"{name}: poses in the bag", poses, 10)
    torn = [p for p in found.problems if "missing for" not in p and "does not know" not in p]
    yield exactly(f"{name}: problems that check names, the last cycle apart", len(torn), 0)
