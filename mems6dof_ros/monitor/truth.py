"""The simulator's truth, brought to the measurement's own origin and reference, to be drawn beside it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mems6dof_ros.frame import GroundTruth
from mems6dof_ros.pose.angles import swing_twist, unwrap_near
from mems6dof_ros.pose.cycle_pose import CyclePose
from mems6dof_ros.pose.rigid import RigidPose


class TruthAlignment:
    """True displacements of one body, aligned to the measured pose of one cycle, ``cycle``.

    The measurement chose its own body frame, so truth compares only from some cycle on: there both are
    equal by construction, and the error of the measurement in that cycle stays in all that follow. To
    look at, therefore; ``mems6dof compare`` judges accuracy.
    """

    def __init__(self, pose: CyclePose, truth: GroundTruth) -> None:
        self.cycle = pose.cycle
        self.reference_version = pose.reference_version
        measured = RigidPose(pose.rotation, pose.translation)
        self._to_true_body = measured.then(RigidPose(truth.rotation, truth.translation).inverse())
        self._reference = pose.translation - pose.displacement[:3]
        self._psi_offset = pose.displacement[5] - truth.psi

    def displacement(self, truth: GroundTruth) -> NDArray[np.float64]:
        """True displacement (6,) in the order of DEGREES_OF_FREEDOM, m and rad."""
        true = self._to_true_body.then(RigidPose(truth.rotation, truth.translation))
        tilt_x, tilt_y, psi = swing_twist(true.rotation)
        psi = unwrap_near(psi, truth.psi + self._psi_offset)
        return np.array([*(true.translation - self._reference), tilt_x, tilt_y, psi])
