"""What is wrong with a focus stack that could be fitted nevertheless: step, direction, drift."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from mems6dof_ros.calibration.model_fit import GROUPS, BeadCurve, ModelFit, sharpest_stage
from mems6dof_ros.calibration.optical_model import OpticalModel

#: Growth of sqrt(sigma_x sigma_y) per defocus over tan(aperture angle), both sides averaged: a uniform disc
#: would give 0.5; Gaussians fitted to simulated 1 um spheres at NA 0.55 give 0.37 to 0.44.
_GROWTH, _GROWTH_RANGE = 0.41, (0.28, 0.60)
#: Lateral motion with defocus common to all beads, m/m: telecentric objectives stay well below.
_MOST_DRIFT = 0.1
#: Departure of one plane from its neighbours, common to all beads, m.
_MOST_STAGE_ERROR = 60e-9
_MOST_JUMP = 30e-9
#: Relative deviation of the step from that of a reference.
_MOST_STEP_RATIO = 1.08


def step_against_aperture(
    curves: Sequence[BeadCurve], pixel_size: float, numerical_aperture: float
) -> list[str]:
    """Does defocus widen the images as the aperture's cone demands? Finds steps wrong by half or more."""
    growth = []
    for side in (1, -1):
        slopes = []
        for curve in curves:
            u = side * (sharpest_stage(curve) - curve.stage_z)
            far = u > 0.5 * u.max()
            if np.count_nonzero(far) >= 3:
                size = np.exp(0.5 * (curve.features[:, 2] + curve.features[:, 3])) * pixel_size
                slopes.append(np.polyfit(u[far], size[far], 1)[0])
        if slopes:
            growth.append(float(np.median(slopes)))
    ratio = float(np.mean(growth)) / math.tan(math.asin(numerical_aperture)) if growth else _GROWTH
    if _GROWTH_RANGE[0] <= ratio <= _GROWTH_RANGE[1]:
        return []
    return [
        f"the stage step seems wrong by a factor of about {_GROWTH / ratio:.2g}: the images widen by "
        f"{np.mean(growth):.2g} um per um, NA {numerical_aperture:g} leads to expect "
        f"{_GROWTH * math.tan(math.asin(numerical_aperture)):.2g}"
    ]


def against_reference(curves: Sequence[BeadCurve], reference: OpticalModel, name: str) -> list[str]:
    """Step and direction relative to an earlier calibration, or another stack, of the same optics."""
    ratios = np.concatenate([-np.geomspace(3, 1 / 3, 45), np.geomspace(1 / 3, 3, 45)])
    misfit = [float(np.mean([_misfit(curve, reference, ratio) for curve in curves])) for ratio in ratios]
    best = float(ratios[int(np.argmin(misfit))])
    if best < 0:
        return [f"the direction of the stage is reversed against {name}"]
    if max(best, 1 / best) > _MOST_STEP_RATIO:
        return [f"the stage step differs from that of {name} by a factor of {1 / best:.2g}"]
    return []


def _misfit(curve: BeadCurve, reference: OpticalModel, ratio: float) -> float:
    """Mean square difference of shapes where the bead's defocus is ``ratio`` times what the stage says."""
    u = ratio * (sharpest_stage(curve) - curve.stage_z)
    low, high = reference.curves.interval
    inside = (u > low) & (u < high)
    if np.count_nonzero(inside) < 4:
        return 1.0
    local = reference.curves.local(np.array([curve.x]), np.array([curve.y]))[0]
    predicted = reference.curves.basis(u[inside]) @ local.T
    return float(np.mean((curve.features[inside] - predicted)[:, GROUPS["shape"]] ** 2))


def drift(fit: ModelFit, curves: Sequence[BeadCurve]) -> list[str]:
    """Lateral drift of the stage over the stack, as far as it is steady."""
    x, y = (np.array([getattr(curve, axis) for curve in curves]) for axis in "xy")
    slope = fit.model.curves.slopes(fit.model.curves.local(x, y), np.zeros(len(x)))[:, GROUPS["lateral"]]
    common = float(np.hypot(*np.mean(slope, axis=0)))
    if common < _MOST_DRIFT:
        return []
    return [
        f"drift: all beads move sideways by {common * 1e3:.0f} nm per um of stage; the stage drifts or "
        "the light is far from telecentric"
    ]


def stage_errors(fit: ModelFit, curves: Sequence[BeadCurve]) -> list[str]:
    """Planes whose position, axial or lateral, departs from what all beads say in common."""
    planes: dict[tuple[int, float], list[list[float]]] = {}
    for curve, sharpest, u, residual in zip(curves, fit.sharpest, fit.defocus, fit.residual, strict=True):
        position = np.full(len(u), curve.x), np.full(len(u), curve.y)
        slope = fit.model.curves.slopes(fit.model.curves.local(*position), u)[:, GROUPS["shape"]]
        weight = 1 / np.einsum("nkk->nk", fit.model.scatter_at(u))[:, GROUPS["shape"]]
        information = np.sum(weight * slope**2, axis=1)
        axial = np.sum(weight * slope * residual[:, GROUPS["shape"]], axis=1) / information
        at = np.round(sharpest - u, 10)
        for stage_z, *values in zip(at, axial, residual[:, 0], residual[:, 1], strict=True):
            planes.setdefault((curve.stack, float(stage_z)), []).append(values)
    found = []
    for (stack, stage_z), values in sorted(planes.items()):
        if len(values) < 5:
            continue
        axial_error, *lateral = np.median(np.array(values), axis=0)
        where = f"stack {stack + 1}, stage at {stage_z * 1e6:.2f} um"
        if abs(axial_error) > _MOST_STAGE_ERROR:
            found.append(f"{where}: the stage seems {axial_error * 1e9:+.0f} nm off")
        if max(map(abs, lateral)) > _MOST_JUMP:
            found.append(
                f"drift: {where}: all beads have jumped sideways by {np.hypot(*lateral) * 1e9:.0f} nm"
            )
    return found[:5]
