"""The whole way, from rendered frames to poses, beside what the light allows: everything from a seed."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mems6dof_ros.analysis.simulated import calibrate_simulated
from mems6dof_ros.analysis.truth import TruthComparison, compare
from mems6dof_ros.frame import GroundTruth
from mems6dof_ros.localization.localizer import Localizer
from mems6dof_ros.pose.estimator import PoseEstimator
from mems6dof_ros.pose.solve import pose_jacobian
from mems6dof_ros.simulation.experiment import Experiment
from mems6dof_ros.simulation.optics import cramer_rao
from mems6dof_ros.simulation.settings import SimulationSettings
from mems6dof_ros.sources.simulator import camera_noise

Array = NDArray[np.float64]

#: Every so many cycles the bound is computed: it hardly changes.
BOUND_EVERY = 60


@dataclass(frozen=True)
class OpticalRun:
    """``comparison`` of all poses with truth; ``settled``: of those after the first revolution, in which the
    field error and the constellation are learnt; ``bound`` (6,): standard deviations that the light of all
    visible particles allows where optics and constellation are known and no two particles overlap. Means over
    all cycles: ``visible`` particles, how many were ``used``, and ``electrons`` of one."""

    comparison: TruthComparison
    settled: TruthComparison
    bound: Array
    visible: float
    used: float
    electrons: float


def optical_chain(
    seed: int,
    cycles: int,
    electrons: float = 6e4,
    method: str = "psf",
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> OpticalRun:
    """Calibrate simulated optics from focus stacks, render ``cycles`` of the turning gear, localize them by
    ``method`` (see calibration), estimate: minutes. ``seed``: of optics, camera, gear, motion and noise;
    ``electrons``: mean light of the particles in view."""
    settings = SimulationSettings.from_dict(
        {"seed": seed, "optics_seed": seed, "camera_seed": seed, "electrons": electrons}
    )
    calibration = calibrate_simulated(settings, psf=method == "psf").calibration.with_method(method)
    localizer, estimator = Localizer(camera_noise(settings), calibration), PoseEstimator()
    # Some hundred particles of random brightness, less lit at the edges, have not the mean that was set.
    in_view = Experiment(settings).frame().truth[0].electrons.mean()
    experiment = Experiment(replace(settings, electrons=electrons * electrons / float(in_view)))
    poses, truths, bounds = [], [], []
    for index in range(cycles):
        experiment.advance()
        frame = experiment.frame()
        poses.append(estimator.update(localizer.localize(frame)))
        truths.append(frame.truth[0])
        if index % BOUND_EVERY == 0:
            bounds.append(pose_bound(experiment, frame.truth[0]))
        progress(index + 1, cycles)
    comparison = compare(poses, truths)
    revolution = math.ceil(math.tau / abs(settings.step))
    settled = comparison.between(int(comparison.cycle[0]) + revolution, int(comparison.cycle[-1]))
    return OpticalRun(
        comparison,
        settled,
        np.sqrt(np.mean(bounds, axis=0)),
        visible=float(np.mean([len(truth.particle_id) for truth in truths])),
        used=float(np.mean([pose.particles_used for pose in poses])),
        electrons=float(np.concatenate([truth.electrons for truth in truths]).mean()),
    )


def pose_bound(experiment: Experiment, truth: GroundTruth) -> Array:
    """Least variances (6,) of a pose about the body's origin, by the Cramer-Rao bounds of x, y, z of the
    particles of ``truth``, each alone: ``(sum J^T S^-1 J)^-1``."""
    settings = experiment.settings
    diameter = experiment.gear.particles.diameter[truth.particle_id]
    sd = cramer_rao(
        experiment.microscope.optics, truth.position, truth.electrons, settings.background,
        diameter=diameter, read_noise=settings.read_noise,
    )[:, :3]  # fmt: skip
    body = (truth.position - truth.translation) @ truth.rotation
    jacobian = pose_jacobian(body, truth.rotation)
    return np.asarray(np.diag(np.linalg.inv(np.einsum("nia,ni,nib->ab", jacobian, sd**-2, jacobian))))
