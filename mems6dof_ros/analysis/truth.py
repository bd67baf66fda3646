"""Comparison of measured poses with truth.

Two things are definitions, not measurements, and cannot be compared directly:

- where the body frame lies *in the body*: chosen by the estimator from its first cycles, by the simulator
  in its drawing;
- where the microscope frame lies *in the microscope*: chosen by the optical calibration, whose plane z = 0
  and whose zero of x and y no rotating body can check.

Both are constant. So ``T_measured = L T_true G`` with two rigid motions, L (the microscope's, one for all)
and G (the body's, one for each reference version), fitted to all cycles at once; what then differs is
error. Neither can hide anything that changes from cycle to cycle. L is reported as
``TruthComparison.microscope``: its translation cancels in every displacement, its tilts say how far the
calibrated plane is off, and ``fit_microscope=False`` counts them as error.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mems6dof_ros.errors import InputError
from mems6dof_ros.frame import GroundTruth
from mems6dof_ros.pose.cycle_pose import DEGREES_OF_FREEDOM, CyclePose
from mems6dof_ros.pose.rigid import IDENTITY, RigidPose, exp_so3, lever_jacobian, log_so3

Array = NDArray[np.float64]


@dataclass(frozen=True)
class TruthComparison:
    """Errors of n valid poses against truth, in order of arrival.

    ``cycle`` (n,), ``reference_version`` (n,); ``error`` (n, 6), measured minus true, m and rad: translation
    of the body's origin and rotation vector about the fixed axes, to first order the errors of
    DEGREES_OF_FREEDOM; ``claimed`` (n, 6) standard deviations; ``nees`` (n,) normalised estimation error
    squared, 6 on average where the covariance is honest. ``microscope``: L, see above. ``fitted``: number of
    constants fitted, per degree of freedom.
    """

    cycle: NDArray[np.int64]
    reference_version: NDArray[np.int64]
    error: Array
    claimed: Array
    nees: Array
    microscope: RigidPose
    fitted: int

    @property
    def rms(self) -> Array:
        """Rms error (6,), corrected for the constants fitted."""
        return np.asarray(np.sqrt((self.error**2).sum(axis=0) / max(len(self.error) - self.fitted, 1)))

    @property
    def claimed_rms(self) -> Array:
        """Root mean square (6,) of the standard deviations claimed."""
        return np.asarray(np.sqrt((self.claimed**2).mean(axis=0)))

    @property
    def nees_per_dof(self) -> float:
        """Mean NEES over 6, corrected for the constants fitted: 1 where the covariances are honest."""
        return float(self.nees.sum() / (6 * max(len(self.nees) - self.fitted, 1)))

    def between(self, first: int, last: int) -> TruthComparison:
        """The cycles ``first`` to ``last``, inclusive, with the constants fitted to all."""
        keep = (self.cycle >= first) & (self.cycle <= last)
        share = round(self.fitted * keep.mean())
        parts = {
            name: getattr(self, name)[keep]
            for name in ("cycle", "reference_version", "error", "claimed", "nees")
        }
        return replace(self, **parts, fitted=share)

    def table(self) -> list[tuple[str, float, float]]:
        """(degree of freedom, rms error, rms claimed) in SI units."""
        return list(zip(DEGREES_OF_FREEDOM, self.rms.tolist(), self.claimed_rms.tolist(), strict=True))


def compare(
    poses: Sequence[CyclePose], truths: Sequence[GroundTruth | None], fit_microscope: bool = True
) -> TruthComparison:
    """Compare ``poses`` with the ``truths`` of the same frames, pairwise; invalid poses, and those whose
    truth is not known (None), are skipped.

    ``fit_microscope`` False: the microscope frame is taken as true (L = 1). Raises InputError where
    nothing is left or the lengths differ.
    """
    if len(poses) != len(truths):
        raise InputError(
            "truth comparison", f"{len(poses)} poses, {len(truths)} truths", "one truth per pose"
        )
    pairs = [
        (pose, truth) for pose, truth in zip(poses, truths, strict=True) if pose.valid and truth is not None
    ]
    if not pairs:
        raise InputError("truth comparison", "no valid pose with its truth", "at least one")
    microscope, bodies = _fit_constants(pairs, fit_microscope)
    error = np.array([_pose_error(p, t, microscope, bodies[p.reference_version]) for p, t in pairs])
    covariance = np.array([pose.covariance for pose, _ in pairs])
    return TruthComparison(
        cycle=np.array([pose.cycle for pose, _ in pairs]),
        reference_version=np.array([pose.reference_version for pose, _ in pairs]),
        error=error,
        claimed=np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)),
        nees=np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance), error),
        microscope=microscope,
        fitted=len(bodies) + fit_microscope,
    )


def _pose_error(pose: CyclePose, truth: GroundTruth, microscope: RigidPose, body: RigidPose) -> Array:
    expected = body.then(RigidPose(truth.rotation, truth.translation)).then(microscope)
    return np.r_[pose.translation - expected.translation, log_so3(pose.rotation @ expected.rotation.T)]


def _fit_constants(
    pairs: Sequence[tuple[CyclePose, GroundTruth]], fit_microscope: bool
) -> tuple[RigidPose, dict[int, RigidPose]]:
    """L and, by reference version, G: weighted least squares, of least norm where the motion cannot tell
    one from the other (a rotation about z belongs to both)."""
    microscope = IDENTITY
    bodies: dict[int, RigidPose] = {}
    for pose, truth in pairs:
        true = RigidPose(truth.rotation, truth.translation)
        bodies.setdefault(
            pose.reference_version, RigidPose(pose.rotation, pose.translation).then(true.inverse())
        )
    versions = {version: 6 * (i + 1) for i, version in enumerate(sorted(bodies))}
    size = 6 * (len(bodies) + 1)
    # Scales of the parameters (micrometre, milliradian), so that the least norm means something.
    scale = np.tile(np.r_[np.full(3, 1e-6), np.full(3, 1e-3)], len(bodies) + 1)
    weights = [np.linalg.inv(pose.covariance) for pose, _ in pairs]
    for _ in range(6):
        normal, right = np.zeros((size, size)), np.zeros(size)
        for (pose, truth), weight in zip(pairs, weights, strict=True):
            jacobian = np.zeros((6, size))
            at = versions[pose.reference_version]
            turned = microscope.rotation @ truth.rotation
            jacobian[:3, at : at + 3] = jacobian[3:, at + 3 : at + 6] = turned
            if fit_microscope:
                place = truth.rotation @ bodies[pose.reference_version].translation + truth.translation
                jacobian[:, :6] = lever_jacobian(microscope.rotation @ place)
            weighted = weight @ jacobian
            normal += jacobian.T @ weighted
            right += weighted.T @ _pose_error(pose, truth, microscope, bodies[pose.reference_version])
        normal *= np.outer(scale, scale)
        step = scale * np.linalg.lstsq(normal, scale * right, rcond=1e-12)[0]
        microscope = _moved(microscope, step[:6])
        bodies = {version: _moved(body, step[versions[version] :][:6]) for version, body in bodies.items()}
        if (
            np.abs(step.reshape(-1, 2, 3)[:, 0]).max() < 1e-13
            and np.abs(step.reshape(-1, 2, 3)[:, 1]).max() < 1e-10
        ):
            break
    return microscope, bodies


def _moved(pose: RigidPose, step: Array) -> RigidPose:
    return RigidPose(exp_so3(np.asarray(step[3:])) @ pose.rotation, pose.translation + step[:3])
