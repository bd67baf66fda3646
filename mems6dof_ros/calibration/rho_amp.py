"""The paper's axial feature, rho_amp = rho / A_n, with A_n = A / A(rho*).

A(rho*) is the amplitude in the image of that particle with the smallest |rho|. A calibration bead has
such an image; a particle on the gear, which never scans z, does not. Its fitted flux stands in: the ratio
of A(rho*) to flux depends on the place in the field only and is mapped there, and the calibration curves
use the same substitute. (Copeland et al., axial calibration.)
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mems6dof_ros.calibration.field_curves import Array, BeadSamples, FieldCurves, FieldRegression
from mems6dof_ros.calibration.focus_stack import BeadStack
from mems6dof_ros.calibration.model_fit import BeadCurve
from mems6dof_ros.calibration.optical_model import FEATURES, FieldMap, field_position
from mems6dof_ros.calibration.zernike import zernike, zernike_count

#: Far out of focus rho returns to zero without meaning; rho* is looked for within this of focus.
_NEAR_FOCUS = 1.5e-6


def reference_plane(bead: BeadStack) -> int:
    """Index of the image at rho*: the smallest |rho| near focus."""
    near = np.abs(bead.stage_z - bead.stage_z[bead.in_focus]) <= _NEAR_FOCUS
    return int(np.argmin(np.where(near, np.abs(bead.fits.parameters[:, 5]), np.inf)))


def rho_amp_of_scan(bead: BeadStack) -> Array:
    """The paper's rho_amp (n,) of a bead that was scanned through focus: its own image is the reference."""
    amplitude, rho = bead.fits.parameters[:, 2], bead.fits.parameters[:, 5]
    return rho * amplitude[reference_plane(bead)] / amplitude


def reference_map(
    beads: Sequence[BeadStack], radius: float, pixel_size: float, image_size: tuple[int, int]
) -> FieldMap:
    """ln of A(rho*) over flux (px^-2) over the field, up to second order where the beads allow it."""
    planes = [reference_plane(bead) for bead in beads]
    parameters = np.array([bead.fits.parameters[k] for bead, k in zip(beads, planes, strict=True)])
    flux = np.array([bead.fits.flux[k] for bead, k in zip(beads, planes, strict=True)])
    order = max(order for order in (0, 1, 2) if order == 0 or zernike_count(order) <= len(beads) / 3)
    x, y = field_position(parameters, pixel_size, image_size)
    terms = zernike(order, x / radius, y / radius)
    coefficients = np.linalg.lstsq(terms, np.log(parameters[:, 2] / flux), rcond=None)[0]
    return FieldMap(radius, coefficients)


def inverse_curves(
    beads: Sequence[BeadCurve], sharpest: Array, radius: float, field_order: int, degree: int = 16
) -> tuple[FieldCurves, Array, Array]:
    """The paper's literal form: local polynomials z(rho_amp), their coefficients Zernike combinations.

    ``sharpest`` (b,) m: stage position of each bead's focus, from which z counts; ``radius`` m of the Zernike
    disc. Returns the curves over the range of rho_amp that nine beads in ten cover near focus, the
    residuals of all samples (n,) m and their field positions (n, 2) m. The noise sits in the argument, so the
    inverse of rho_amp(z) is better behaved: this form is for comparison with the paper only.
    """
    feature = FEATURES.index("rho_amp")
    scans = [(bead.features[:, feature], s - bead.stage_z) for bead, s in zip(beads, sharpest, strict=True)]
    near = [r[np.abs(u) < _NEAR_FOCUS] for r, u in scans]
    low, high = np.quantile([r.min() for r in near], 0.9), np.quantile([r.max() for r in near], 0.1)
    samples = []
    for bead, (r, u) in zip(beads, scans, strict=True):
        keep = (r > low) & (r < high) & (np.abs(u) < 1.7 * _NEAR_FOCUS)
        values = u[keep, None]
        samples.append(BeadSamples(bead.x, bead.y, r[keep], values, np.ones_like(values)))
    regression = FieldRegression(samples, radius, (float(low), float(high)), field_order, degree)
    curves = regression.fit(field_order, degree)
    residuals, places = [], []
    for sample in samples:
        local = curves.local(np.array([sample.x]), np.array([sample.y]))[0]
        residuals.append((sample.values - curves.basis(sample.argument) @ local.T)[:, 0])
        places.append(np.tile([sample.x, sample.y], (len(sample.argument), 1)))
    return curves, np.concatenate(residuals), np.concatenate(places)
