"""`mems6dof cameras`, with whatever drivers this machine has."""

from __future__ import annotations

import sys

from mems6dof_ros.cli.main import main
from mems6dof_ros.sources.cameras import aravis


def test_absent_drivers_are_named_with_their_cure(capsys, monkeypatch):
    for module in ("gi", "harvesters", "harvesters.core", "pypylon", "pypylon.pylon"):
        monkeypatch.setitem(sys.modules, module, None)
    aravis._aravis.cache_clear()
    status = main(["cameras", "--producer", "any.cti"])
    aravis._aravis.cache_clear()
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(":")[0] for line in lines if not line.startswith(" ")] == [
        "GenICam (Aravis)",
        "GenICam (producer any.cti)",
        "Basler (pylon)",
        "V4L2 (OpenCV)",
    ]
    for line, cure in zip(
        lines, ("apt install", "pip install harvesters", "pip install pypylon"), strict=False
    ):
        assert "is not installed" in line
        assert cure in line
    assert status == (0 if "source: opencv" in "\n".join(lines) else 1)
