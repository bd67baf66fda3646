"""Settings: checked where they are made, and kept as plain values."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path

import pytest

from mems6dof_ros.errors import InputError
from mems6dof_ros.simulation.settings import SimulationSettings


def test_defaults_pass_and_round_trip_through_json():
    settings = SimulationSettings.from_dict({"electrons": 1e5, "optics": "smooth", "width_px": 512})
    again = SimulationSettings.from_dict(json.loads(json.dumps(settings.to_dict())))
    assert again == settings
    assert again.electrons == 1e5
    assert again.image_size == (512, 2048)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"electrnos": 1.0}, ["unknown name 'electrnos'", "electrons"]),
        ({"electrons": math.nan}, ["electrons", "nan", "a number from 0"]),
        ({"electrons": math.inf}, ["electrons", "inf"]),
        ({"electrons": -1.0}, ["electrons", "-1.0"]),
        ({"electrons": "6e4"}, ["electrons", "'6e4'", "a number"]),
        ({"electrons": True}, ["electrons", "True"]),
        ({"electrons": None}, ["electrons", "None"]),
        ({"width_px": 512.0}, ["width_px", "512.0", "a whole number"]),
        ({"width_px": 3}, ["width_px", "64 to 8192 px"]),
        ({"pixel_size": 127.34}, ["pixel_size", "127.34", "m"]),
        ({"optics": "best"}, ["optics", "'best'", "paper"]),
        ({"optics": ["paper"]}, ["optics", "paper"]),
        ({"pixel_format": "mono12"}, ["pixel_format", "mono8, mono16"]),
        ({"pixel_format": "mono8"}, ["saturation_adu", "255"]),
        ({"hub_diameter": 400e-6}, ["hub_diameter", "gear_diameter"]),
        ({"ring_diameter": 100e-6, "ring_width": 60e-6}, ["ring_width", "half of ring_diameter"]),
        ({"particles": 3, "clumps": 3}, ["clumps", "3 particles"]),
    ],
)
def test_bad_settings_are_refused_with_the_reason(values, words):
    with pytest.raises(InputError) as error:
        SimulationSettings.from_dict(values)
    for word in words:
        assert word in str(error.value)
    assert "\n" not in str(error.value)


def test_every_field_is_described():
    for spec in dataclasses.fields(SimulationSettings):
        assert spec.metadata["doc"]
        assert "unit" in spec.metadata
        assert ("range" in spec.metadata) != ("choices" in spec.metadata)


def test_the_documentation_names_every_setting_with_its_default():
    text = (Path(__file__).parents[2] / "docs" / "simulation.md").read_text(encoding="utf-8")
    for spec in dataclasses.fields(SimulationSettings):
        default = f"{spec.default:.6g}" if isinstance(spec.default, float) else str(spec.default)
        assert f"| `{spec.name}` | {default} |" in text
