"""The simulator's truth, brought to the measurement's own origin and reference, to be drawn beside it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mems6dof_ros.frame import GroundTruth
from mems6dof_ros.pose.angles import swing_twist, unwrap_near
from mems6dof_ros.pose.cycle_pose import CyclePose
from mems6dof_ros.pose.rigid import RigidPose


class TruthAlignment:
    """True displacements of one body within one version of the reference.

    The measurement chose its own body frame, so truth compares only up to one fixed transform between both
    frames. It is the mean over the first ``CYCLES`` pairs, so that its noise is small beside that of a
    cycle; an error common to them stays hidden. To look at, therefore: a report judges accuracy.
    """

    CYCLES = 40

    def __init__(self, reference_version: int) -> None:
        self.reference_version = reference_version
        self.cycles: list[int] = []
        self._rotations = np.zeros((3, 3))
        self._translations = np.zeros(3)
        self._own_body: RigidPose | None = None  # to the true one

    def add(self, pose: CyclePose, truth: GroundTruth) -> NDArray[np.float64] | None:
        """True displacement (6,) of ``pose``, m and rad, in the order of DEGREES_OF_FREEDOM.

        None until enough pairs have been added.
        """
        true = RigidPose(truth.rotation, truth.translation)
        if self._own_body is None:
            between = RigidPose(pose.rotation, pose.translation).then(true.inverse())
            self._rotations += between.rotation
            self._translations += between.translation
            self.cycles.append(pose.cycle)
            if len(self.cycles) == self.CYCLES:
                # The rotation nearest to the mean matrix (Moakher 2002, the mean in the Frobenius metric).
                u, _, vt = np.linalg.svd(self._rotations)
                self._own_body = RigidPose(u @ vt, self._translations / self.CYCLES)
            return None
        own = self._own_body.then(true)
        reference = pose.translation - pose.displacement[:3]
        tilt_x, tilt_y, psi = swing_twist(own.rotation)
        psi = unwrap_near(psi, pose.displacement[5])
        return np.array([*(own.translation - reference), tilt_x, tilt_y, psi])
