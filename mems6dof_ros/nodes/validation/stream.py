"""What the stream must show: frames through processes to a record, read by others, replayed alike."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader

from mems6dof_ros.analysis.analyze import analyze
from mems6dof_ros.analysis.recording import Recording, load_recording
from mems6dof_ros.analysis.truth import compare
from mems6dof_ros.calibration.file import load_calibration
from mems6dof_ros.cli.demo import BODY, REQUIREMENTS, measure, prepare
from mems6dof_ros.figures import Figure, at_most, exactly
from mems6dof_ros.localization.localizer import Localizer
from mems6dof_ros.localization.validation import matched_fits
from mems6dof_ros.nodes.runner import run_system
from mems6dof_ros.nodes.system import chain, replayed
from mems6dof_ros.nodes.validation.bodies import bodies_figures
from mems6dof_ros.pose.estimator import PoseEstimator
from mems6dof_ros.simulation.settings import SimulationSettings
from mems6dof_ros.sources.source import open_source

#: Numerical noise of the same computation in another process, of m and of rad.
SAME = 1e-12


def figures(settings: SimulationSettings, cycles: int, out: Path) -> list[Figure]:
    """All figures; works in ``out``, which becomes the directory of a demonstration."""
    calibration = prepare(settings, out)
    bag = measure(settings, cycles, calibration, out)
    recording = load_recording(bag)
    return [
        *_poses(recording, cycles),
        *_record(bag, recording),
        *_replay(bag, calibration, out),
        *bodies_figures(settings, calibration, out),
        *matched_fits(10_000, 1),
    ]


def _poses(recording: Recording, cycles: int) -> list[Figure]:
    """The demonstration against its truth."""
    poses = [pose for pose in recording.poses[BODY] if pose.valid]
    comparison = compare(poses, recording.truth_of(poses))
    rows = [
        exactly("four processes: frames published", recording.frames, cycles),
        exactly("four processes: valid poses", len(poses), cycles),
        exactly("four processes: frames lost", recording.frames - len(recording.poses[BODY]), 0),
        exactly("four processes: poses with their truth", len(comparison.cycle), cycles),
    ]
    for name, error, _ in comparison.table():
        need = REQUIREMENTS[name]
        rows.append(at_most(f"rms error {name}, {need.unit}", error * need.scale, need.limit * need.scale))
    return rows


def _record(bag: Path, recording: Recording) -> list[Figure]:
    """The bag by readers that are not ours, with the types that it carries itself."""
    with AnyReader([bag]) as reader:
        announced = reader.message_count
        stamps, unstamped = set(recording.localizations), 0
        decoded = 0
        for connection, _, data in reader.messages():
            header = getattr(reader.deserialize(data, connection.msgtype), "header", None)
            decoded += 1
            if header is None or connection.msgtype.startswith("diagnostic_msgs"):
                continue
            stamp = header.stamp.sec * 10**9 + header.stamp.nanosec
            unstamped += stamp not in stamps or not header.frame_id
    rows = [
        exactly("bag: messages decoded by rosbags", decoded, announced),
        exactly("bag: headers without a frame's stamp and frame id", unstamped, 0),
    ]
    count = incomplete = 0
    for file in sorted(bag.glob("*.mcap")):
        with file.open("rb") as stream:
            mcap = make_reader(stream, decoder_factories=[DecoderFactory()])
            count += sum(1 for _ in mcap.iter_decoded_messages())
            summary = mcap.get_summary()
            assert summary is not None  # the writer completes its files
            for channel in summary.channels.values():
                schema, metadata = summary.schemas[channel.schema_id], channel.metadata
                complete = (
                    schema.encoding == "ros2msg"
                    and len(schema.data) > 0
                    and metadata.get("offered_qos_profiles")
                    and metadata.get("topic_type_hash", "").startswith("RIHS01_")
                )
                incomplete += 0 if complete else 1
    rows.append(exactly("bag: messages decoded by mcap with mcap-ros2-support", count, announced))
    rows.append(exactly("bag: channels without schema, QoS or type hash", incomplete, 0))
    return rows


def _replay(bag: Path, calibration: Path, out: Path) -> list[Figure]:
    """Two instruments, in two namespaces of one domain, replay the bag at once; against ``analyze``."""
    optics = load_calibration(calibration)
    offline = analyze(
        open_source("bag", path=str(bag)),
        Localizer(optics.camera, optics),
        [PoseEstimator(body=BODY)],
        out / "offline",
    )
    expected = {pose.stamp_ns: pose.displacement for pose in offline.poses if pose.valid}
    names = ("left", "right")
    systems = {
        name: chain(replayed(str(bag)), calibration=str(calibration), output=str(out / name))
        for name in names
    }
    with (
        (out / "replay.log").open("w", encoding="utf-8") as log,
        run_system(systems["left"], namespace="left", on_line=lambda line: print(line, file=log)) as left,
        run_system(systems["right"], namespace="right", on_line=lambda line: print(line, file=log)) as right,
    ):
        for system in (left, right):
            system.wait("frame_source")
            system.stop()
    rows = []
    for name in names:
        poses = [pose for pose in load_recording(out / name).poses[BODY] if pose.valid]
        rows.append(exactly(f"replay in namespace {name}: valid poses", len(poses), len(expected)))
        difference = np.array([pose.displacement - expected[pose.stamp_ns] for pose in poses])
        rows.append(
            at_most(
                f"replay in {name}: largest departure from analyze, m or rad", abs(difference).max(), SAME
            )
        )
    return rows
