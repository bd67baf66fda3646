"""Several rigid bodies in one field, each with a pose, and the motion of one relative to another."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from mems6dof_ros.errors import InputError
from mems6dof_ros.localization.localizations import Localizations
from mems6dof_ros.pose.cycle_pose import CyclePose
from mems6dof_ros.pose.estimator import PoseEstimator
from mems6dof_ros.pose.field import FieldError
from mems6dof_ros.pose.rigid import RigidPose, hat
from mems6dof_ros.pose.usable import usable

Array = NDArray[np.float64]

#: Settings that bodies in one field have in common, because they see it through the same optics.
COMMON_SETTINGS = ("reference", "field_size", "field_degree", "field_sd_xy", "field_sd_z")


class Bodies:
    """One PoseEstimator per body; a localization that one body claims is not offered to the next.

    They are seen through the same optics, so they share one estimate of the field error, as good as that of
    one body with all the particles. Raises InputError where a body cannot be told from the others (with
    several, each needs a region or a reference constellation, and a name of its own) and where their
    COMMON_SETTINGS differ.
    """

    def __init__(self, estimators: Sequence[PoseEstimator]) -> None:
        names = [estimator.body for estimator in estimators]
        if not names or len(set(names)) != len(names):
            raise InputError("bodies", str(names), "one or more different names")
        for estimator in estimators:
            if len(names) > 1 and estimator.region is None and estimator.reference is None:
                raise InputError(f"body {estimator.body}", "neither", "a region or a reference constellation")
        for name in COMMON_SETTINGS:
            if len(values := {getattr(estimator.settings, name) for estimator in estimators}) > 1:
                raise InputError(f"bodies: {name}", str(values), "the same for all: they share one field")
        self.estimators = tuple(estimators)

    def update(self, localizations: Localizations) -> list[CyclePose]:
        """Poses of this cycle, in the order of the bodies."""
        self._share_field(localizations)
        available = np.ones(len(localizations), bool)
        poses = []
        for estimator in self.estimators:
            pose = estimator.update(localizations, available)
            available &= pose.particle_id < 0
            poses.append(pose)
        return poses

    def learn(self) -> None:
        """Refine the maps by the latest cycle, see PoseEstimator.learn."""
        for estimator in self.estimators:
            estimator.learn()

    def measured_field(self) -> FieldError:
        """The field error by all cycles so far. Raises InputError before the first."""
        self.learn()
        constellations = [estimator.constellation for estimator in self.estimators if estimator.constellation]
        if not constellations:
            raise InputError("field error", "no cycle yet", "cycles of a body that turns")
        for constellation in constellations:
            constellation.refine()
        return constellations[0].field

    def reset(self) -> None:
        """Forget everything measured of all bodies."""
        for estimator in self.estimators:
            estimator.reset()

    def _share_field(self, localizations: Localizations) -> None:
        """One field error for all, over the field as all their particles show it."""
        settings = self.estimators[0].settings
        if len(self.estimators) == 1 or self.estimators[0].field is not None:
            return
        view = usable(localizations, beyond=settings.beyond_calibration)
        seen = view.position[view.good, :2]
        if len(seen) >= settings.min_particles:
            field = FieldError.assumed(settings, np.abs(seen).max(axis=0))
            for estimator in self.estimators:
                estimator.field = field


def relative_pose(of: CyclePose, to: CyclePose) -> tuple[RigidPose, Array]:
    """Pose of the body ``of`` in the body frame of ``to``, both of one cycle, with covariance (6, 6) in
    (x, y, z, rotation about the axes of ``to``); the two are measured independently."""
    back = RigidPose(to.rotation, to.translation).inverse()
    pose = RigidPose(of.rotation, of.translation).then(back)
    by_of = np.zeros((6, 6))
    by_of[:3, :3] = by_of[3:, 3:] = back.rotation
    by_to = -by_of
    by_to[:3, 3:] = back.rotation @ hat(of.translation - to.translation)
    return pose, by_of @ of.covariance @ by_of.T + by_to @ to.covariance @ by_to.T
