"""What comes of cameras through the nodes: counted on the wire, unplugged, and measured; for
`mems6dof validate cameras`."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
from sensor_msgs.msg import Image
from std_srvs.srv import Trigger

from mems6dof_msgs.msg import FrameInfo, GroundTruth, Localizations, Pose6DOF
from mems6dof_ros.figures import Figure, exactly, figure, information
from mems6dof_ros.nodes import transport
from mems6dof_ros.nodes.system import NodeSpec, chain
from mems6dof_ros.nodes.validation.bystander import Bystander, running
from mems6dof_ros.nodes.validation.hostile import calibrate_quickly
from mems6dof_ros.recording import messages, topics
from mems6dof_ros.simulation.experiment import motion_frames
from mems6dof_ros.simulation.settings import SimulationSettings
from mems6dof_ros.sources.cameras.emulation import GigeEmulator, WireCounter, basler_emulator

#: Images of a gear that turns on and back, over and over: motion cycles from one turning point to the other.
_SWING = 8


class _Watched:
    """What a frame_source publishes, as heard by somebody else."""

    def __init__(self, bystander: Bystander) -> None:
        self.infos: list[FrameInfo] = []
        self.images = 0
        bystander.listen(FrameInfo, topics.FRAME_INFO, self.infos.append)
        bystander.listen(Image, topics.IMAGE, self._on_image, transport.FRAMES, raw=True)

    def _on_image(self, data: bytes) -> None:
        self.images += 1

    @property
    def stamps(self) -> list[int]:
        return [messages.nanoseconds(info.header.stamp) for info in self.infos]

    @property
    def lost(self) -> int:
        return sum(info.frames_dropped for info in self.infos)


def gige(seconds: float, size: int, rate: float) -> Iterator[Figure]:
    """frame_source with the GigE Vision camera: every frame is accounted for; unplugged it comes back."""
    source = NodeSpec(
        "frame_source",
        {
            "source": "genicam",
            "genicam.region": [0, 0, size, size],
            "genicam.pixel_format": "Mono16",
            "genicam.frame_rate": rate,
            "genicam.exposure": 0.01,
            "genicam.timestamp_at": "end",
            "genicam.packet_size": 9000,
        },
    )
    with tempfile.TemporaryDirectory() as folder, WireCounter() as wire, GigeEmulator() as emulator:
        source.parameters["genicam.device"] = emulator.device  # type: ignore[index]
        with running([source], Path(folder, "log")) as (_, bystander):
            watched = _Watched(bystander)
            bystander.until(lambda: watched.infos, "frame")
            time.sleep(seconds)
            emulator.kill()
            counted = bystander.counts_settled("frame_source")["frame_source"]
            frames, produced, reported = len(watched.infos), wire.produced, counted["camera frames lost"]
            began, ended = watched.stamps[0], watched.stamps[-1]
            emulator.start()
            restarted = time.monotonic()
            bystander.until(lambda: len(watched.infos) > frames, "frame after the restart")
            resumed = time.monotonic() - restarted
            bystander.until(lambda: len(watched.infos) > frames + 40, "frames after the restart")
            outage = watched.infos[frames]
            counted = bystander.counts_settled("frame_source")["frame_source"]
    yield information("frames produced, as counted on the wire", produced)
    yield information("frames per second", (frames - 1) / ((ended - began) * 1e-9))
    yield information("reported lost", reported)
    yield exactly("produced - published - reported lost", produced - frames - reported, 0)
    yield information("images that this listener was too slow for", len(watched.infos) - watched.images)
    yield exactly("stamps that do not ascend", sum(b <= a for a, b in pairwise(watched.stamps)), 0)
    yield figure("unplugged: from its restart to the next frame, s", resumed, "< 10", resumed < 10)
    dropped = outage.frames_dropped
    yield figure("unplugged: frames reported lost with that frame", dropped, "> 0", dropped > 0)
    yield exactly("unplugged: reconnects in the diagnostics", counted["camera reconnects"], 1)


def poses(seconds: float, size: int, rate: float) -> Iterator[Figure]:
    """The whole chain behind a Basler camera that sees a simulated gear."""
    gear = {} if size >= 1024 else {"gear_diameter": size * 1.17e-7, "hub_diameter": 8e-6, "particles": 30}
    settings = SimulationSettings(width_px=size, height_px=size, **gear)  # type: ignore[arg-type]
    there = list(motion_frames(settings, _SWING))
    seen = there + there[-2:0:-1]
    with tempfile.TemporaryDirectory() as folder:
        calibration = Path(folder, "optics.yaml")
        calibrate_quickly(settings, calibration)
        shown = Path(folder, "images")
        shown.mkdir()
        with basler_emulator(shown, [frame.image for frame in seen]) as options:  # type: ignore[misc]
            camera = {f"basler.{name}": value for name, value in options.items()}
            source = NodeSpec(
                "frame_source",
                {
                    "source": "basler",
                    "pacing": "rate",
                    **{k: list(v) if isinstance(v, tuple) else v for k, v in camera.items()},
                    "basler.frame_rate": rate,
                    "basler.exposure": 1e-3,
                },
            )
            nodes = chain(
                source,
                calibration=str(calibration),
                queue_policy="drop_oldest",
                watched=dict.fromkeys(
                    (topics.POSE_6DOF, topics.LOCALIZATIONS, topics.FRAME_INFO), "bystander"
                ),
            )
            with running(nodes, Path(folder, "log")) as (_, bystander):
                watched = _Watched(bystander)
                measured: list[Pose6DOF] = []
                localized: list[Localizations] = []
                bystander.listen(Pose6DOF, topics.POSE_6DOF, measured.append)
                bystander.listen(Localizations, topics.LOCALIZATIONS, localized.append)
                bystander.until(lambda: measured, "pose")
                time.sleep(seconds)
                # Only a later frame tells of those lost before it; this one comes to nodes that wait for it.
                bystander.call(Trigger, "frame_source/stop")
                bystander.counts_settled("localizer", "pose_estimator")
                heard = len(watched.infos)
                bystander.call(Trigger, "frame_source/step")
                bystander.until(lambda: len(watched.infos) > heard, "last frame")
                last = watched.infos[-1].frame_counter
                bystander.until(lambda: measured[-1].frame_counter == last, "last pose")
                counted = bystander.counts_settled("frame_source", "localizer", "pose_estimator")
    valid = [pose for pose in measured if pose.status in (Pose6DOF.STATUS_TRACKING, Pose6DOF.STATUS_DEGRADED)]
    infos = watched.infos
    produced = infos[-1].frame_counter - infos[0].frame_counter + 1
    lost = sum(info.frames_dropped for info in infos[1:])
    errors = _errors(valid, [frame.truth[0] for frame in seen])
    begin, end = localized[0].frame_counter, localized[-1].frame_counter
    dropped = sum(found.frames_dropped for found in localized[1:])
    # The estimator cannot tell a lost message from the losses that this message told of: it may count more.
    unposed = {found.frame_counter for found in localized} - {pose.frame_counter for pose in measured}
    untold = max(len(unposed) - counted["pose_estimator"].get("lost", 0), 0)
    duration = (watched.stamps[-1] - watched.stamps[0]) * 1e-9
    yield information("frames produced, by the camera's counter", produced)
    yield information("frames per second", (len(infos) - 1) / duration)
    yield exactly("produced - published - reported lost", produced - len(infos) - lost, 0)
    yield exactly("stamps that do not ascend", sum(b <= a for a, b in pairwise(watched.stamps)), 0)
    yield information("frames lost by the source or before the localizer", dropped)
    yield exactly("produced - localized - of these", end - begin + 1 - len(localized) - dropped, 0)
    yield information("localizations without a pose", len(unposed))
    yield exactly("localizations without a pose that nobody counted", untold, 0)
    yield information("poses per second", len(measured) / duration)
    yield exactly("poses that are not valid", len(measured) - len(valid), 0)
    yield figure("psi against truth, rms, rad", errors, "< 1e-4", errors < 1e-4)


def _errors(measured: list[Pose6DOF], truths: list[GroundTruth]) -> float:
    """Rms departure of psi from that of the image shown, rad; which of them came first is not known."""
    psi = np.array([pose.psi for pose in measured])
    count = np.array([pose.frame_counter for pose in measured])
    true = np.array([truth.psi for truth in truths])
    best = np.inf
    for first in range(len(true)):
        expected = true[(first + count) % len(true)]
        off = np.angle(np.exp(1j * (psi - expected)))
        best = min(best, float(np.std(off)))
    return best
