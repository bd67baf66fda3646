from __future__ import annotations

import math

import numpy as np
import pytest

from mems6dof_ros.errors import InputError
from mems6dof_ros.localization.camera import CameraNoise


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"gain_adu_per_electron": 0.0}, "gain"),
        ({"gain_adu_per_electron": [[1.0, -1.0]]}, "gain"),
        ({"offset_adu": math.nan}, "offset"),
        ({"offset_adu": "dark"}, "offset"),
        ({"read_noise_electrons": -1.0}, "read_noise"),
        ({"read_noise_electrons": np.ones((2, 2, 2))}, "read_noise"),
        ({"saturation_adu": 0}, "saturation"),
        ({"saturation_adu": math.nan}, "saturation"),
        ({"offset_adu": np.ones((4, 5)), "gain_adu_per_electron": np.ones((5, 4))}, "maps"),
    ],
)
def test_impossible_cameras_are_refused_by_name(change: dict, named: str) -> None:
    values = {
        "offset_adu": 100.0,
        "gain_adu_per_electron": 2.0,
        "read_noise_electrons": 1.6,
        "saturation_adu": 65535,
    }
    with pytest.raises(InputError, match=named):
        CameraNoise(**(values | change))


def test_maps_must_have_the_size_of_the_image() -> None:
    camera = CameraNoise(np.full((4, 5), 100.0), 2.0, 1.6, 65535)
    camera.check_shape((4, 5))
    with pytest.raises(InputError, match="offset_adu"):
        camera.check_shape((5, 4))


def test_a_map_is_a_copy_that_cannot_change() -> None:
    offset = np.full((4, 5), 100.0)
    camera = CameraNoise(offset, 2.0, 1.6, 65535)
    offset[0, 0] = 0
    assert camera.maps[0][0, 0] == 100.0
    assert camera.maps[2][0, 0] == pytest.approx(1.6**2)
