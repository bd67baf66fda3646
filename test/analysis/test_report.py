"""What a report says and shows."""

from __future__ import annotations

import base64
import re
from dataclasses import fields, replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from mems6dof_ros.analysis import figures
from mems6dof_ros.analysis.analyze import analyze
from mems6dof_ros.analysis.many_cycles import MOTION, PLAY
from mems6dof_ros.analysis.recording import CONSTELLATION, load_recording
from mems6dof_ros.analysis.report import compare_with_truth, write_report
from mems6dof_ros.analysis.truth import compare
from mems6dof_ros.calibration.file import load_calibration
from mems6dof_ros.errors import InputError
from mems6dof_ros.localization.localizer import Localizer
from mems6dof_ros.pose.cycle_pose import Status
from mems6dof_ros.pose.estimator import PoseEstimator
from mems6dof_ros.pose.rigid import kabsch
from mems6dof_ros.recording import messages
from mems6dof_ros.recording.bag import BagReader, BagWriter
from mems6dof_ros.recording.tables import read_table
from mems6dof_ros.sources.source import open_source

BAGS = Path(__file__).parents[2] / "bags"


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    out = tmp_path_factory.mktemp("report") / "run"
    calibration = load_calibration(BAGS / "sample_calibration.yaml")
    localizer = Localizer(calibration.camera, calibration)
    analyze(open_source("bag", path=BAGS / "sample"), localizer, [PoseEstimator()], out)
    return out / "bag"


def without(bag: Path, out: Path, types: tuple[str, ...] = (), lost: tuple[int, ...] = ()) -> Path:
    """A copy of the poses of a bag without messages of ``types``, the poses of cycles ``lost`` being lost."""
    with BagReader(bag) as reader, BagWriter(out) as writer:
        for topic, kind, time, message in reader.messages():
            if kind.rsplit("/", 1)[1] in types:
                continue
            data = reader._reader.typestore.serialize_cdr(message, kind)
            if kind.endswith("Pose6DOF"):
                pose = messages.to_cycle_pose(message)
                if pose.cycle in lost:
                    data = messages.serialize(messages.pose6dof(_lost(pose)))
            writer.write(writer.add_channel(topic, kind), data, time)
    return out


def _lost(pose):
    unknown = {
        field.name: np.full_like(value, np.nan)
        for field in fields(pose)
        if isinstance(value := getattr(pose, field.name), np.ndarray) and value.dtype.kind == "f"
    }
    return replace(
        pose, status=Status.LOST, reason="covered", particle_id=pose.particle_id * 0 - 1, **unknown
    )


def test_the_page_needs_nothing_else_and_shows_every_figure(bag, tmp_path):
    page = write_report(bag, tmp_path / "report").read_text(encoding="utf-8")
    assert not re.search(r'(src|href)="(?!data:)', page)
    pictures = re.findall(r"data:image/png;base64,([A-Za-z0-9+/=]+)", page)
    files = sorted((tmp_path / "report").glob("*.png"))
    assert len(pictures) == len(files) >= 8
    for data in pictures:
        image = cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_COLOR)
        assert image.shape[1] > 1000
        assert image.std() > 5  # something is drawn
    assert "24 tracking" in page
    assert "rms error" in page
    assert "24 frames recorded, none reported lost" in page
    assert "play</th><td>one or more needed, found 0.29 revolutions" in page
    tables = {file.stem: file for file in (tmp_path / "report").glob("*.csv")}
    assert set(tables) == {
        *("cycles", "localizations", "motion", "play", "spectrum", "relative", "constellation")
    }
    _, motion = read_table(tables["motion"], MOTION)
    assert len(motion["value_si"]) > 20
    assert np.isfinite(motion["value_si"]).all()
    _, particles = read_table(tables["constellation"], CONSTELLATION)
    assert len(particles["seen"]) >= 20
    assert len(read_table(tables["play"], PLAY)[1]["cycle"]) == 0


def test_the_numbers_are_those_of_the_poses(bag, tmp_path):
    page = write_report(bag, tmp_path / "report").read_text(encoding="utf-8")
    recording = load_recording(bag)
    comparison = compare_with_truth(recording, "load_gear")
    assert f"{comparison.nees_per_dof:.2f} (honest: 1)" in page
    assert f"<td>{comparison.rms[0] * 1e9:#.3g} nm</td>" in page
    _, step, _ = figures.rotation_per_cycle(recording.poses["load_gear"])
    assert len(step) == 23
    assert f"({step.mean() * 1e3:.2f} ±" in page


def test_poses_without_their_truth_are_left_out(bag):
    recording = load_recording(bag)
    poses = [pose for pose in recording.poses["load_gear"] if pose.valid]
    truths = recording.truth_of(poses)
    truths[3] = None
    assert compare(poses, truths).cycle.tolist() == [p.cycle for k, p in enumerate(poses) if k != 3]
    with pytest.raises(InputError, match="no valid pose with its truth"):
        compare(poses, [None] * len(poses))


