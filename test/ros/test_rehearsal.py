"""What nodes compile, or load from the cache, before their first frame."""

from __future__ import annotations

import subprocess
import sys

import pytest
from peers import SMALL_GEAR

PROGRAM = """
import gc, sys
from numba.core.registry import CPUDispatcher
from mems6dof_ros.calibration.file import load_calibration
from mems6dof_ros.localization.localizer import Localizer
from mems6dof_ros.nodes import localizer as node, pose_estimator
from mems6dof_ros.pose.estimator import PoseEstimator, PoseSettings
from mems6dof_ros.simulation.experiment import motion_frames
from mems6dof_ros.simulation.settings import SimulationSettings

def known():
    rooms = ("mems6dof_ros.localization", "mems6dof_ros.calibration", "mems6dof_ros.pose")
    found = (each for each in gc.get_objects() if isinstance(each, CPUDispatcher))
    return {(each.py_func.__name__, str(kind)) for each in found if each.__module__.startswith(rooms)
            for kind in each.signatures}

calibration = load_calibration(sys.argv[1], sys.argv[2])
localizer = Localizer(calibration.camera, calibration)
node.rehearse(localizer)
pose_estimator.rehearse(PoseSettings())
before = known()
assert before
estimator = PoseEstimator()
for frame in motion_frames(SimulationSettings(**eval(sys.argv[3])), 3):
    estimator.update(localizer.localize(frame))
print(*sorted(known() - before), sep="\\n")
"""


@pytest.mark.parametrize("method", ["rho_amp", "joint"])
def test_the_first_frame_waits_for_no_compiler(calibration: str, method: str) -> None:
    command = [sys.executable, "-c", PROGRAM, calibration, method, repr(SMALL_GEAR)]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (result.returncode, result.stdout.strip()) == (0, ""), result.stderr
