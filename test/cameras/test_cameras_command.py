"""`mems6dof cameras`, with whatever drivers this machine has."""

from __future__ import annotations

import sys

import pytest

from mems6dof_ros.cli.main import main
from mems6dof_ros.sources.cameras import aravis


@pytest.fixture
def _no_drivers(monkeypatch):
    for module in ("gi", "harvesters", "harvesters.core", "pypylon", "pypylon.pylon"):
        monkeypatch.setitem(sys.modules, module, None)
    aravis._aravis.cache_clear()
    yield
    aravis._aravis.cache_clear()


@pytest.mark.usefixtures("_no_drivers")
def test_absent_drivers_are_named_with_their_cure(capsys):
    status = main(["cameras", "--producer", "any.cti"])
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


@pytest.mark.usefixtures("_no_drivers")
def test_validation_that_measured_nothing_has_not_passed(capsys):
    assert main(["validate", "cameras", "--seconds", "1", "--size", "64"]) == 1
    output = capsys.readouterr().out
    assert "Basler: not measured, driver 'pypylon' is not installed" in output
    assert "0 passed, 0 failed" in output
    assert main(["validate", "cameras", "--size", "4096"]) == 2
