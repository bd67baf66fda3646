"""Tables come back as they were written."""

from __future__ import annotations

import numpy as np
import pytest

from mems6dof_ros.errors import InputError
from mems6dof_ros.pose.cycle_pose import DEGREES_OF_FREEDOM, Status
from mems6dof_ros.recording.tables import (
    CYCLES,
    FRAMES,
    LOCALIZATIONS,
    TRUTH,
    TableWriter,
    read_table,
    sightings,
)


def written(path, table, rows, **provenance):
    with TableWriter(path, table, provenance) as writer:
        for row in rows:
            writer.write(row)
    return read_table(path, table)


def test_cycles(tmp_path, make):
    poses = [make.pose(), make.pose(Status.LOST)]
    provenance, columns = written(tmp_path / "cycles.csv", CYCLES, poses, input="run 7: first")
    assert provenance["input"] == "run 7: first"
    assert list(columns["status"]) == ["tracking", "lost"]
    assert columns["stamp_ns"][0] == poses[0].stamp_ns  # beyond what a float holds
    for i, name in enumerate(DEGREES_OF_FREEDOM):
        unit = "m" if name in ("dx", "dy", "dz") else "rad"
        assert columns[f"{name}_{unit}"][0] == poses[0].displacement[i]
        assert np.isnan(columns[f"{name}_{unit}"][1])
    assert columns["cov_dz_psi_m_rad"][0] == poses[0].displacement_covariance[2, 5]
    assert columns["cov_increment_tilt_x_tilt_y_rad2"][0] == poses[0].increment_covariance[3, 4]
    assert columns["r23"][0] == poses[0].rotation[1, 2]


def test_localizations_know_their_body_and_particle(tmp_path, make):
    found, pose = make.localizations(6), make.pose()
    pose.particle_id[:] = [-1, 4, -1, 2, 0, 1]
    _, columns = written(tmp_path / "l.csv", LOCALIZATIONS, sightings(found, [pose]))
    assert list(columns["particle_id"]) == [-1, 4, -1, 2, 0, 1]
    assert list(columns["body"]) == ["", "load_gear", "", "load_gear", "load_gear", "load_gear"]
    np.testing.assert_array_equal(columns["z_m"], found.position[:, 2])
    np.testing.assert_array_equal(columns["cov_yz_m2"], found.covariance[:, 1, 2])
    np.testing.assert_array_equal(columns["sigma_y_px"], found.fits.parameters[:, 4])
    np.testing.assert_array_equal(columns["flags"], found.flags)
    assert np.isnan(columns["residual_x_m"][0])
    assert columns["residual_x_m"][1] == pose.residual[1, 0]


def test_frames_and_truth(tmp_path, make):
    frame = make.frame()
    _, columns = written(tmp_path / "f.csv", FRAMES, [frame])
    assert columns["pixel_size_m"][0] == frame.pixel_size
    _, columns = written(tmp_path / "t.csv", TRUTH, [(frame, frame.truth[0])])
    assert columns["psi_rad"][0] == frame.truth[0].psi
    assert columns["particles"][0] == 5


def test_an_empty_table_has_its_columns(tmp_path):
    _, columns = written(tmp_path / "c.csv", CYCLES, [])
    assert set(columns) == set(CYCLES.columns)


def test_every_number_says_its_unit():
    counts = {
        "cycle",
        "frame_counter",
        "index",
        "reference_version",
        "increment_cycles",
        "particle_id",
        "flags",
    }
    dimensionless = {"rho", "chi_square", "z_gap", "flags"}
    for table in (CYCLES, LOCALIZATIONS, FRAMES, TRUTH):
        for name, kind in table.columns.items():
            unit = name.endswith(("_m", "_m2", "_rad", "_rad2", "_px", "_s", "_ns", "_adu", "_electrons"))
            rotation = name[0] == "r" and name[1:].isdigit()
            plain = name in counts | dimensionless or name.startswith(("particles", "frames_"))
            flag = name.endswith("_valid")
            assert kind is str or unit or rotation or plain or flag, name


def test_refusals(tmp_path, make):
    path = tmp_path / "c.csv"
    written(path, CYCLES, [make.pose()])
    with pytest.raises(InputError, match="table 'cycles' of format 1; expected table 'frames'"):
        read_table(path, FRAMES)
    text = path.read_text()
    path.write_text(text.replace("format: 1", "format: 2"))
    with pytest.raises(InputError, match="format 2"):
        read_table(path, CYCLES)
    path.write_text(text.replace("load_gear,tracking", "load_gear"))
    with pytest.raises(InputError, match="column"):
        read_table(path, CYCLES)
    with pytest.raises(InputError, match="absent"):
        read_table(tmp_path / "absent.csv", CYCLES)