def test_earlier_references_are_expressed_in_the_last_one(bag):
    """The true path, apart from its zero, is what the poses must show once they share one reference."""
    recording = load_recording(bag)
    measured = recording.poses["load_gear"]
    versions = [pose.reference_version for pose in measured]
    assert len(set(versions)) > 1, "the sample no longer redefines its reference: nothing is tested"
    poses = recording.in_last_reference("load_gear")
    assert {pose.reference_version for pose in poses} == {max(versions)}
    comparison = compare(poses, recording.truth_of(poses))
    # One gauge for all cycles instead of one for each version, which absorbs some error, and the error of the
    # tie, which rests on the 7 cycles of the first version and so is 0.4 of a pose's: 1.2 and up by chance.
    assert (comparison.rms < 1.8 * compare_with_truth(recording, "load_gear").rms).all()
    assert 0.5 < comparison.nees_per_dof < 1.8  # the covariances have moved with the origin
    for before, after in zip(measured, poses, strict=True):
        if before.reference_version == max(versions):
            assert after is before


def test_an_estimator_that_was_started_again_has_other_references_and_particles(bag, tmp_path):
    """The same poses once more, two seconds later, as from a new process: versions and particles count on."""
    twice = tmp_path / "twice"
    with BagReader(bag) as reader, BagWriter(twice) as writer:
        kept = [m for m in reader.messages() if m[1].endswith("Pose6DOF")]
        for later in (0, 2_000_000_000):
            for topic, kind, time, message in kept:
                pose = messages.to_cycle_pose(message)
                pose = replace(pose, stamp_ns=pose.stamp_ns + later)
                channel = writer.add_channel(topic, kind)
                writer.write(channel, messages.serialize(messages.pose6dof(pose)), time + later)
    once, poses = (load_recording(path).poses["load_gear"] for path in (bag, twice))
    first, second = poses[: len(once)], poses[len(once) :]
    last = max(pose.reference_version for pose in once)
    assert [pose.reference_version for pose in first] == [pose.reference_version for pose in once]
    assert [pose.reference_version for pose in second] == [pose.reference_version + last for pose in once]
    ids = [{*np.concatenate([pose.particle_id for pose in part]).tolist()} - {-1} for part in (first, second)]
    assert not ids[0] & ids[1]
    assert len(ids[0]) == len(ids[1])


def test_the_constellation_is_the_true_one(bag):
    """Positions in the body frame against the simulator's, after the rigid motion between the two frames."""
    recording = load_recording(bag)
    found = recording.constellation("load_gear", recording.last_version("load_gear"))
    often = found.position[found.seen >= 5]
    truth = {}
    for (_, body), frame in recording.truths.items():
        for number, place in zip(
            frame.particle_id, (frame.position - frame.translation) @ frame.rotation, strict=True
        ):
            if body == "load_gear":
                truth[int(number)] = place
    true = np.array(list(truth.values()))
    pose, truth_pose = next(
        (p, recording.truths[p.stamp_ns, "load_gear"])
        for p in recording.poses["load_gear"]
        if p.reference_version == recording.last_version("load_gear")
    )
    guess = (often @ pose.rotation.T + pose.translation - truth_pose.translation) @ truth_pose.rotation
    distance = np.linalg.norm(guess[:, None, :2] - true[None, :, :2], axis=2)
    partner = distance.argmin(axis=1)
    assert distance.min(axis=1).max() < 1e-6
    error = kabsch(often, true[partner]).apply(often) - true[partner]
    assert np.sqrt((error[:, :2] ** 2).mean()) < 3e-9
    assert np.sqrt((error[:, 2] ** 2).mean()) < 60e-9


def test_lost_cycles_truth_and_localizations_may_be_missing(bag, tmp_path):
    copy = without(bag, tmp_path / "copy", ("GroundTruth", "FrameInfo"), lost=(9, 10))
    page = write_report(copy, tmp_path / "a").read_text(encoding="utf-8")
    assert "22 tracking, 2 lost" in page
    assert "rms error" not in page
    poses_only = without(bag, tmp_path / "poses", ("GroundTruth", "FrameInfo", "Localizations"))
    write_report(poses_only, tmp_path / "b")
    nothing = without(bag, tmp_path / "nothing", lost=tuple(range(1, 25)))
    assert "24 lost" in write_report(nothing, tmp_path / "c").read_text(encoding="utf-8")


def test_bags_without_poses_are_refused(tmp_path):
    with pytest.raises(InputError, match=r"sample.*no poses"):
        write_report(BAGS / "sample", tmp_path / "report")
    assert not (tmp_path / "report").exists()
