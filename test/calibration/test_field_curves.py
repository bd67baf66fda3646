"""Zernike and Chebyshev bases, and the regression that never forms its design matrix."""

from __future__ import annotations

import numpy as np
import pytest

from mems6dof_ros.calibration.field_curves import BeadSamples, FieldCurves, FieldRegression
from mems6dof_ros.calibration.model_fit import _positive
from mems6dof_ros.calibration.zernike import zernike, zernike_count, zernike_order


def test_zernike_is_orthonormal_on_the_disc():
    s = np.linspace(-1, 1, 401)
    x, y = (a.ravel() for a in np.meshgrid(s, s))
    inside = x**2 + y**2 <= 1
    terms = zernike(6, x[inside], y[inside])
    gram = terms.T @ terms / inside.sum()
    np.testing.assert_allclose(gram, np.eye(zernike_count(6)), atol=0.02)


def test_zernike_orders_are_complete_sets():
    assert [zernike_order(zernike_count(n)) for n in range(9)] == list(range(9))


def test_regression_recovers_exact_curves_of_high_order():
    rng = np.random.default_rng(1)
    truth = FieldCurves(184e-6, (-4e-6, 5e-6), rng.normal(size=(2, zernike_count(3), 17)))
    beads = []
    for _ in range(40):
        x, y = rng.uniform(-130e-6, 130e-6, 2)
        u = np.linspace(-4e-6, 5e-6, 60)
        local = np.repeat(truth.local(np.array([x]), np.array([y])), len(u), axis=0)
        values = truth.values(local, u)
        beads.append(BeadSamples(x, y, u, values, np.ones_like(values)))
    found = FieldRegression(beads, truth.radius, truth.interval, 4, 16).fit(3, 16)
    assert found.coefficients == pytest.approx(truth.coefficients, abs=1e-4)


def test_slopes_are_the_derivative():
    rng = np.random.default_rng(2)
    curves = FieldCurves(184e-6, (-4e-6, 5e-6), rng.normal(size=(3, zernike_count(2), 9)))
    local = curves.local(np.array([3e-5]), np.array([-5e-5]))
    u, step = np.array([0.7e-6]), 1e-10
    numeric = (curves.values(local, u + step) - curves.values(local, u - step)) / (2 * step)
    np.testing.assert_allclose(curves.slopes(local, u), numeric, rtol=1e-4)


def test_a_feature_without_scatter_does_not_inflate_that_of_others():
    """What is left of its variance after noise may be nothing, its covariance with others not."""
    excess = np.array([[1.0, 0.05], [0.05, -1e-6]])
    found = _positive(excess, np.array([1.2, 0.5]))
    assert np.linalg.eigvalsh(found).min() > 0
    assert np.diag(found) == pytest.approx([1.0, 0.0], abs=0.01)
