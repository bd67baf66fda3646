"""From the estimator's map frame to what is published: body frame, displacement, increment.

The body frame is fixed to the body; its origin is at the centre of rotation and its axes are parallel to
the microscope's in the reference pose. Origin and reference are definitions: constants with a version,
redefined only at stated moments. Definitions with a figure: docs/definitions.md.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mems6dof_ros.localization.localizations import Localizations
from mems6dof_ros.pose.angles import paper_angles, swing_twist, swing_twist_jacobian, unwrap_near
from mems6dof_ros.pose.cycle_pose import CyclePose, PaperAngles, Status
from mems6dof_ros.pose.rigid import RigidPose, lever_jacobian
from mems6dof_ros.pose.solve import FULL, LATERAL, UNUSED, Solution
from mems6dof_ros.pose.usable import Usable

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


class State(NamedTuple):
    """One valid pose of the map frame: ``psi`` unwrapped; ``covariance`` and, of it, the ``noise`` of this
    cycle alone, (6, 6)."""

    cycle: int
    pose: RigidPose
    psi: float
    covariance: Array
    noise: Array


class BodyFrame(NamedTuple):
    """Version ``version`` of the body frame.

    ``rotation`` (3, 3): of the map frame in the reference pose; ``origin`` (3,) m in the map frame; ``place``
    (3,) m: the origin in the microscope frame in the reference pose; ``psi`` rad there.
    """

    version: int
    rotation: Array
    origin: Array
    place: Array
    psi: float

    def displacement(self, state: State) -> tuple[Array, Array]:
        """Displacement (6,) from the reference (DEGREES_OF_FREEDOM), and its derivative (6, 6) by the
        disturbance of the pose of the map frame."""
        lever = state.pose.rotation @ self.origin
        tilt_x, tilt_y, twist = swing_twist(state.pose.rotation @ self.rotation.T)
        displacement = np.empty(6)
        displacement[:3] = state.pose.translation + lever - self.place
        displacement[3:] = tilt_x, tilt_y, unwrap_near(twist, state.psi - self.psi)
        jacobian = lever_jacobian(lever)
        jacobian[3:, 3:] = swing_twist_jacobian(tilt_x, tilt_y)
        return displacement, jacobian


def report(
    localizations: Localizations,
    body: str,
    frame: BodyFrame,
    state: State,
    before: State | None,
    solution: Solution,
    view: Usable,
    ids: Indices,
    expected: int,
    reason: str,
) -> CyclePose:
    """The valid pose ``state`` with everything derived from it; ``view`` and ``ids`` (n,): the
    localizations and identities of the ``solution``; ``reason`` empty: no doubts."""
    lever = state.pose.rotation @ frame.origin
    shift = lever_jacobian(lever)
    displacement, jacobian = frame.displacement(state)
    displacement_covariance = jacobian @ state.covariance @ jacobian.T
    increment, increment_covariance, span = np.full(6, np.nan), np.full((6, 6), np.nan), 0
    if before is not None:
        # The map and the field error are common to both cycles; their noise is not.
        displacement_before, jacobian_before = frame.displacement(before)
        increment = displacement - displacement_before
        increment_covariance = (
            jacobian @ state.noise @ jacobian.T + jacobian_before @ before.noise @ jacobian_before.T
        )
        span = state.cycle - before.cycle
    particle_id = np.full(len(localizations), -1, np.int32)
    residual = np.full((len(localizations), 3), np.nan)
    used, full = solution.use > UNUSED, solution.use == FULL
    particle_id[view.of[used]] = ids[used]
    residual[view.of[used]] = solution.residual[used]
    residual[view.of[solution.use == LATERAL], 2] = np.nan
    lateral = solution.residual[used, :2]
    axial = solution.residual[full & solution.tested_z, 2]
    return CyclePose(
        stamp_ns=localizations.stamp_ns,
        frame_id=localizations.frame_id,
        frame_counter=localizations.frame_counter,
        cycle=localizations.cycle,
        body=body,
        status=Status.DEGRADED if reason else Status.TRACKING,
        reason=reason,
        reference_version=frame.version,
        rotation=state.pose.rotation @ frame.rotation.T,
        translation=state.pose.translation + lever,
        covariance=shift @ state.covariance @ shift.T,
        displacement=displacement,
        displacement_covariance=displacement_covariance,
        angles=paper_angles(displacement, displacement_covariance),
        increment=increment,
        increment_covariance=increment_covariance,
        increment_cycles=span,
        residual_rms_xy=math.sqrt((lateral**2).sum() / max(2 * len(lateral) - 3, 1)),
        residual_rms_z=math.sqrt((axial**2).sum() / max(len(axial) - 3, 1)),
        chi_square=solution.chi_square / max(solution.degrees_of_freedom, 1),
        particles_used=int(used.sum()),
        particles_seen=len(localizations),
        particles_expected=expected,
        particle_id=particle_id,
        residual=residual,
        latency=localizations.latency,
    )


def no_pose(localizations: Localizations, body: str, version: int, status: Status, reason: str) -> CyclePose:
    """A cycle without a pose: all numbers NaN, and why."""
    nan, n = math.nan, len(localizations)
    nan6, nan66 = np.full(6, nan), np.full((6, 6), nan)
    return CyclePose(
        stamp_ns=localizations.stamp_ns,
        frame_id=localizations.frame_id,
        frame_counter=localizations.frame_counter,
        cycle=localizations.cycle,
        body=body,
        status=status,
        reason=reason,
        reference_version=version,
        rotation=np.full((3, 3), nan),
        translation=np.full(3, nan),
        covariance=nan66,
        displacement=nan6,
        displacement_covariance=nan66,
        angles=PaperAngles(nan, nan, nan, nan, nan, nan, False, False),
        increment=nan6,
        increment_covariance=nan66,
        increment_cycles=0,
        residual_rms_xy=nan,
        residual_rms_z=nan,
        chi_square=nan,
        particles_used=0,
        particles_seen=n,
        particles_expected=0,
        particle_id=np.full(n, -1, np.int32),
        residual=np.full((n, 3), nan),
        latency=localizations.latency,
    )
