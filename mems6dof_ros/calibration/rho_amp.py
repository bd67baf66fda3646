"""The paper's axial feature, rho_amp = rho / A_n, with A_n = A / A(rho*).

A(rho*) is the amplitude in the image of that particle with the smallest |rho|. A calibration bead has
such an image; a particle on the gear, which never scans z, does not. Its fitted flux stands in: the ratio
of A(rho*) to flux depends on the place in the field only and is mapped there, and the calibration curves
use the same substitute. (Copeland et al., axial calibration.)
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mems6dof_ros.calibration.field_curves import Array
from mems6dof_ros.calibration.focus_stack import BeadStack
from mems6dof_ros.calibration.optical_model import FieldMap, field_position
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
