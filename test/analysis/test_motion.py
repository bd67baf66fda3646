"""Analysis of many cycles, against motions that were put in."""

from __future__ import annotations

import math

import numpy as np
import pytest

from mems6dof_ros.analysis.motion import (
    order_spectrum,
    repeatability,
    rotation_per_cycle,
    separate_turning,
    uncertainty_budget,
)
from mems6dof_ros.errors import InputError


def turning(n=400, seed=1, play=100e-9, drift=(0.0, 0.0)):
    random = np.random.default_rng(seed)
    psi = np.cumsum(math.radians(4.5) + random.normal(0, 2e-3, n))
    e = np.array([150e-9, -80e-9])
    c, s = np.cos(psi), np.sin(psi)
    circle = np.column_stack([c * e[0] - s * e[1], s * e[0] + c * e[1]])
    values = np.array([20e-9, 5e-9]) + circle + np.outer(np.arange(n), drift) + random.normal(0, play, (n, 2))
    return psi, values, e


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_eccentricity_is_told_from_play(seed):
    """Four standard deviations of the estimate, 100 nm / sqrt(400) = 5 nm; drift must not leak in."""
    psi, values, e = turning(seed=seed, drift=(1e-9, -0.5e-9))
    found = separate_turning(values, psi)
    assert np.abs(found.turning - e).max() < 4 * found.sd_turning
    assert found.sd_turning == pytest.approx(5e-9, rel=0.15)
    assert found.drift == pytest.approx([1e-9, -0.5e-9], abs=0.2e-9)
    assert found.play_rms == pytest.approx([100e-9] * 2, rel=0.12)
    assert found.amplitude == pytest.approx(170e-9, abs=20e-9)
    assert (found.play_range > 400e-9).all()


def test_a_short_arc_says_that_it_cannot_tell():
    psi, values, _ = turning(n=10)
    assert separate_turning(values, psi).sd_turning > 10 * separate_turning(*turning()[1::-1]).sd_turning
    with pytest.raises(InputError, match="8 or more"):
        separate_turning(values[:5], psi[:5])


def test_steps_with_stall_and_reversal():
    step = np.full(50, 0.08)
    step[[3, 9]] = 0.0, -0.08
    span = np.ones(50, np.int64)
    span[20], step[20] = 3, 0.24
    found = rotation_per_cycle(step, np.full(50, 3e-6), span)
    assert (len(found.values), found.stalls, found.reversals) == (49, 1, 1)
    assert found.median == pytest.approx(0.08)
    assert found.noise == pytest.approx(3e-6)
    with pytest.raises(InputError, match="no increments"):
        rotation_per_cycle(step, step, span + 1)


@pytest.mark.parametrize("order", [1.0, 3.0, 80.0])
def test_spectrum_shows_an_order_and_its_amplitude(order):
    """Irregular steps keep even the tooth-mesh order apart; noise of 10 nm over 800 cycles gives 0.7 nm."""
    random = np.random.default_rng(1)
    psi = np.cumsum(random.uniform(0.02, 0.14, 800))
    values = 30e-9 * np.sin(order * psi + 0.4)[:, None] + random.normal(0, 10e-9, (800, 2))
    spectrum = order_spectrum(values, psi)
    assert spectrum.at(order) == pytest.approx([30e-9] * 2, rel=0.12)
    strongest = spectrum.order[spectrum.amplitude[:, 0].argmax()]
    assert strongest == pytest.approx(order, abs=0.2)
    assert (spectrum.at(order) > spectrum.threshold).all()


def test_white_noise_seldom_exceeds_the_threshold():
    """5 of 100 spectra, and three standard deviations of that."""
    random = np.random.default_rng(2)
    psi = np.cumsum(random.uniform(0.06, 0.1, 320))
    values = random.normal(size=(320, 100))
    spectrum = order_spectrum(values, psi, highest=30)
    assert (spectrum.amplitude > spectrum.threshold).any(axis=0).sum() <= 11
    with pytest.raises(InputError, match="one or more"):
        order_spectrum(values[:10], psi[:10])


def test_repeatability_separates_what_repeats():
    """A motion that repeats with psi cancels; 5 nm that do not remain: 3 sd of 3000 pairs from 320 cycles."""
    random = np.random.default_rng(3)
    psi = np.arange(320) * math.radians(4.5)
    displacement = np.zeros((320, 6))
    displacement[:, 0] = 100e-9 * np.sin(3 * psi) + random.normal(0, 5e-9, 320)
    displacement[:, 5] = psi
    covariance = np.tile(np.diag([5e-9] * 3 + [1e-6] * 3) ** 2, (320, 1, 1))
    found = repeatability(displacement, covariance, psi)
    assert found.rms[0] == pytest.approx(5e-9, rel=0.12)
    assert found.noise[0] == pytest.approx(5e-9)
    assert found.pairs == 80 * 6
    with pytest.raises(InputError, match="two revolutions"):
        repeatability(displacement[:50], covariance[:50], psi[:50])


def test_budget_adds_up():
    covariance = np.tile(np.diag([5e-9] * 3 + [1e-6] * 3) ** 2, (50, 1, 1))
    budget = uncertainty_budget(np.zeros((50, 6)), covariance, 2 * 0.64 * covariance)
    assert budget.noise[0] == pytest.approx(4e-9)
    assert budget.common[0] == pytest.approx(3e-9)
    assert budget.total[0] == pytest.approx(5e-9)
