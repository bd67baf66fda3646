"""The bench measures what it says: on a small field, without asserting any time."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from mems6dof_ros.bench import chain, kernels, suite, table
from mems6dof_ros.bench.material import CYCLES, Material
from mems6dof_ros.bench.table import Row
from mems6dof_ros.cli.main import main
from mems6dof_ros.errors import InputError
from mems6dof_ros.localization.tracking import TrackingLocalizer

SAMPLE = Path(__file__).parents[2] / "bags" / "sample_calibration.yaml"


class SmallMaterial(Material):
    """The small gear of the sample calibration."""

    @property
    def simulation(self) -> dict:
        return {**super().simulation, "particles": 40, "gear_diameter": 60e-6, "hub_diameter": 4e-6}


@pytest.fixture(scope="module")
def material(tmp_path_factory: pytest.TempPathFactory) -> Material:
    return SmallMaterial(tmp_path_factory.mktemp("bench"), True, SAMPLE, size=384)


def test_the_chain_is_followed_to_valid_poses_and_profiled(material: Material) -> None:
    (row,) = chain.in_memory(material)
    assert row.details["particles used"] > 8
    stages = [row.details[f"{stage} ms"] for stage in ("detection", "fits", "z", "pose")]
    assert min(stages) > 0


def test_tracking_searches_one_frame_of_sixteen(material: Material) -> None:
    (row,) = chain.tracking(material)
    assert row.details["searched frames"] < 0.25
    localizer = TrackingLocalizer(material.localizer)
    steps = chain.run(chain.loop(material.frames), localizer, CYCLES)
    assert len(steps.pose) == CYCLES
    assert steps.rate == pytest.approx(1 / np.mean(steps.localization + steps.pose))


def test_frames_close_a_revolution(material: Material) -> None:
    turned = [frame.truth[0].psi for frame in material.frames]
    np.testing.assert_allclose(np.diff(turned), 2 * np.pi / CYCLES, rtol=1e-9)


def test_fits_reach_the_bound_with_or_without_the_peer(
    material: Material, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(kernels, "_optional", lambda name: None)
    rows = kernels.fits(material)
    by_name = {row.name.strip(): row for row in rows}
    assert by_name["failures"].passed
    assert by_name["rms over the Cramer-Rao bound"].passed
    first = by_name["fits, 21 px, light-weighting"]
    assert first.reference is None
    assert first.passed is None
    assert "not installed" in first.note


def test_limits_decide() -> None:
    assert Row("", 1.0, "", figure=5.0, least=5.0).passed
    assert not Row("", 1.0, "", figure=4.9, least=5.0).passed
    assert not Row("", 1.0, "", figure=5.1, most=5.0).passed
    assert Row("", 1.0, "", figure=5.1).passed is None


def test_command_writes_table_and_json(
    tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    row = Row("speed", 2.0, "/s", "a peer", 1.0, 2.0, 3.0, details={"load": 0.5})
    monkeypatch.setattr(suite, "measure", lambda names, material, progress: [row])
    assert main(["bench", "fits", "--quick", "--json", str(tmp_path / "bench.json")]) == 1
    assert "FAIL" in capsys.readouterr().out
    written = json.loads((tmp_path / "bench.json").read_text())
    assert written["format"] == "mems6dof bench 1"
    assert written["rows"][0]["passed"] is False
    assert written["machine"]["cores"] >= 1


def test_an_unknown_row_is_refused(material: Material) -> None:
    with pytest.raises(InputError, match="fits"):
        suite.measure(["speed"], material)


def test_every_row_has_its_function() -> None:
    import importlib

    for target in suite.ROWS.values():
        module, function = target.split(":")
        assert callable(getattr(importlib.import_module(f"mems6dof_ros.bench.{module}"), function))


def test_the_table_is_aligned() -> None:
    rows = [Row("a", 1.0, "s"), Row("a longer name", 2.0, "ms", "peer", 3.0, 1.5, 1.0, note="why")]
    out = table.lines(rows)
    assert out[0].index("against") == out[2].index("peer")


def test_a_row_that_fails_says_so_and_leaves_the_others(
    material: Material, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(material: Material) -> list[Row]:
        raise RuntimeError("no such node")

    monkeypatch.setattr(chain, "in_memory", broken)
    monkeypatch.setattr(kernels, "_optional", lambda name: None)
    rows = list(suite.measure(["memory", "detection"], material))
    assert [row.passed for row in rows] == [None, False]
    assert "no such node" in rows[1].note
    assert rows[0].details["load before"] >= 0
