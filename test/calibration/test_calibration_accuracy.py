"""z of held-out particles against simulation truth: other beads than those calibrated from."""

from __future__ import annotations

import numpy as np
import pytest


@pytest.mark.parametrize(
    ("method", "electrons", "limit"),
    [("rho_amp", 3e4, 80e-9), ("joint", 3e4, 60e-9), ("rho_amp", 1e5, 70e-9), ("joint", 1e5, 50e-9)],
)
def test_z_of_other_beads(calibrated, measured, method, electrons, limit):
    held = measured(calibrated.calibration.with_method(method), 3, electrons, 1.5e-6)
    rms = np.sqrt(np.mean(held.z_error**2))
    chi = np.sqrt(np.mean((held.z_error / held.z_sd) ** 2))
    print(
        f"{method}, {electrons:g} electrons: {rms * 1e9:.1f} nm rms, claimed/actual {1 / chi:.2f}, "
        f"{np.count_nonzero(held.good)} of {len(held.good)}"
    )
    assert np.mean(held.good) > 0.9
    assert rms < limit
    assert 0.75 < chi < 1.3
