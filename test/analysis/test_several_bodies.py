"""Files of bodies, and their use by the command line."""

from __future__ import annotations

from pathlib import Path

import pytest

from mems6dof_ros.cli.main import main
from mems6dof_ros.errors import InputError
from mems6dof_ros.pose.bodies_file import load_bodies
from mems6dof_ros.pose.settings import PoseSettings
from mems6dof_ros.recording.tables import CYCLES, read_table

BAGS = Path(__file__).parents[2] / "bags"

TWO = """
settings: {field_degree: 2}
bodies:
  load_gear:
    region: {centre: [-100e-6, 0], outer_radius: 170e-6}
  ring_gear:
    region: {centre: [474.0e-6, 0], outer_radius: 420e-6, inner_radius: 3.0e-4}
    settings: {confirm_after: 2, recentre_at: [0.5]}
"""


def write(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "bodies.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def test_regions_and_settings(tmp_path):
    load, ring = load_bodies(write(tmp_path, TWO), PoseSettings(reference="previous")).estimators
    assert (load.body, ring.body) == ("load_gear", "ring_gear")
    assert load.region.centre == (-100e-6, 0)
    assert ring.region.inner_radius == 300e-6
    assert ring.settings == PoseSettings(
        reference="previous", field_degree=2, confirm_after=2, recentre_at=(0.5,)
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "no bodies"),
        ("bodies: [1]", "no bodies"),
        ("bodies: {", "no valid YAML"),
        ("bodies: {a: {colour: red}}", "body a: found unknown 'colour'"),
        ("bodies: {a: {}, b: {}}", "a region or a reference constellation"),
        ("bodies: {a: {region: {centre: [0, 0]}}}", "outer_radius"),
        ("bodies: {a: {region: {centre: [0, x], outer_radius: 1}}}", "centre: found 'x'; expected a number"),
        ("bodies: {a: {region: {centre: [0, 0], outer_radius: 0}}}", "inner_radius < outer_radius"),
        ("bodies: {a: {settings: {gate: 1}}}", "unknown 'gate'"),
        ("bodies: {a: {settings: {min_particles: 1}}}", "at least 3"),
        ("bodies: {a: {settings: {gates: 1.0e-6}}}", "gates"),
        ("{settings: {field_degree: 4.5}, bodies: {a: }}", "field_degree"),
        ("bodies: {a: {settings: {field_degree: 0}}}", "body a: found unknown 'field_degree'"),
        ("bodies: {a: {constellation: none.json}}", "none\\.json"),
    ],
)
def test_anything_else_is_one_clear_error(tmp_path, text, message):
    with pytest.raises(InputError, match=message):
        load_bodies(write(tmp_path, text))
    with pytest.raises(InputError, match=r"missing\.yaml"):
        load_bodies(tmp_path / "missing.yaml")


def test_a_constellation_is_recognised_in_another_session(tmp_path, capsys):
    """The second analysis knows the particles before it sees them, and so has a map from the first cycle."""
    calibration = ["--calibration", str(BAGS / "sample_calibration.yaml")]
    bodies = write(tmp_path, "bodies: {gear: {region: {centre: [0, 0], outer_radius: 1.0e-3}}}")
    first, second = tmp_path / "first", tmp_path / "second"
    assert (
        main(["analyze", str(BAGS / "sample"), *calibration, "--bodies", str(bodies), "--out", str(first)])
        == 0
    )
    assert "gear poses: tracking 24" in capsys.readouterr().out
    known = write(tmp_path, "bodies: {gear: {constellation: first/gear_constellation.json}}")
    assert (
        main(["analyze", str(BAGS / "sample"), *calibration, "--bodies", str(known), "--out", str(second)])
        == 0
    )
    _, cycles = read_table(second / "cycles.csv", CYCLES)
    assert set(cycles["body"]) == {"gear"}
    assert cycles["residual_rms_xy_m"][0] > 0  # a founding cycle agrees with itself
    assert main(
        ["analyze", str(BAGS / "sample"), "--calibration", "none", "--bodies", str(bodies), "--out", "x"]
    )
