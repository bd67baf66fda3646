"""The command that prints the figures of the page: what it says, and what it says of nonsense."""

from __future__ import annotations

import json

import pytest

from mems6dof_ros.cli.main import main
from mems6dof_ros.monitor.attacks import other_host, other_paths
from mems6dof_ros.monitor.validation import attacked


def test_figures_are_printed_and_written_and_decide(capsys, tmp_path, monkeypatch):
    monkeypatch.setattr(attacked, "ATTACKS", {"other host": other_host, "path traversal": other_paths})
    path = tmp_path / "figures.json"
    assert main(["validate", "monitor", "--only", "attacks", "--json", str(path)]) == 0
    printed = capsys.readouterr().out
    assert printed.count("pass") == 10  # nine figures, and the sum of them
    record = json.loads(path.read_text())
    assert [row["measured"] for row in record["figures"] if "refused" in row["quantity"]] == [1, 1, 1]

    async def succeeds(url: str) -> bool:
        return False

    monkeypatch.setattr(attacked, "ATTACKS", {"one that succeeds": succeeds})
    assert main(["validate", "monitor", "--only", "attacks"]) == 1
    assert "FAIL" in capsys.readouterr().out


@pytest.mark.parametrize("seconds", ["1", "nan", "1e9"])
def test_a_senseless_duration_is_one_line(capsys, seconds):
    assert main(["validate", "monitor", "--seconds", seconds]) == 2
    assert capsys.readouterr().err.startswith("mems6dof: --seconds: found ")
