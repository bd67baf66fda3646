"""The calibration file: what is written is what is read; what is not a calibration is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mems6dof_ros.calibration.file import load_calibration, save_calibration
from mems6dof_ros.errors import InputError
from mems6dof_ros.localization.localizations import Flag, GaussianFits


@pytest.fixture
def path(calibrated, tmp_path):
    path = tmp_path / "optics.yaml"
    save_calibration(calibrated.calibration, path)
    return path


def test_round_trip_locates_identically(calibrated, path):
    loaded = load_calibration(path)
    assert loaded.calibration_id == calibrated.calibration.calibration_id
    for method in ("rho_amp", "joint"):
        fits = calibrated.beads[0].fits
        before = calibrated.calibration.with_method(method).locate(fits)
        after = load_calibration(path, method).locate(fits)
        np.testing.assert_array_equal(before.position, after.position)
        np.testing.assert_array_equal(before.covariance, after.covariance)
        np.testing.assert_array_equal(before.flags, after.flags)


def test_round_trip_of_the_point_spread_function(calibrated, path, particles):
    frame = particles(3, 1e5, 1.5e-6)[2]
    before = calibrated.calibration.with_method("psf").locate(frame.fits, frame.image)
    after = load_calibration(path, "psf").locate(frame.fits, frame.image)
    np.testing.assert_array_equal(before.position, after.position)
    np.testing.assert_array_equal(before.covariance, after.covariance)


def test_psf_wants_what_it_reads(calibrated):
    fits = calibrated.beads[0].fits
    with pytest.raises(InputError, match="image"):
        calibrated.calibration.with_method("psf").locate(fits)
    with pytest.raises(InputError, match="does not contain"):
        replace(calibrated.calibration, psf=None).with_method("psf")


def test_file_without_newer_sections_keeps_its_name_and_loads(calibrated, tmp_path):
    """As written before the point-spread function and the illumination were measured."""
    model = replace(calibrated.calibration.model, illumination=None)
    old = replace(calibrated.calibration, psf=None, model=model)
    save_calibration(old, tmp_path / "old.yaml")
    assert "psf" not in (tmp_path / "old.yaml").read_text().split("provenance:")[0]
    loaded = load_calibration(tmp_path / "old.yaml")
    assert loaded.psf is None
    assert loaded.model.illumination is None
    assert loaded.calibration_id == old.calibration_id


def test_nothing_unfinished_stays(path):
    assert [p.name for p in path.parent.iterdir()] == ["optics.yaml"]


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        ("format: mems6dof-calibration", "format: other", "format"),
        ("version: 1", "version: 99", "version"),
        ("pixel_size_m:", "pixel_size_inch:", "pixel_size_m"),
        ("focus_surface_m: [", "focus_surface_m: [.nan, ", "focus_surface_m"),
        ("window_px: 41", "window_px: 31", "calibration_id"),
        ("provenance:", "provenance: [", "YAML"),
    ],
)
def test_refuses_what_was_changed(path, old, new, complaint):
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(InputError, match=complaint):
        load_calibration(path)


def test_refuses_what_is_no_calibration(tmp_path):
    with pytest.raises(InputError, match=r"missing\.yaml"):
        load_calibration(tmp_path / "missing.yaml")
    binary = tmp_path / "binary.yaml"
    binary.write_bytes(b"\x80\x81\x82")
    with pytest.raises(InputError, match="calibration"):
        load_calibration(binary)


def test_truncated_file_is_refused(path):
    text = path.read_text()
    path.write_text(text[: len(text) // 2])
    with pytest.raises(InputError):
        load_calibration(path)


def test_refuses_unknown_method(path):
    with pytest.raises(InputError, match="joint"):
        load_calibration(path, "magic")


def test_flags_what_lies_beyond_the_valid_range(calibrated):
    bead = calibrated.beads[0]
    parameters = np.repeat(bead.fits.parameters[bead.in_focus][None], 4, axis=0)
    covariance = np.repeat(bead.fits.covariance[bead.in_focus][None], 4, axis=0)
    parameters[1, 0] = -1e4  # far outside the field
    parameters[2, 2] *= 1e4  # far too bright
    parameters[3] = np.nan  # a failed fit
    fits = GaussianFits(parameters, covariance, np.ones(4), np.ones(4, int), np.zeros(4, np.uint32))
    found = calibrated.calibration.locate(fits)
    assert found.flags[0] == 0
    assert found.flags[1] & Flag.OUT_OF_FIELD
    assert found.flags[2] & Flag.OUT_OF_BRIGHTNESS
    assert found.flags[3] & Flag.NO_Z
    assert np.isnan(found.position[3]).all()
