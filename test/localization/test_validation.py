from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from mems6dof_ros.cli.main import main
from mems6dof_ros.figures import at_most, information
from mems6dof_ros.localization import validation


@pytest.fixture(scope="module")
def printed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("validation") / "figures.json"
    assert main(["validate", "localization", "--particles", "4000", "--seed", "2", "--json", str(path)]) == 0
    return path


def test_command_writes_what_it_measured(printed: Path) -> None:
    record = json.loads(printed.read_text())
    assert record["parameters"] == {"particles": 4000, "seed": 2}
    table = {row["quantity"]: row for row in record["figures"]}
    assert len(table) == len(record["figures"])
    assert all(np.isfinite(row["measured"]) for row in table.values())
    assert all(row["passed"] for row in table.values() if row["required"])
    assert sum(bool(row["required"]) for row in table.values()) > 40


def test_a_figure_that_misses_fails(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    rows = [at_most("rms", 1.06, 1.05), information("rate", 10.0)]
    monkeypatch.setattr(validation, "figures", lambda *_: rows)
    assert main(["validate", "localization"]) == 1
    output = capsys.readouterr().out
    assert "FAIL" in output
    assert "0 passed, 1 failed" in output


def test_too_few_particles_are_refused(capsys: pytest.CaptureFixture) -> None:
    assert main(["validate", "localization", "--particles", "3"]) == 2
    assert "--particles" in capsys.readouterr().err
