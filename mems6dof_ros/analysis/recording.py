"""What a bag of measurements holds, put together by frame and body."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mems6dof_ros.errors import InputError
from mems6dof_ros.frame import GroundTruth
from mems6dof_ros.localization.localizations import Localizations
from mems6dof_ros.pose.angles import paper_angles, swing_twist, swing_twist_jacobian, unwrap_near
from mems6dof_ros.pose.cycle_pose import CyclePose
from mems6dof_ros.pose.rigid import RigidPose, kabsch, shift_origin
from mems6dof_ros.recording import messages
from mems6dof_ros.recording.bag import BagReader
from mems6dof_ros.recording.tables import Table

_POSE = "mems6dof_msgs/msg/Pose6DOF"
_LOCALIZATIONS = "mems6dof_msgs/msg/Localizations"
_TRUTH = "mems6dof_msgs/msg/GroundTruth"
_FRAME_INFO = "mems6dof_msgs/msg/FrameInfo"

#: Displacement of the reference from itself, m or rad: nothing but rounding.
ZERO = 1e-12


@dataclass(frozen=True)
class Constellation:
    """Particles of a body as its poses saw them: ``particle_id`` (n,), mean ``position`` (n, 3) m in the body
    frame, ``seen`` (n,) times, ``residual_rms`` (n, 3) m."""

    particle_id: NDArray[np.int32]
    position: NDArray[np.float64]
    seen: NDArray[np.int64]
    residual_rms: NDArray[np.float64]


#: One row per body and particle, in the body frame of the last reference.
CONSTELLATION = Table(
    "constellation",
    {"body": str, "particle_id": int, "x_m": float, "y_m": float, "z_m": float, "seen": int}
    | {"residual_rms_x_m": float, "residual_rms_y_m": float, "residual_rms_z_m": float},
    lambda row: row,
)


@dataclass(frozen=True)
class Recording:
    """Measurements of one bag.

    ``poses``: of each body in the order of its frames; ``localizations`` by stamp (ns); ``truths`` by stamp
    and body; ``frames``, ``frames_dropped``: how many were produced, and lost, as the source says (0 without
    frame information).
    """

    name: str
    provenance: dict[str, str]
    poses: dict[str, list[CyclePose]]
    localizations: dict[int, Localizations]
    truths: dict[tuple[int, str], GroundTruth]
    frames: int
    frames_dropped: int

    def truth_of(self, poses: list[CyclePose]) -> list[GroundTruth | None]:
        """The truth of each pose, None where there is none."""
        return [self.truths.get((pose.stamp_ns, pose.body)) for pose in poses]

    def last_version(self, body: str) -> int:
        """The last reference version of ``body``, 0 without a valid pose."""
        return max((pose.reference_version for pose in self.poses[body] if pose.valid), default=0)

    def in_last_reference(self, body: str) -> list[CyclePose]:
        """Poses of ``body``, those of earlier reference versions expressed in the last one.

        A new reference redefines the body frame by a constant rigid motion, which is what takes the
        constellation in the one frame to the same particles in the other. Versions that share fewer
        than 3 particles with the last are left out; increments stay as they were measured.
        """
        last = self.last_version(body)
        target = self.constellation(body, last)
        latest = [pose for pose in self.poses[body] if pose.valid and pose.reference_version == last]
        origin = latest[0].translation - latest[0].displacement[:3] if latest else np.zeros(3)
        moves: dict[int, RigidPose | None] = {}
        poses = []
        for pose in self.poses[body]:
            version = pose.reference_version
            if not pose.valid or version == last:
                poses.append(pose)
                continue
            if version not in moves:
                moves[version] = _between(target, self.constellation(body, version))
            if (move := moves[version]) is not None:
                moved = move.then(RigidPose(pose.rotation, pose.translation))
                poses.append(_expressed(pose, moved, last, origin))
        return poses

    def constellation(self, body: str, version: int) -> Constellation:
        """The particles of ``body`` in its own frame of a reference version."""
        ids, positions, residuals = [], [], []
        for pose in self.poses[body]:
            found = self.localizations.get(pose.stamp_ns)
            if found is None or not pose.valid or pose.reference_version != version:
                continue
            used = pose.particle_id >= 0
            used &= np.isfinite(found.position).all(axis=1)
            ids.append(pose.particle_id[used])
            positions.append((found.position[used] - pose.translation) @ pose.rotation)
            residuals.append(pose.residual[used])
        if not ids:
            return Constellation(np.zeros(0, np.int32), np.zeros((0, 3)), np.zeros(0, int), np.zeros((0, 3)))
        every = np.concatenate(ids)
        unique, which, seen = np.unique(every, return_inverse=True, return_counts=True)
        residual = np.concatenate(residuals)
        position, square, known = (np.zeros((len(unique), 3)) for _ in range(3))
        np.add.at(position, which, np.concatenate(positions))
        np.add.at(square, which, np.nan_to_num(residual) ** 2)
        np.add.at(known, which, np.isfinite(residual))
        with np.errstate(invalid="ignore"):
            return Constellation(unique, position / seen[:, None], seen, np.sqrt(square / known))

    def constellation_rows(self, body: str) -> list[list[Any]]:
        """Rows of CONSTELLATION."""
        known = self.constellation(body, self.last_version(body))
        parts = zip(known.particle_id, known.position, known.seen, known.residual_rms, strict=True)
        return [[body, number, *position, seen, *residual] for number, position, seen, residual in parts]


def _between(target: Constellation, source: Constellation) -> RigidPose | None:
    """The rigid motion from the frame of ``target`` to that of ``source`` by the particles of both."""
    _, a, b = np.intersect1d(target.particle_id, source.particle_id, return_indices=True)
    if len(a) < 3:
        return None
    weight = np.minimum(target.seen[a], source.seen[b]).astype(float)
    return kabsch(target.position[a], source.position[b], weight)


def _expressed(pose: CyclePose, moved: RigidPose, version: int, origin: NDArray[np.float64]) -> CyclePose:
    tilt_x, tilt_y, psi = swing_twist(moved.rotation)
    angles = tilt_x, tilt_y, unwrap_near(psi, pose.displacement[5])
    displacement = np.array([*(moved.translation - origin), *angles])
    covariance = shift_origin(pose.covariance, moved.translation - pose.translation)
    jacobian = np.eye(6)
    jacobian[3:, 3:] = swing_twist_jacobian(tilt_x, tilt_y)
    of_displacement = jacobian @ covariance @ jacobian.T
    return replace(
        pose,
        reference_version=version,
        rotation=moved.rotation,
        translation=moved.translation,
        covariance=covariance,
        displacement=displacement,
        displacement_covariance=of_displacement,
        angles=paper_angles(displacement, of_displacement),
    )


def _sessions_apart(poses: list[CyclePose]) -> list[CyclePose]:
    """``poses``, references and particles of an estimator that was started again numbered on from those
    before: it counts both from the first, and they are others. Its reference is its first valid pose."""
    apart: list[CyclePose] = []
    last = versions = particles = beyond = 0
    for pose in poses:
        founded = pose.valid and pose.increment_cycles == 0 and np.abs(pose.displacement).max() < ZERO
        if founded and last and pose.reference_version + versions <= last:
            versions, particles = last, beyond
        if versions:
            moved = np.where(pose.particle_id >= 0, pose.particle_id + particles, -1).astype(np.int32)
            version = pose.reference_version + versions
            pose = replace(pose, reference_version=version, particle_id=moved)
        if pose.valid:
            last, beyond = pose.reference_version, max(beyond, int(pose.particle_id.max(initial=-1)) + 1)
        apart.append(pose)
    return apart


def load_recording(path: str | Path) -> Recording:
    """Read a bag of measurements, whatever the names of its topics; InputError where it holds no poses."""
    poses: dict[str, list[CyclePose]] = {}
    localizations: dict[int, Localizations] = {}
    truths: dict[tuple[int, str], GroundTruth] = {}
    frames = dropped = 0
    with BagReader(path) as bag:
        wanted = [t for t, kind in bag.topics.items() if kind in (_POSE, _LOCALIZATIONS, _TRUTH, _FRAME_INFO)]
        for _, kind, _, message in bag.messages(wanted):
            stamp = messages.nanoseconds(message.header.stamp)
            if kind == _POSE:
                pose = messages.to_cycle_pose(message)
                poses.setdefault(pose.body, []).append(pose)
            elif kind == _LOCALIZATIONS:
                localizations[stamp] = messages.to_localizations(message)
            elif kind == _TRUTH:
                truth = messages.to_ground_truth(message)
                truths[stamp, truth.body] = truth
            else:
                frames += 1
                dropped += int(message.frames_dropped)
        provenance = bag.provenance()
    if not poses:
        raise InputError(str(path), "no poses", f"a bag with messages of type {_POSE}")
    for body, series in poses.items():
        series.sort(key=lambda pose: (pose.stamp_ns, pose.frame_counter))
        poses[body] = _sessions_apart(series)
    where = Path(path).resolve()
    name = f"{where.parent.name}/{where.name}"
    return Recording(name, provenance, poses, localizations, truths, frames, dropped)
