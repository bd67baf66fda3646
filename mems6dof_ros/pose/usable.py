"""Which localizations the pose may use, and for what."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mems6dof_ros.errors import InputError
from mems6dof_ros.localization.localizations import Flag, Localizations

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]

#: Flags with which x and y are still good: their covariance says how good.
LATERAL_ONLY = int(Flag.Z_AMBIGUOUS | Flag.NO_Z | Flag.Z_OUT_OF_RANGE)
#: Flags of what the calibration was not made for.
BEYOND = int(Flag.Z_OUT_OF_RANGE | Flag.OUT_OF_FIELD | Flag.OUT_OF_BRIGHTNESS)
#: Flags with which a position is still good, but less than its covariance says: light of a neighbour, or a
#: window cut by the edge of the image, adds an error about as large as the noise.
DOUBTFUL, DOUBT = int(Flag.NEIGHBOUR | Flag.WINDOW_CUT), 2.0
#: Standard deviation that stands for no knowledge of z, m.
UNKNOWN_Z = 10e-6
#: Standard deviations outside this range, m, are no measurement of a particle's place.
CREDIBLE = (10e-12, 10e-6)
#: Nor are positions this far from the centre of any field, m: squared they would overflow.
FARTHEST = 1.0


class Usable(NamedTuple):
    """Localizations with a finite position in the plane and sound covariances.

    ``of`` (n,): index in the message; ``position`` (n, 3) m and ``covariance`` (n, 3, 3) m^2, z replaced by
    0 +- UNKNOWN_Z where not ``has_z`` (n,), variances DOUBT times larger where doubtful; ``good`` (n,): may
    enter the solution. The others only show that a particle is still there.
    """

    of: Indices
    position: Array
    covariance: Array
    has_z: Mask
    good: Mask

    def only(self, keep: Indices | Mask) -> Usable:
        """The localizations ``keep``."""
        return Usable(*(part[keep] for part in self))  # type: ignore[arg-type]


def usable(localizations: Localizations, available: Mask | None = None, beyond: bool = False) -> Usable:
    """The usable part of ``localizations``, of those ``available`` (n,) (None: all); also of what lies
    ``beyond`` what the calibration was made for.

    Raises InputError where the arrays do not fit together.
    """
    _check_shapes(localizations)
    position, covariance, flags = localizations.position, localizations.covariance, localizations.flags
    if beyond:
        flags = flags & ~np.uint32(BEYOND)
    variance = np.diagonal(covariance, axis1=1, axis2=2)
    lateral = variance[:, 0] * variance[:, 1] - covariance[:, 0, 1] ** 2
    low, high = CREDIBLE[0] ** 2, CREDIBLE[1] ** 2
    credible = (variance >= low) & (variance <= high)
    near = np.abs(position) < FARTHEST  # not where NaN
    keep = near[:, :2].all(axis=1) & credible[:, 0] & credible[:, 1] & (lateral > 0)
    keep &= np.isfinite(lateral) & ((flags & int(Flag.FIT_FAILED)) == 0)
    if available is not None:
        keep &= available
    of = np.flatnonzero(keep)
    position, covariance, flags = position[of].copy(), covariance[of].copy(), flags[of].astype(np.int64)
    a, b, c = covariance[:, 0, 1], covariance[:, 0, 2], covariance[:, 1, 2]
    xx, yy, zz = variance[of].T
    determinant = zz * lateral[of] - xx * c**2 - yy * b**2 + 2 * a * b * c
    has_z = near[of, 2] & (determinant > 0) & credible[of, 2]
    has_z &= (flags & LATERAL_ONLY) == 0
    position[~has_z, 2] = 0.0
    covariance[~has_z, 2, :] = covariance[~has_z, :, 2] = 0.0
    covariance[~has_z, 2, 2] = UNKNOWN_Z**2
    covariance[(flags & DOUBTFUL) != 0] *= DOUBT
    return Usable(of, position, covariance, has_z, (flags & ~(LATERAL_ONLY | DOUBTFUL)) == 0)


def scaled(covariance: Array, factor: Array) -> Array:
    """Covariances (n, 3, 3) with their lateral and axial variances multiplied by ``factor`` (n, 2)."""
    root = np.sqrt(factor)[:, [0, 0, 1]]
    return np.asarray(covariance * root[:, :, None] * root[:, None, :])


def _check_shapes(localizations: Localizations) -> None:
    n = len(localizations.position)
    for name, shape in (("position", (n, 3)), ("covariance", (n, 3, 3)), ("flags", (n,))):
        found = np.shape(getattr(localizations, name))
        if found != shape:
            raise InputError(f"localizations.{name}", f"shape {found}", f"shape {shape}")
