"""A run goes on when its nodes are killed or hang: the reduced version of `mems6dof validate lab`."""

from __future__ import annotations

from pathlib import Path

from peers import SMALL_GEAR

from mems6dof_ros.nodes.validation.outages import outages
from mems6dof_ros.simulation.settings import SimulationSettings


def test_a_run_survives_its_nodes(calibration: str, tmp_path: Path) -> None:
    settings = SimulationSettings(**SMALL_GEAR)
    figures = list(outages(settings, Path(calibration), tmp_path, victims=("recorder", "localizer")))
    assert sum(figure["passed"] is True for figure in figures) >= 8
    assert not [figure for figure in figures if figure["passed"] is False]
