"""The simulator behind the protocol of the sources."""

from __future__ import annotations

import numpy as np
import pytest

from mems6dof_ros.errors import InputError
from mems6dof_ros.sources.source import frames, open_source

SMALL = {"width_px": 128, "height_px": 96, "particles": 200, "seed": 5}


def test_frames_in_order_and_the_same_again():
    source = open_source("simulator", cycles=4, **SMALL)
    assert (source.info.width, source.info.height, source.info.frames) == (128, 96, 4)
    first, second = list(frames(source)), list(frames(source))
    assert [f.cycle for f in first] == [1, 2, 3, 4]
    assert first[0].image.shape == (96, 128)
    assert first[0].truth[0].body == "load_gear"
    for a, b in zip(first, second, strict=True):
        assert np.array_equal(a.image, b.image)


def test_the_loop_goes_on_counting():
    read = list(frames(open_source("simulator", cycles=7, loop=3, **SMALL)))
    assert [f.cycle for f in read] == list(range(1, 8))
    assert np.array_equal(read[0].image, read[3].image)
    assert len({f.stamp_ns for f in read}) == 7


def test_the_camera_it_states_is_the_camera_it_has():
    settings = {"width_px": 256, "height_px": 256, "particles": 0, "clumps": 0, "illumination_falloff": 0.0}
    source = open_source("simulator", cycles=1, **settings)
    frame = next(frames(source))
    camera = source.info.camera
    offset, gain, variance = (float(m.mean()) for m in camera.maps)
    electrons = (frame.image.mean() - offset) / gain
    assert electrons == pytest.approx(source.settings.background, rel=0.01)
    noise = frame.image.var() / gain**2
    assert noise == pytest.approx(electrons + variance, rel=0.03)


@pytest.mark.parametrize("options", [{"cycles": -1}, {"loop": 1.5}, {"electrons": "many"}, {"brightness": 3}])
def test_bad_options(options):
    with pytest.raises(InputError, match=next(iter(options))):
        open_source("simulator", **options)
