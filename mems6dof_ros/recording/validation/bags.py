"""Bags that other tools have written, opened and replayed, as figures of `mems6dof validate lab`."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from mcap_ros2.writer import Writer as McapRos2Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as RosbagsWriter

from mems6dof_ros.analysis.check import check_bag
from mems6dof_ros.analysis.recording import load_recording
from mems6dof_ros.calibration.file import load_calibration
from mems6dof_ros.errors import Mems6dofError
from mems6dof_ros.figures import Figure, at_least, at_most, exactly
from mems6dof_ros.frame import Frame
from mems6dof_ros.localization.localizer import Localizer
from mems6dof_ros.nodes.runner import run_system
from mems6dof_ros.nodes.system import NodeSpec, chain, replayed
from mems6dof_ros.nodes.validation.hostile import calibrate_quickly
from mems6dof_ros.pose.estimator import PoseEstimator
from mems6dof_ros.recording import messages, topics
from mems6dof_ros.recording.bag import BagWriter
from mems6dof_ros.recording.definitions import definition, typestore
from mems6dof_ros.recording.frames import camera_to_json
from mems6dof_ros.recording.messages import Message
from mems6dof_ros.simulation.experiment import motion_frames
from mems6dof_ros.simulation.settings import SimulationSettings
from mems6dof_ros.sources.bag import BagSource
from mems6dof_ros.sources.simulator import camera_noise
from mems6dof_ros.sources.source import frames as frames_of

#: A gear that fits into a small field.
SMALL = {"width_px": 512, "height_px": 512, "gear_diameter": 60e-6, "hub_diameter": 8e-6, "particles": 30}
#: Numerical noise of the same computation in another process, m and rad.
SAME = 1e-12

IMAGES = f"/camera/{topics.IMAGE}"


def figures(work: Path, seed: int, tell: Callable[[str], None], cycles: int = 24) -> Iterator[Figure]:
    """All figures, for ``cycles`` frames of a small gear, of which the poses are known by function calls."""
    settings = SimulationSettings.from_dict({**SMALL, "seed": seed, "optics_seed": seed})
    tell("calibrate simulated optics")
    calibration = work / "optics.yaml"
    calibrate_quickly(settings, calibration)
    optics = load_calibration(calibration)
    frames = list(motion_frames(settings, cycles))
    localizer, estimator = Localizer(optics.camera, optics), PoseEstimator()
    poses = [estimator.update(localizer.localize(frame)) for frame in frames]
    expected = {pose.stamp_ns: pose for pose in poses if pose.valid}
    yield at_least("bags of others: valid poses by function calls", len(expected), cycles - 6)
    for name, write in WRITERS.items():
        tell(f"replay a bag written by {name}")
        path = write(work / name.replace(" ", "_"), frames)
        read = list(frames_of(BagSource(path)))
        same = sum(
            a.stamp_ns == b.stamp_ns and np.array_equal(a.image, b.image)
            for a, b in zip(read, frames, strict=False)
        )
        yield exactly(f"{name}: frames read with their stamps and pixels", same, cycles)
        yield exactly(f"{name}: problems that check names", len(check_bag(path).problems), 0)
        output = work / f"{path.stem}_replayed"
        nodes = chain(replayed(str(path)), calibration=str(calibration), output=str(output))
        namespace = "".join(filter(str.isalnum, name))
        lines: list[str] = []
        with run_system(nodes, namespace=namespace, on_line=lines.append) as system:
            system.wait("frame_source", timeout=300.0)
            if any(system.stop().values()):
                raise Mems6dofError(f"replay of {path}: {' '.join(lines[-5:])}")
        ((_, found),) = load_recording(output).poses.items()
        valid = {pose.stamp_ns: pose for pose in found if pose.valid}
        yield exactly(f"{name}: valid poses of its replay", len(valid), len(expected))
        apart = [abs(valid[s].displacement - expected[s].displacement).max() for s in valid.keys() & expected]
        yield at_most(f"{name}: greatest departure from function calls, m or rad", max(apart), SAME)


def with_camera(nodes: Sequence[NodeSpec], settings: SimulationSettings) -> list[NodeSpec]:
    """Nodes whose localizer knows the simulated camera, in place of a calibration."""
    known = json.loads(camera_to_json(camera_noise(settings)))
    camera = {f"camera.{name}": float(value) for name, value in known.items()}
    return [
        replace(node, parameters={**node.parameters, **camera}) if node.executable == "localizer" else node
        for node in nodes
    ]


def write_ours(path: Path, frames: Sequence[Frame], **options: Any) -> Path:
    """A bag of BagWriter, with all that belongs to a frame."""
    with BagWriter(path, **options) as bag:
        for frame in frames:
            bag.write_message(f"/camera/{topics.FRAME_INFO}", messages.frame_info(frame), frame.stamp_ns)
            bag.write_message(IMAGES, messages.image(frame), frame.stamp_ns)
            bag.flush()
    return path


def write_rosbags(path: Path, frames: Sequence[Frame], storage: StoragePlugin) -> Path:
    """A rosbag2 directory by `rosbags`: images only."""
    with RosbagsWriter(path, version=9, storage_plugin=storage) as writer:
        connection = writer.add_connection(IMAGES, "sensor_msgs/msg/Image", typestore=typestore())
        for frame in frames:
            writer.write(connection, frame.stamp_ns, messages.serialize(messages.image(frame)))
    return path


def write_mcap_ros2(path: Path, frames: Sequence[Frame]) -> Path:
    """A single file by `mcap-ros2-support`: images only."""
    path = path.with_suffix(".mcap")
    with path.open("wb") as stream:
        writer = McapRos2Writer(stream)
        kind = "sensor_msgs/msg/Image"
        schema = writer.register_msgdef(kind, definition(kind).schema)
        for frame in frames:
            writer.write_message(IMAGES, schema, _plain(messages.image(frame)), log_time=frame.stamp_ns)
        writer.finish()
    return path


#: By whom, and how.
WRITERS: Mapping[str, Callable[[Path, Sequence[Frame]], Path]] = {
    "rosbags sqlite3": lambda path, frames: write_rosbags(path, frames, StoragePlugin.SQLITE3),
    "rosbags MCAP": lambda path, frames: write_rosbags(path, frames, StoragePlugin.MCAP),
    "mcap-ros2-support": write_mcap_ros2,
    "mems6dof, split": lambda path, frames: write_ours(path, frames, split_size=2_000_000),
}


def _plain(message: Message) -> dict[str, Any]:
    """As `mcap_ros2` takes it: names and values."""
    return {
        name: _plain(value)
        if isinstance(value, Message)
        else bytes(value)
        if isinstance(value, np.ndarray)
        else value
        for name, value in message.fields.items()
    }
