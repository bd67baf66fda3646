"""Source on one host, the rest on another: two network namespaces, where they are permitted."""

from __future__ import annotations

from pathlib import Path

import pytest
from peers import SMALL_GEAR

from mems6dof_ros.nodes.validation.networks import across_machines, why_not


def test_frames_cross_a_network(tmp_path: Path) -> None:
    if reason := why_not():
        pytest.skip(reason)
    small = {name: value for name, value in SMALL_GEAR.items() if not name.endswith("_px")}
    figures = list(across_machines(tmp_path, size=512, cycles=10, rate=5.0, **small))
    passed = {figure["quantity"]: figure["passed"] for figure in figures if figure["passed"] is not None}
    bytes_on_the_wire = [name for name in passed if "bytes" in name]
    assert len(bytes_on_the_wire) == 1
    (figure,) = [figure for figure in figures if figure["quantity"] in bytes_on_the_wire]
    assert figure["measured"] >= 1  # they did not go by shared memory
    assert len(passed) == 4
    assert all(verdict for name, verdict in passed.items() if name not in bytes_on_the_wire)
