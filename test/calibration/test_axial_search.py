"""The search for defocus against the same objective in plain NumPy, looked through point by point."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.polynomial import chebyshev

from mems6dof_ros.calibration.axial_search import search_defocus

FEATURES, TERMS, PARTICLES = 5, 6, 60
GRID = np.linspace(-4e-6, 4e-6, 65)
DENSE = np.linspace(-4e-6, 4e-6, 6401)


def objective(measured, noise, local, inflation, scatter) -> np.ndarray:
    """L of one particle at DENSE."""
    residual = measured - chebyshev.chebval(DENSE / GRID[-1], local.T).T
    place = (DENSE - GRID[0]) / (GRID[1] - GRID[0])
    left = np.minimum(place.astype(int), len(GRID) - 2)
    share = (place - left)[:, None, None]
    covariance = noise + np.outer(inflation, inflation) * (
        (1 - share) * scatter[left] + share * scatter[left + 1]
    )
    chi_square = np.einsum("na,nab,nb->n", residual, np.linalg.inv(covariance), residual)
    return chi_square + np.linalg.slogdet(covariance)[1]


def minima(level: np.ndarray) -> np.ndarray:
    """Indices of the local minima, the lowest first."""
    padded = np.r_[np.inf, level, np.inf]
    found = np.flatnonzero((padded[1:-1] < padded[:-2]) & (padded[1:-1] <= padded[2:]))
    return found[np.argsort(level[found])]


@pytest.mark.parametrize("brightness", [1.0, 10.0])
def test_the_two_best_minima_are_those_of_the_objective(brightness: float) -> None:
    rng = np.random.default_rng(5)
    scale = np.exp(-0.5 * np.arange(TERMS))
    local = rng.normal(0, 1, (PARTICLES, FEATURES, TERMS)) * scale
    # Half of the particles look nearly alike on both sides of focus, as real ones do: two minima.
    local[::2, :, 1::2] *= 0.01
    root = rng.normal(0, 1, (PARTICLES, FEATURES, FEATURES))
    noise = (0.02 / brightness) ** 2 * (root @ root.transpose(0, 2, 1) + FEATURES * np.eye(FEATURES))
    steady = rng.normal(0, 1, (FEATURES, FEATURES))
    widths = 0.01 * (1 + (GRID / GRID[-1]) ** 2)
    scatter = widths[:, None, None] ** 2 * (steady @ steady.T / FEATURES + np.eye(FEATURES))
    inflation = rng.uniform(1, 1.3, (PARTICLES, FEATURES))
    true = rng.uniform(-3.5e-6, 3.5e-6, PARTICLES)
    clean = np.array([chebyshev.chebval(u / GRID[-1], c.T) for u, c in zip(true, local, strict=True)])
    measured = clean + np.array([rng.multivariate_normal(np.zeros(FEATURES), c) for c in noise])
    limits = np.tile([0, len(GRID) - 1], (PARTICLES, 1))
    basis = chebyshev.chebvander(GRID / GRID[-1], TERMS - 1)

    defocus, level, chi_square = search_defocus(
        measured, noise, local, inflation, limits, GRID, basis, scatter
    )

    assert (level[:, 0] <= np.where(np.isnan(level[:, 1]), np.inf, level[:, 1])).all()
    several = 0
    for n in range(PARTICLES):
        dense = objective(measured[n], noise[n], local[n], inflation[n], scatter)
        expected = minima(dense)
        # Gauss-Newton leaves out how C changes with defocus: worth a few hundredths of L.
        assert level[n, 0] == pytest.approx(dense[expected[0]], abs=0.1)
        assert abs(defocus[n, 0] - DENSE[expected[0]]) < 10e-9
        assert chi_square[n, 0] < 40  # 99.999 % of chi-square with 5 degrees of freedom lie below 31
        if len(expected) > 1 and dense[expected[1]] < dense[expected[0]] + 50:
            several += 1
            assert level[n, 1] == pytest.approx(dense[expected[1]], abs=1.0)
    assert several > 3, "no particle is ambiguous: the second minimum is not tested"
