"""Which localizations the pose may use, and for what."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
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
#: With these nothing is there.
FAILED = int(Flag.FIT_FAILED)
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
    of, position, covariance, has_z, good = _judged(
        localizations.position,
        localizations.covariance,
        localizations.flags.astype(np.int64) & (~BEYOND if beyond else -1),
        np.ones(len(localizations), bool) if available is None else available,
    )
    return Usable(of, position, covariance, has_z, good)


@njit(cache=True, nogil=True)
def _judged(position, covariance, flags, available):  # type: ignore[no-untyped-def]
    """The fields of Usable. What is NaN fails every comparison."""
    low, high = CREDIBLE[0] ** 2, CREDIBLE[1] ** 2
    of, has_z = np.empty(len(position), np.int64), np.empty(len(position), np.bool_)
    good = np.empty(len(position), np.bool_)
    places, covariances = np.empty_like(position), np.empty_like(covariance)
    n = 0
    for i in range(len(position)):
        c = covariance[i]
        lateral = c[0, 0] * c[1, 1] - c[0, 1] ** 2
        if not (
            available[i]
            and (flags[i] & FAILED) == 0
            and abs(position[i, 0]) < FARTHEST
            and abs(position[i, 1]) < FARTHEST
            and low <= c[0, 0] <= high
            and low <= c[1, 1] <= high
            and 0 < lateral < math.inf
        ):
            continue
        determinant = (
            c[2, 2] * lateral - c[0, 0] * c[1, 2] ** 2 - c[1, 1] * c[0, 2] ** 2
            + 2 * c[0, 1] * c[0, 2] * c[1, 2]
        )  # fmt: skip
        of[n], places[n], covariances[n] = i, position[i], c
        has_z[n] = (
            (flags[i] & LATERAL_ONLY) == 0
            and abs(position[i, 2]) < FARTHEST
            and low <= c[2, 2] <= high
            and determinant > 0
        )
        if not has_z[n]:
            places[n, 2] = 0.0
            covariances[n, 2, :] = covariances[n, :, 2] = 0.0
            covariances[n, 2, 2] = UNKNOWN_Z**2
        if flags[i] & DOUBTFUL:
            covariances[n] *= DOUBT
        good[n] = (flags[i] & ~(LATERAL_ONLY | DOUBTFUL)) == 0
        n += 1
    return of[:n], places[:n], covariances[:n], has_z[:n], good[:n]


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
