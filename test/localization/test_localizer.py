from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from scipy.spatial import cKDTree

from mems6dof_ros.calibration.interface import Positions
from mems6dof_ros.errors import InputError
from mems6dof_ros.frame import Frame
from mems6dof_ros.localization.camera import CameraNoise
from mems6dof_ros.localization.localizations import Flag, GaussianFits
from mems6dof_ros.localization.localizer import Localizer, LocalizerSettings
from mems6dof_ros.simulation.experiment import motion_frames
from mems6dof_ros.simulation.settings import SimulationSettings

SETTINGS = SimulationSettings(
    width_px=768, height_px=768, particles=80, clumps=0, gear_diameter=140e-6, hub_diameter=0.0, seed=5
)
CAMERA = CameraNoise(SETTINGS.offset_adu, SETTINGS.gain, SETTINGS.read_noise, SETTINGS.saturation_adu)


@pytest.fixture(scope="module")
def frame() -> Frame:
    return next(iter(motion_frames(SETTINGS, 1)))


class FlatCalibration:
    """Puts every particle at z = 0: a calibration as far as the localizer can tell."""

    calibration_id = "flat-1"
    method = "flat"
    pixel_size = SETTINGS.pixel_size
    image_size = (768, 768)
    weighting = "uniform"
    window_px = 21

    def locate(self, fits: GaussianFits, image: np.ndarray | None = None) -> Positions:
        n = len(fits)
        self.seen = fits
        position = np.zeros((n, 3))
        position[:, :2] = fits.parameters[:, :2] * self.pixel_size
        flags = np.full(n, Flag.Z_AMBIGUOUS, np.uint32)
        return Positions(position, np.tile(np.eye(3), (n, 1, 1)), np.full(n, 5.0), flags)


def test_positions_agree_with_the_truth(frame: Frame) -> None:
    """Without a calibration the apparent motion with z remains: below 60 nm within 0.5 um of focus."""
    found = Localizer(CAMERA, None).localize(frame)
    assert (found.stamp_ns, found.frame_counter, found.cycle) == (
        frame.stamp_ns,
        frame.frame_counter,
        frame.cycle,
    )
    trusted = found.flags == Flag.NO_Z
    assert trusted.sum() > 30
    truth = frame.truth[0].position[:, :2]
    distance, _ = cKDTree(truth).query(found.position[trusted, :2])
    assert distance.max() < 60e-9
    assert np.isnan(found.position[:, 2]).all()
    deviation = np.sqrt(found.covariance[trusted][:, [0, 1], [0, 1]])
    assert ((deviation > 0.5e-9) & (deviation < 10e-9)).all()
    assert np.isnan(found.covariance[:, 2, 2]).all()


def test_neighbours_are_flagged_and_nobody_else(frame: Frame) -> None:
    found = Localizer(CAMERA, None).localize(frame)
    position = found.position[:, :2][found.flags & Flag.FIT_FAILED == 0]
    flags = found.flags[found.flags & Flag.FIT_FAILED == 0]
    near = cKDTree(position).query(position, k=2)[0][:, 1] < 4e-6
    assert near.any()
    np.testing.assert_array_equal(flags & Flag.NEIGHBOUR != 0, near)


def test_most_pairs_that_touch_are_a_poor_fit() -> None:
    clumped = dataclasses.replace(SETTINGS, particles=60, clumps=30, diameter_spread=0.0)
    frame = next(iter(motion_frames(clumped, 1)))
    found = Localizer(CAMERA, None).localize(frame)
    truth = frame.truth[0].position[:, :2]
    distance, _ = cKDTree(truth).query(truth, k=2)
    pairs = truth[distance[:, 1] < 1.2e-6]
    assert len(pairs) >= 8
    trusted = found.position[found.flags == Flag.NO_Z, :2]
    near, _ = cKDTree(trusted).query(pairs)
    # A faint particle beside a bright one passes; the pose's residuals have to find it.
    assert np.mean(near > 1e-6) > 0.6


def test_calibration_prescribes_the_fit_and_adds_its_verdict(frame: Frame) -> None:
    calibration = FlatCalibration()
    found = Localizer(CAMERA, calibration, LocalizerSettings(weighting="poisson")).localize(frame)
    assert found.calibration_id == "flat-1"
    assert (found.z_gap == 5.0).all()
    assert (found.flags & Flag.Z_AMBIGUOUS != 0).all()
    assert (found.flags & Flag.NO_Z == 0).all()
    np.testing.assert_array_equal(found.fits.parameters, calibration.seen.parameters)
    light = Localizer(CAMERA, None, LocalizerSettings(weighting="uniform", window_px=21)).localize(frame)
    np.testing.assert_array_equal(found.fits.parameters, light.fits.parameters)


@pytest.mark.parametrize("level", [0, 100, 65535])
def test_frames_without_contrast_have_no_localizations(level: int) -> None:
    image = np.full((768, 768), level, np.uint16)
    for calibration in (None, FlatCalibration()):
        found = Localizer(CAMERA, calibration).localize(Frame(image, 1, 2, 3, pixel_size=127.34e-9))
        assert len(found) == 0
        assert found.position.shape == (0, 3)
        assert found.covariance.shape == (0, 3, 3)


def test_saturated_particles_are_flagged(frame: Frame) -> None:
    camera = dataclasses.replace(CAMERA, saturation_adu=1500)
    clipped = dataclasses.replace(frame, image=np.minimum(frame.image, 1500).astype(np.uint16))
    found = Localizer(camera, None).localize(clipped)
    assert np.mean(found.flags & Flag.SATURATED != 0) > 0.5


def test_contradictions_are_refused_by_name(frame: Frame) -> None:
    image = frame.image
    localizer = Localizer(CAMERA, FlatCalibration())
    with pytest.raises(InputError, match=r"frame 7.*700 x 768.*768 x 768.*flat-1"):
        localizer.localize(Frame(image[:, :700].copy(), 1, 7, 1))
    with pytest.raises(InputError, match=r"127\.400 nm.*127\.340 nm.*flat-1"):
        localizer.localize(Frame(image, 1, 7, 1, pixel_size=127.40e-9))
    with pytest.raises(InputError, match="no pixel size"):
        Localizer(CAMERA, None).localize(Frame(image, 1, 7, 1))
    with pytest.raises(InputError, match="saturation at 4095"):
        localizer.localize(Frame(image, 1, 7, 1, saturation_adu=4095))
    settings = LocalizerSettings(pixel_size=127.34e-9)
    assert len(Localizer(CAMERA, None, settings).localize(Frame(image, 1, 7, 1))) > 0


@pytest.mark.parametrize(
    "change",
    [{"neighbour_distance": math.nan}, {"most_misfit": -1.0}, {"pixel_size": 0.0}, {"weighting": "light"}],
)
def test_unusable_settings_are_refused(change: dict) -> None:
    with pytest.raises(InputError, match=next(iter(change))):
        LocalizerSettings(**change)
