"""The second layer of a calibration: kept in its file, applied to positions, refined by later sessions."""

from __future__ import annotations

import numpy as np
import pytest

from mems6dof_ros.calibration.field_correction import FieldCorrection
from mems6dof_ros.calibration.field_modes import FieldModes
from mems6dof_ros.calibration.file import Calibration, load_calibration, save_calibration
from mems6dof_ros.errors import InputError

MODES = FieldModes((40e-6, 40e-6), 3)


@pytest.fixture
def corrected(calibrated) -> Calibration:
    random = np.random.default_rng(1)
    mean = random.normal(0, 3e-9, len(MODES))
    root = random.normal(0, 1e-10, (len(MODES), len(MODES)))
    correction = FieldCorrection(
        MODES, mean, root @ root.T + 1e-22 * np.eye(len(MODES)), "joint", {"recordings": ["a"]}
    )
    return calibrated.calibration.with_correction(correction)


def test_round_trip(corrected, tmp_path):
    path = tmp_path / "optics.yaml"
    save_calibration(corrected, path)
    loaded = load_calibration(path)
    assert loaded.calibration_id == corrected.calibration_id
    np.testing.assert_array_equal(loaded.correction.mean, corrected.correction.mean)
    np.testing.assert_array_equal(loaded.correction.covariance, corrected.correction.covariance)
    assert (loaded.correction.modes, loaded.correction.provenance) == (MODES, {"recordings": ["a"]})
    assert "version: 2" in path.read_text()


def test_a_correction_makes_another_calibration_and_without_it_files_stay_as_they_were(
    calibrated, corrected, tmp_path
):
    assert corrected.calibration_id != calibrated.calibration.calibration_id
    assert corrected.with_correction(None).calibration_id == calibrated.calibration.calibration_id
    save_calibration(corrected.with_correction(None), tmp_path / "optics.yaml")
    assert "version: 1" in (tmp_path / "optics.yaml").read_text()


def test_positions_lose_the_error_and_nothing_else_changes(calibrated, corrected):
    fits = calibrated.beads[0].fits
    before, after = calibrated.calibration.locate(fits), corrected.locate(fits)
    error = MODES.evaluate(before.position) @ corrected.correction.mean
    assert np.nanmax(np.abs(error)) > 1e-9
    np.testing.assert_allclose(before.position - after.position, error, atol=1e-18)
    np.testing.assert_array_equal(before.covariance, after.covariance)
    np.testing.assert_array_equal(before.flags, after.flags)


def test_remaining_covariance_is_that_of_the_coefficients(corrected):
    """4 000 draws of the coefficients: covariances to 1.6 % of the variances, four times that allowed."""
    correction = corrected.correction
    draws = np.random.default_rng(2).multivariate_normal(
        np.zeros(len(MODES)), correction.covariance * 1e18, 4000
    )
    place = np.array([[30e-6, -20e-6, 0.0]])
    errors = draws * 1e-9 @ MODES.evaluate(place)[0].T
    claimed = correction.remaining(place)[0]
    np.testing.assert_allclose(np.cov(errors.T), claimed, rtol=0, atol=0.064 * claimed.max())


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        ("degree: 3", "degree: 2", "modes"),
        ("coefficients_m: [", "coefficients_m: [1.0e-9, ", "field correction"),
        ("coefficients_m: [", "coefficients_m: [.nan, ", "coefficients_m"),
        ("half_size_m: [4.0e-05", "half_size_m: [4.1e-05", "calibration_id"),
    ],
)
def test_refuses_what_was_changed(corrected, tmp_path, old, new, complaint):
    path = tmp_path / "optics.yaml"
    save_calibration(corrected, path)
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(InputError, match=complaint):
        load_calibration(path)


def test_refuses_another_method_than_it_was_measured_with(corrected):
    with pytest.raises(InputError, match="with which the field correction was measured"):
        corrected.with_method("rho_amp")
    assert corrected.with_correction(None).with_method("rho_amp").method == "rho_amp"


def test_refuses_a_covariance_that_is_none():
    bad = np.eye(len(MODES)) * 1e-18
    bad[0, 0] = -1e-18
    with pytest.raises(InputError, match="positive definite"):
        FieldCorrection(MODES, np.zeros(len(MODES)), bad, "joint")
