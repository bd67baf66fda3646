from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial import cKDTree

from mems6dof_ros.errors import InputError
from mems6dof_ros.frame import Frame
from mems6dof_ros.localization.detection import DetectionSettings, detect
from mems6dof_ros.simulation.experiment import motion_frames
from mems6dof_ros.simulation.settings import SimulationSettings

FIELD = 768  # px


def frame(height: float, **settings: float) -> Frame:
    """A simulated frame of isolated particles at ``height`` m."""
    values = {"width_px": FIELD, "height_px": FIELD, "particles": 30, "clumps": 0, "gear_diameter": 120e-6}
    values |= {"hub_diameter": 0.0, "gear_z": height, "seed": 3}
    return next(iter(motion_frames(SimulationSettings(**(values | settings)), 1)))


def missed_and_invented(image: np.ndarray, frame: Frame) -> tuple[int, int]:
    """Isolated particles (none within 4 um) missed, and candidates with no particle within 1 um."""
    truth = frame.truth[0].position[:, :2]
    found = (detect(image) - (FIELD - 1) / 2) * frame.pixel_size
    margin = 0.5 * FIELD * frame.pixel_size - 3e-6
    isolated = cKDTree(truth).query(truth, k=2)[0][:, 1] > 4e-6
    wanted = isolated & (np.abs(truth).max(axis=1) < margin)
    assert wanted.sum() > 10
    inside = np.abs(found).max(axis=1) < margin
    # Coma moves the light of a defocused particle to one side.
    near = 0.3e-6 + 0.3 * np.abs(frame.truth[0].position[:, 2].mean())
    missed = cKDTree(found).query(truth[wanted])[0] > near
    invented = cKDTree(truth).query(found[inside])[0] > near + 1e-6
    return int(missed.sum()), int(invented.sum())


@pytest.mark.parametrize("height", [-4e-6, -2e-6, 0.0, 2e-6, 4e-6])
def test_every_isolated_particle_is_found_through_focus(height: float) -> None:
    sample = frame(height)
    assert missed_and_invented(sample.image, sample) == (0, 0)


@pytest.mark.parametrize("electrons", [1e4, 1e6])
def test_brightness_does_not_matter(electrons: float) -> None:
    sample = frame(0.5e-6, electrons=electrons, gain=0.5)
    assert missed_and_invented(sample.image, sample) == (0, 0)


def test_uint8_is_as_good() -> None:
    sample = frame(1e-6)
    image = np.clip(sample.image / 8, 0, 255).astype(np.uint8)
    assert missed_and_invented(image, sample) == (0, 0)


def test_uneven_background_and_debris_are_not_particles() -> None:
    """A background that rises threefold, and dark discs of 1.5 to 4 um that take away two thirds of it."""
    rng = np.random.default_rng(4)
    columns, rows = np.meshgrid(np.arange(FIELD), np.arange(FIELD))
    mean = 100 * (1 + 2 * columns / FIELD) + 60 * np.sin(rows / 150)
    for radius in (6, 10, 16):
        for x, y in rng.uniform(50, FIELD - 50, (8, 2)):
            mean[np.hypot(columns - x, rows - y) < radius] *= 0.3
    assert len(detect((100 + 2 * rng.poisson(mean)).astype(np.uint16))) == 0
    sample = frame(1e-6)
    assert missed_and_invented((sample.image + 2 * rng.poisson(mean)).astype(np.uint16), sample)[0] == 0


def test_positions_are_good_to_a_pixel() -> None:
    sample = frame(0.0)
    truth = sample.truth[0].position[:, :2] / sample.pixel_size + (FIELD - 1) / 2
    distance, _ = cKDTree(detect(sample.image)).query(truth)
    assert np.median(distance) < 0.5
    assert np.percentile(distance, 90) < 1.5


def test_of_two_close_ones_the_brighter_stays() -> None:
    columns, rows = np.meshgrid(np.arange(200.0), np.arange(200.0))
    image = np.random.default_rng(1).poisson(
        20
        + 300 * np.exp(-((columns - 90) ** 2 + (rows - 100) ** 2) / 18)
        + 200 * np.exp(-((columns - 110) ** 2 + (rows - 100) ** 2) / 18)
    )
    both = detect(image.astype(np.uint16))
    assert len(both) == 2
    assert both[0] == pytest.approx([90, 100], abs=1.5)
    one = detect(image.astype(np.uint16), DetectionSettings(separation_px=25))
    assert one == pytest.approx(both[:1])


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("shape", [(1, 1), (7, 300), (64, 64), (513, 402)])
def test_frames_without_contrast_have_no_particles(dtype: type, shape: tuple[int, int]) -> None:
    for value in (0, 7, np.iinfo(dtype).max):
        assert detect(np.full(shape, value, dtype)).shape == (0, 2)


def test_noise_has_no_particles() -> None:
    rng = np.random.default_rng(2)
    for mean in (1.0, 10.0, 100.0):
        assert len(detect(rng.poisson(mean, (1024, 1024)).astype(np.uint16))) == 0


@pytest.mark.parametrize(
    "change",
    [
        {"binning": 0},
        {"threshold": math.nan},
        {"spot_sigmas_px": ()},
        {"spot_sigmas_px": (math.nan,)},
        {"separation_px": 0.0},
        {"background_px": 8},
    ],
)
def test_unusable_settings_are_refused(change: dict) -> None:
    with pytest.raises(InputError, match=next(iter(change))):
        DetectionSettings(**change)


def test_an_image_in_colour_is_refused() -> None:
    with pytest.raises(InputError, match="height, width"):
        detect(np.zeros((20, 20, 3), np.uint8))
