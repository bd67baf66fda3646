from __future__ import annotations

import numpy as np
import pytest

from mems6dof_ros.localization.gaussian import cramer_rao, derivatives, gaussian, pixel_grid

PARAMETERS = np.array([0.3, -0.6, 300.0, 2.7, 3.9, -0.35, 20.0])


def test_derivatives_are_those_of_the_model() -> None:
    columns, rows = pixel_grid(21)
    found = derivatives(PARAMETERS, columns, rows)
    for k in range(7):
        step = np.zeros(7)
        step[k] = 1e-5
        expected = (
            gaussian(PARAMETERS + step, columns, rows) - gaussian(PARAMETERS - step, columns, rows)
        ) / 2e-5
        np.testing.assert_allclose(found[..., k], expected, atol=1e-6 * np.abs(expected).max())


def test_bound_without_background_is_the_textbook_one() -> None:
    """var(x) = sigma_x^2 / N, var(ln sigma) = 1 / (2 N), var(rho) = (1 - rho^2)^2 / N."""
    electrons, sigma_x, sigma_y, rho = 1e5, 2.7, 3.9, -0.35
    amplitude = electrons / (2 * np.pi * sigma_x * sigma_y * np.sqrt(1 - rho**2))
    parameters = np.array([0.0, 0.0, amplitude, sigma_x, sigma_y, rho, 1e-9])
    columns, rows = pixel_grid(61)
    # The background is known here: its row and column are left out of the information.
    information = np.linalg.inv(cramer_rao(parameters, columns, rows))[:6, :6]
    variance = np.diag(np.linalg.inv(information))
    assert variance[0] == pytest.approx(sigma_x**2 / electrons, rel=0.01)
    assert variance[1] == pytest.approx(sigma_y**2 / electrons, rel=0.01)
    assert variance[3] / sigma_x**2 == pytest.approx(1 / (2 * electrons), rel=0.01)
    assert variance[5] == pytest.approx((1 - rho**2) ** 2 / electrons, rel=0.01)


def test_read_noise_widens_the_bound() -> None:
    columns, rows = pixel_grid(21)
    without, with_noise = cramer_rao(PARAMETERS, columns, rows), cramer_rao(PARAMETERS, columns, rows, 5.0)
    assert (np.diag(with_noise) > 1.05 * np.diag(without)).all()
