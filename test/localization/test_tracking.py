from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from mems6dof_ros.analysis.truth import TruthComparison, compare
from mems6dof_ros.calibration.file import load_calibration
from mems6dof_ros.errors import InputError
from mems6dof_ros.frame import Frame
from mems6dof_ros.localization.localizations import Flag, Localizations
from mems6dof_ros.localization.localizer import Localizer
from mems6dof_ros.localization.tracking import TrackingLocalizer, TrackingSettings
from mems6dof_ros.pose.cycle_pose import CyclePose
from mems6dof_ros.pose.estimator import PoseEstimator
from mems6dof_ros.simulation.experiment import motion_frames
from mems6dof_ros.simulation.settings import SimulationSettings

CALIBRATION = Path(__file__).parents[2] / "bags" / "sample_calibration.yaml"
#: The small gear that the calibration was made for, wider than the field: particles leave and come back.
SETTINGS = {"width_px": 384, "height_px": 384, "gear_diameter": 60e-6, "hub_diameter": 4e-6, "particles": 40}


@pytest.fixture(scope="module")
def frames() -> list[Frame]:
    settings = SimulationSettings(seed=5, stall_probability=0.05, **SETTINGS)  # type: ignore[arg-type]
    return list(motion_frames(settings, 40))


def localizer() -> Localizer:
    calibration = load_calibration(CALIBRATION)
    return Localizer(calibration.camera, calibration)


def measure(
    frames: list[Frame], tracking: TrackingLocalizer | None, delay: int = 0
) -> Iterator[tuple[Frame, Localizations, CyclePose]]:
    """Every frame with its result; poses become known ``delay`` frames late."""
    full, estimator = localizer(), PoseEstimator()
    poses = []
    for frame in frames:
        found = (tracking or full).localize(frame)
        pose = estimator.update(found)
        poses.append(pose)
        if tracking and len(poses) > delay and (known := poses[-1 - delay]).valid:
            tracking.observe(known.cycle, known.rotation, known.translation, known.reference_version)
        yield frame, found, pose


def accuracy(results: list[tuple[Frame, Localizations, CyclePose]]) -> TruthComparison:
    assert all(pose.valid for _, _, pose in results)
    return compare([pose for _, _, pose in results], [frame.truth[0] for frame, _, _ in results])


@pytest.mark.parametrize("delay", [0, 1])
def test_tracking_is_as_accurate_as_detection_and_rarely_detects(frames: list[Frame], delay: int) -> None:
    """Also where the pose is a frame late, as from another process, and over cycles without a step."""
    tracking = TrackingLocalizer(localizer())
    tracked = accuracy(list(measure(frames, tracking, delay)))
    detected = accuracy(list(measure(frames, None)))
    for (name, error, claimed), (_, reference, _) in zip(tracked.table(), detected.table(), strict=True):
        # The same photons: what differs is a particle or two at the edge.
        assert error < 1.15 * reference + 0.1 * claimed, name
    assert tracking.detections <= len(frames) // 2


def test_a_tracked_particle_is_measured_as_a_detected_one(frames: list[Frame]) -> None:
    tracking, full = TrackingLocalizer(localizer()), localizer()
    compared = newcomers = 0
    for number, (frame, found, _) in enumerate(measure(frames[:14], tracking)):
        if tracking.detections == number + 1:
            continue
        reference = full.localize(frame)
        for position, covariance, flags in zip(
            reference.position, reference.covariance, reference.flags, strict=True
        ):
            if flags & ~np.uint32(Flag.Z_AMBIGUOUS):
                continue
            distance = np.hypot(*(found.position[:, :2] - position[:2]).T)
            same = int(np.nanargmin(distance))
            if distance[same] > 0.5e-6:
                newcomers += 1
                continue
            difference = np.abs(found.position[same] - position) / np.sqrt(np.diag(covariance))
            assert difference.max() < 0.2
            compared += 1
    assert compared > 100
    assert newcomers < 0.1 * compared


def test_a_jump_is_searched_at_once(frames: list[Frame]) -> None:
    """The gear goes on from elsewhere: the same frame is searched, and no particle of it is lost."""
    tracking = TrackingLocalizer(localizer(), TrackingSettings(detection_period=1000))
    jumped = [
        *frames[:6],
        *(replace(f, cycle=f.cycle - 14, frame_counter=f.frame_counter - 14) for f in frames[20:24]),
    ]
    before = 0
    for number, (frame, found, _) in enumerate(measure(jumped, tracking)):
        if number == 6:
            assert tracking.detections == before + 1
            assert len(found) == len(localizer().localize(frame))
        before = tracking.detections


def test_without_poses_every_frame_is_searched(frames: list[Frame]) -> None:
    tracking = TrackingLocalizer(localizer())
    for frame in frames[:3]:
        tracking.localize(frame)
    assert tracking.detections == 3


@pytest.mark.parametrize("change", [{"detection_period": 0}, {"least_found": 0.0}, {"least_found": 1.5}])
def test_unusable_settings_are_refused(change: dict) -> None:
    with pytest.raises(InputError, match=next(iter(change))):
        TrackingSettings(**change)


@pytest.mark.parametrize("delay", [0, 1, 2])
def test_newcomers_are_found_after_their_frame_is_out(frames: list[Frame], delay: int) -> None:
    """Whatever is known later than the frame: its pose, or who is new in it."""
    tracking = TrackingLocalizer(localizer(), TrackingSettings(detection_period=4, least_found=0.01))
    full = localizer()
    wanted = got = 0
    for frame, found, _ in measure(frames, tracking, delay):
        if frame.cycle <= 20:
            continue
        all_there = full.localize(frame)
        good = (all_there.flags & np.uint32(Flag.FIT_FAILED | Flag.POOR_FIT)) == 0
        distance, _ = cKDTree(np.nan_to_num(found.position[:, :2], nan=1.0)).query(
            all_there.position[good, :2]
        )
        wanted += len(distance)
        got += int((distance < 10e-9).sum())
    # A newcomer is missing for up to four frames, and until the pose of the one that showed it is known.
    assert got >= 0.9 * wanted
    assert tracking.detections <= len(frames) / 4 + 4
