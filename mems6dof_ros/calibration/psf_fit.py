"""Phase retrieval: each bead's pupil from its pixels through focus, and the smooth field through all of them.

A bead's unknowns are its stage position of zero defocus, its place and the slope of its chief ray, the
pupil's Zernike coefficients and its diameter, common to all planes; light and background of every plane
are linear and eliminated there. Maximum likelihood for Poisson noise by Fisher scoring, damped after
Levenberg and Marquardt. What the beads differ in from the smooth field beyond their errors is what
particles will differ in.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mems6dof_ros.calibration.field_curves import Array
from mems6dof_ros.calibration.psf_pupil import PUPIL_TERMS, PupilImages

#: Order of a bead's parameters: stage position of zero defocus (um), place (px), slope of the chief ray
#: (px/um), coefficients (waves rms), ln of the diameter over the nominal one.
STAGE, PLACE, SLOPE = 0, slice(1, 3), slice(3, 5)
WAVEFRONT = slice(5, 5 + len(PUPIL_TERMS))
DIAMETER = WAVEFRONT.stop
COUNT = DIAMETER + 1

#: Planes of a bead that are used, at most, and how far from focus (in depths of field, lambda / NA^2).
MOST_PLANES, REACH = 12, 1.8

_PRIOR = np.concatenate([[3.0], [5.0, 5.0], [0.5, 0.5], np.full(len(PUPIL_TERMS), 0.3), [0.05]])
_ITERATIONS, _CONVERGED = 40, 0.5
_LINEAR_ITERATIONS = 4
_LEAST_MEAN = 0.1  # electrons


@dataclass(frozen=True)
class BeadWindows:
    """One bead through focus, pixel by pixel: ``corner`` (column, row) of its windows ``electrons``
    (n, side, side), at ``stage_z`` (n,) m; ``read_variance`` electrons^2."""

    corner: tuple[int, int]
    stage_z: Array
    electrons: NDArray[np.float32]
    read_variance: float

    def near(self, stage_z: float, reach: float) -> BeadWindows:
        """At most MOST_PLANES planes, evenly chosen within ``reach`` m of ``stage_z``."""
        inside = np.flatnonzero(np.abs(self.stage_z - stage_z) <= reach)
        if len(inside) > MOST_PLANES:
            inside = inside[np.linspace(0, len(inside) - 1, MOST_PLANES).round().astype(int)]
        return BeadWindows(self.corner, self.stage_z[inside], self.electrons[inside], self.read_variance)


@dataclass(frozen=True)
class Retrieval:
    """``parameters`` (COUNT,) of a bead, their ``covariance``, and ``misfit``: mean square of the relative
    error of the model, beyond noise; below zero by chance."""

    parameters: Array
    covariance: Array
    misfit: float


def retrieve(windows: BeadWindows, pupil: PupilImages, start: Array, centre: Array) -> Retrieval:
    """The pupil of one bead from ``start`` (COUNT,); ``centre`` (COUNT,): the mean of the weak prior."""
    objective = _Objective(windows, pupil)
    precision = 1 / _PRIOR**2
    parameters = start.copy()
    damping = 1e-6
    deviance, normal, gradient = objective.expand(parameters)
    cost = deviance + float(np.sum(precision * (parameters - centre) ** 2))
    misfit = objective.misfit
    for _ in range(_ITERATIONS):
        full = normal + np.diag(precision)
        right = gradient - precision * (parameters - centre)
        step = np.linalg.solve(full + damping * np.diag(np.diag(full)), right)
        trial = parameters + step
        trial[DIAMETER] = np.clip(trial[DIAMETER], -0.5, 0.5)
        if right @ step < _CONVERGED:
            parameters = trial
            break
        found = objective.expand(trial)
        found_cost = found[0] + float(np.sum(precision * (trial - centre) ** 2))
        if found_cost <= cost:
            parameters, cost = trial, found_cost
            _, normal, gradient = found
            misfit = objective.misfit
            damping = 0.1 * damping if damping > 1e-8 else 0.0
        else:
            damping = max(10 * damping, 1e-6)
            if damping > 1e6:
                break
    covariance = np.asarray(np.linalg.inv(normal + np.diag(precision)), dtype=np.float64)
    return Retrieval(parameters, covariance, misfit)


class _Objective:
    """Poisson deviance of a bead's windows and its expansion in the parameters."""

    def __init__(self, windows: BeadWindows, pupil: PupilImages) -> None:
        self._windows, self._pupil = windows, pupil
        side = windows.electrons.shape[1]
        first = pupil.side_px // 2 - side // 2
        self._cut = slice(first, first + side)
        # Read noise counts as a Poisson number of its variance (Huang et al., Nat. Methods 10, 653, 2013).
        self._data = windows.electrons.reshape(len(windows.stage_z), -1).astype(np.float64)
        self._data += windows.read_variance
        self._middle = np.array(windows.corner) + side // 2

    def expand(self, parameters: Array) -> tuple[float, Array, Array]:
        """Deviance, Fisher information and half the negative gradient at ``parameters``."""
        n = len(self._data)
        u = parameters[STAGE] - self._windows.stage_z * 1e6
        shift = parameters[PLACE] - self._middle + u[:, None] * parameters[SLOPE]
        wavefront = np.tile(parameters[WAVEFRONT], (n, 1))
        found = self._pupil.derivatives(wavefront, u * 1e-6, shift, float(np.exp(parameters[DIAMETER])))
        x, y = found.by_x, found.by_y
        slope = parameters[SLOPE]
        columns = [
            found.by_defocus * 1e-6 + slope[0] * x + slope[1] * y,
            x,
            y,
            u[:, None, None] * x,
            u[:, None, None] * y,
            *found.by_wavefront.swapaxes(0, 1),
            found.by_diameter,
        ]
        cut = (slice(None), self._cut, self._cut)
        image = found.image[cut].reshape(n, -1)
        jacobian = np.stack([column[cut].reshape(n, -1) for column in columns], axis=1)
        deviance, normal, gradient = 0.0, np.zeros((COUNT, COUNT)), np.zeros(COUNT)
        self._excess, self._signal = 0.0, 0.0
        for data, unit, tangents in zip(self._data, image, jacobian, strict=True):
            linear = np.stack([unit, np.ones_like(unit)])
            mean = np.full(len(unit), max(float(data.mean()), _LEAST_MEAN))
            for _ in range(_LINEAR_ITERATIONS):
                weight = 1 / mean
                gram = (linear * weight) @ linear.T
                light, background = np.linalg.solve(gram, linear @ (weight * data))
                mean = np.maximum(light * unit + background, _LEAST_MEAN)
            residual = data - mean
            count = np.maximum(data, _LEAST_MEAN)
            deviance += 2 * float(np.sum(mean - count + count * np.log(count / mean)))
            tangents *= light
            overlap = (tangents * weight) @ linear.T
            normal += (tangents * weight) @ tangents.T - overlap @ np.linalg.solve(gram, overlap.T)
            gradient += tangents @ (weight * residual)
            signal = np.maximum(light * unit, 0)
            self._excess += float(np.sum(signal * (weight * residual**2 - 1)))
            self._signal += float(np.sum(signal**3 * weight))
        return deviance, normal, gradient

    @property
    def misfit(self) -> float:
        """Mean square relative error m^2 of the model at the last expansion, where the light is: what is left
        over has the variance of the noise plus (m signal)^2, weighted with the signal."""
        return self._excess / max(self._signal, 1e-12)
