"""The device clock against simulated clocks, of which the truth is known."""

from __future__ import annotations

import math

import numpy as np
import pytest

from mems6dof_ros.sources.cameras.clock import DeviceClock

EPOCH = 5_000_000_000_000


def simulate(seed: int, drift: float, jitter_s: float, seconds: float = 40.0, rate: float = 90.0):
    """Device and host times, ns, and the arrivals: never early, mostly on time, sometimes much too late."""
    rng = np.random.default_rng(seed)
    device = np.arange(0, seconds, 1 / rate) * 1e9
    truth = EPOCH + device * (1 + drift)
    late = rng.exponential(jitter_s, device.size) + (rng.random(device.size) < 0.02) * rng.uniform(
        0, 0.1, device.size
    )
    return device.astype(int), truth, (truth + late * 1e9).astype(int)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("drift", [0.0, 8e-5, -8e-5])
@pytest.mark.parametrize("jitter_s", [1e-4, 2e-3])
def test_follows_a_drifting_clock_within_the_stated_uncertainty(seed, drift, jitter_s):
    clock = DeviceClock()
    errors, stated = [], []
    for device, truth, arrival in zip(*simulate(seed, drift, jitter_s), strict=True):
        clock.add(device, arrival)
        errors.append((clock.to_host(device) - truth) * 1e-9)
        stated.append(clock.uncertainty)
    late = slice(len(errors) // 2, None)
    rms = math.sqrt(np.mean(np.square(errors[late])))
    # 22 arrivals share a bin, so the quickest of a bin is late by jitter / 22 in the mean.
    assert rms < jitter_s / 10
    assert rms < 2 * np.median(stated[late])
    assert np.median(stated[late]) < jitter_s / 5
    assert clock.drift == pytest.approx(drift, abs=2 * jitter_s / 22 / 10)


def test_says_nothing_of_its_uncertainty_before_it_can_know():
    clock = DeviceClock()
    clock.add(0, EPOCH)
    assert math.isnan(clock.uncertainty)
    assert clock.to_host(10**9) == EPOCH + 10**9


def test_a_late_first_arrival_is_forgotten():
    clock = DeviceClock()
    clock.add(0, EPOCH + 80_000_000)
    for k in range(1, 200):
        clock.add(k * 10_000_000, EPOCH + k * 10_000_000)
    assert abs(clock.to_host(2_000_000_000) - EPOCH - 2_000_000_000) < 1000
