"""Many recordings on a cluster give what they give one after another."""

from __future__ import annotations

from pathlib import Path

import pytest

from mems6dof_ros.analysis.many_recordings import Job, analyze_many, cluster
from mems6dof_ros.cli.main import main
from mems6dof_ros.errors import InputError
from mems6dof_ros.recording.frames import write_bag
from mems6dof_ros.simulation.experiment import motion_frames
from mems6dof_ros.simulation.settings import SimulationSettings
from mems6dof_ros.sources.simulator import camera_noise

CALIBRATION = Path(__file__).parents[2] / "bags" / "sample_calibration.yaml"
RESULTS = ("cycles.csv", "localizations.csv", "load_gear_constellation.json")


@pytest.fixture(scope="module")
def bags(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Three recordings of other gears with the optics of the sample calibration."""
    directory, paths = tmp_path_factory.mktemp("bags"), []
    for seed in (1, 2, 3):
        settings = SimulationSettings(
            seed=seed, width_px=384, height_px=384, gear_diameter=60e-6, hub_diameter=4e-6, particles=40
        )
        paths.append(directory / f"run_{seed}")
        write_bag(paths[-1], list(motion_frames(settings, 6)), camera_noise(settings), {}, lambda done: None)
    return paths


def jobs(bags: list[Path], out: Path) -> list[Job]:
    return [Job(bag, CALIBRATION, out / bag.name) for bag in bags]


def test_a_cluster_changes_no_digit(bags: list[Path], tmp_path: Path) -> None:
    pytest.importorskip("distributed")
    serial = analyze_many(jobs(bags, tmp_path / "serial"))
    with cluster(processes=2) as client:
        assert client is not None
        spread = analyze_many(jobs(bags, tmp_path / "spread"), client)
    assert [(o.frames, o.valid, o.error) for o in serial] == [(6, 6, "")] * 3
    assert [(o.job.input, o.frames, o.valid) for o in spread] == [(o.job.input, 6, 6) for o in serial]
    for bag in bags:
        for name in RESULTS:
            one, other = (tmp_path / way / bag.name / name for way in ("serial", "spread"))
            assert one.read_bytes() == other.read_bytes()


def test_a_recording_that_fails_leaves_the_others(
    bags: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    command = ["analyze-many", str(tmp_path / "none"), str(bags[0]), "--calibration", str(CALIBRATION)]
    assert main([*command, "--out", str(tmp_path / "out")]) == 1
    printed = capsys.readouterr()
    assert "run_1: frames 6, poses 6, valid 6" in printed.out
    assert "none: " in printed.err
    assert (tmp_path / "out" / "run_1" / "cycles.csv").exists()


def test_recordings_of_one_name_are_refused(bags: list[Path], tmp_path: Path) -> None:
    with pytest.raises(InputError, match="different names"):
        analyze_many(jobs([bags[0], bags[0]], tmp_path))


def test_a_scheduler_that_does_not_answer_is_told(tmp_path: Path) -> None:
    pytest.importorskip("distributed")
    with pytest.raises(InputError, match="scheduler"), cluster("no://where"):
        pass
