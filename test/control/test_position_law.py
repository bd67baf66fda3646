"""The law that positions the gear, what it learns of the drive, and a law of one's own."""

from __future__ import annotations

import importlib.util
import math
from pathlib import Path

import numpy as np
import pytest

from mems6dof_ros.control.commands import Motion
from mems6dof_ros.control.position import DriveModel, DriveSettings
from mems6dof_ros.control.validation import SyntheticLoop, random_targets
from mems6dof_ros.errors import InputError
from mems6dof_ros.simulation.microsystem import LoadGear
from mems6dof_ros.simulation.settings import SimulationSettings

DOCS = Path(__file__).resolve().parents[2] / "docs"


def teach(model, gear, moves):
    for amplitude, direction in moves:
        before = gear.psi
        gear.advance(1, direction, amplitude)
        model.learn(Motion(1, amplitude, direction), gear.psi - before)


@pytest.mark.parametrize("seed", range(1, 6))
def test_gain_stiction_and_backlash_are_learned_from_motion(seed):
    simulation = SimulationSettings(seed=seed, step_error=0.2, backlash=0.02)
    gear, model = LoadGear(simulation), DriveModel(DriveSettings(stiction=0.25))
    rng = np.random.default_rng(seed)
    for _ in range(30):
        direction = int(rng.choice([-1, 1]))
        teach(model, gear, [(1.0, direction)] * 4 + [(0.45, direction)] * 2)
    gain = np.mean(np.diff([_after(gear, k) for k in range(40)]))
    # Means over ten cycles of 1 mrad jitter: 0.3 mrad of gain and backlash, 0.004 of stiction.
    assert model.gain == pytest.approx(gain, abs=1.5e-3)
    assert model.backlash == pytest.approx(0.02, abs=3e-3)
    assert model.stiction == pytest.approx(0.3, abs=0.02)


def _after(gear, k):
    if k:
        gear.advance()
    return gear.psi


def test_stalls_and_skipped_teeth_teach_nothing():
    model = DriveModel(DriveSettings())
    for rotation in (0.0, 2 * math.pi / 40):
        model.learn(Motion(1, 1.0, 1), rotation)
    assert model.gain == math.pi / 40


def test_the_plan_is_the_fewest_equal_cycles():
    model = DriveModel(DriveSettings())
    step = math.pi / 40
    for distance, cycles in ((0.5 * step, 1), (1.01 * step, 2), (2.5 * step, 3), (-2.5 * step, 3)):
        motion = model.plan(distance)
        assert motion.cycles == 1
        assert motion.direction == math.copysign(1, distance)
        assert model.turn(motion.amplitude) * cycles == pytest.approx(abs(distance))
    assert model.plan(5 * step).amplitude == pytest.approx(1.0)


def test_a_reversal_takes_up_the_backlash():
    model = DriveModel(DriveSettings())
    model.learn(Motion(1, 1.0, 1), model.turn(1.0))
    back = model.plan(-0.01)
    assert model.turn(back.amplitude) == pytest.approx(0.01 + 0.005)
    assert model.turn(model.plan(0.01).amplitude) == pytest.approx(0.01)


def test_an_amplitude_that_moves_nothing_is_below_stiction():
    model = DriveModel(DriveSettings(stiction=0.2))
    model.learn(Motion(1, 0.28, 1), 0.0)
    assert model.stiction == 0.28
    assert model.plan(1e-3).amplitude > 0.28


def test_a_drive_that_cannot_overcome_friction_is_refused():
    with pytest.raises(InputError, match="max_amplitude"):
        DriveSettings(stiction=0.5, max_amplitude=0.4)


def test_the_documented_example_of_a_law_of_ones_own_works_and_is_shown():
    path = DOCS / "examples" / "proportional_law.py"
    assert "examples/proportional_law.py" in (DOCS / "control.md").read_text(encoding="utf-8")
    spec = importlib.util.spec_from_file_location("proportional_law", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    drive = DriveSettings()
    for seed in (1, 2):
        loop = SyntheticLoop(SimulationSettings(seed=seed), law=module.ProportionalLaw(drive))
        for target in random_targets(10, seed):
            move = loop.go(target)
            assert not move.reason
            assert abs(move.error) < 1e-3
            assert move.cycles <= move.fewest + 20
