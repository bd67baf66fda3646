"""The camera's noise: mean, variance, saturation, fixed pattern."""

from __future__ import annotations

import numpy as np
import pytest

from mems6dof_ros.simulation.camera import Camera
from mems6dof_ros.simulation.optics import ParticleImages
from mems6dof_ros.simulation.settings import SimulationSettings

PLAIN = {
    "width_px": 256,
    "height_px": 192,
    "gain_spread": 0.0,
    "offset_spread_adu": 0.0,
    "read_noise_spread": 0.0,
    "illumination_falloff": 0.0,
}
DARK = ParticleImages(np.zeros((0, 2), np.int64), np.zeros((0, 88, 88), np.float32))


def camera(seed=5, **changes):
    settings = SimulationSettings.from_dict({**PLAIN, **changes})
    return Camera(settings, np.random.default_rng(seed))


def light(corner, value):
    """One window, evenly lit."""
    return ParticleImages(np.array([corner]), np.full((1, 88, 88), value, np.float32))


def test_background_has_the_mean_and_variance_of_the_noise_model():
    image = camera(background=10.0, read_noise=2.0, gain=1.8, offset_adu=120.0).expose(DARK).astype(float)
    assert image.shape == (192, 256)
    n = image.size
    expected = 1.8**2 * (10 + 2.0**2) + 1 / 12  # rounding
    assert image.mean() == pytest.approx(120 + 1.8 * 10, abs=4 * np.sqrt(expected / n))
    assert image.var() == pytest.approx(expected, rel=4 * np.sqrt(2.3 / n))
    # White: neighbours know nothing of each other.
    centred = image - image.mean()
    assert abs((centred[:, 1:] * centred[:, :-1]).mean()) < 4 * expected / np.sqrt(n)


def test_signal_adds_its_own_shot_noise():
    cam = camera(background=5.0, read_noise=1.5, gain=2.0)
    images = np.stack([cam.expose(light((60, 40), 700.0))[45:120, 65:140] for _ in range(40)]).astype(float)
    n = images.size
    expected = 2.0**2 * (700 + 5 + 1.5**2) + 1 / 12
    assert images.mean() == pytest.approx(100 + 2 * 705, abs=4 * np.sqrt(expected / n))
    assert images.var() == pytest.approx(expected, rel=4 * np.sqrt(2 / n))
    # From frame to frame, too: not the same noise again.
    difference = images[1:] - images[:-1]
    assert difference.var() == pytest.approx(2 * expected, rel=0.02)


def test_windows_beyond_the_border_are_cut_and_nothing_stays():
    cam = camera(read_noise=0.0, background=0.0)
    for corner in [(-40, -40), (256 - 20, 192 - 20), (-200, 10), (10, 500)]:
        lit = cam.expose(light(corner, 200.0)) > 200
        rows, columns = np.nonzero(lit)
        x, y = max(corner[0], 0), max(corner[1], 0)
        expected = max(min(corner[0] + 88, 256) - x, 0) * max(min(corner[1] + 88, 192) - y, 0)
        assert len(rows) == expected
        if expected:
            assert (columns.min(), rows.min()) == (x, y)
    assert np.all(cam.expose(DARK) == 100)


def test_saturation_and_zero_clip():
    full = camera(saturation_adu=1000).expose(light((0, 0), 5000.0))
    assert full.max() == 1000
    assert np.all(full[:80, :80] == 1000)
    low = camera(offset_adu=0.0, background=0.0, read_noise=5.0).expose(DARK)
    assert low.min() == 0  # not wrapped to 65535
    assert low.max() < 100


def test_mono8():
    eight = camera(pixel_format="mono8", saturation_adu=255, gain=0.1, offset_adu=8.0).expose(
        light((20, 20), 900.0)
    )
    assert eight.dtype == np.uint8
    assert eight[40:90, 40:90].mean() == pytest.approx(8 + 0.1 * 910, abs=0.5)
    assert camera().expose(DARK).dtype == np.uint16


def test_fixed_pattern_belongs_to_the_camera_and_noise_to_the_run():
    wide = {"gain_spread": 0.02, "offset_spread_adu": 3.0, "read_noise_spread": 0.3}
    one, other = camera(seed=1, **wide), camera(seed=2, **wide)
    np.testing.assert_array_equal(one.gain_map, other.gain_map)
    np.testing.assert_array_equal(one.offset_map_adu, other.offset_map_adu)
    assert one.gain_map.std() / one.gain == pytest.approx(0.02, rel=0.05)
    assert one.offset_map_adu.std() == pytest.approx(3.0, rel=0.05)
    assert np.log(one.read_noise_map / one.read_noise).std() == pytest.approx(0.3, rel=0.05)
    assert not np.array_equal(one.expose(DARK), other.expose(DARK))
    assert not np.array_equal(camera(camera_seed=9, **wide).gain_map, one.gain_map)
    # The pattern shows in the image: the average of frames approaches the map.
    mean = np.mean([one.expose(DARK) for _ in range(60)], axis=0)
    assert np.corrcoef(mean.ravel(), one.offset_map_adu.ravel())[0, 1] > 0.9


def test_illumination_falls_off_to_the_corners():
    image = camera(background=500.0, illumination_falloff=0.4, read_noise=0.0, gain=1.0).expose(DARK)
    middle = image[86:106, 118:138].mean() - 100
    corner = np.mean([image[:10, :10], image[-10:, -10:], image[:10, -10:], image[-10:, :10]]) - 100
    assert middle == pytest.approx(500, rel=0.01)
    assert corner == pytest.approx(300, rel=0.06)  # a tenth inwards, and the bank's shift
