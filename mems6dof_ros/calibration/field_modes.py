"""Modes of smooth errors that stand still in the field: distortion that a random bead array cannot show.

A rotating body can, because it carries each particle through many places: the pose estimator measures the
coefficients (pose/field.py), a calibration file keeps them (field_correction.py).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: By how much a mode's error is expected to fall from one degree to the next. Through simulated optics the
#: modes fall by 5 to 10; 3 costs nothing there, nor with errors of long waves, and is honest with both.
FALL = 3.0


@dataclass(frozen=True)
class FieldModes:
    """Modes of the error in x, y and z over a field of half-widths ``half_size`` (2,) m.

    Products of Legendre polynomials up to total degree ``degree``, normalised to 1 rms over the field.
    Left out, because no rotating body tells them from its own motion or shape: the constants, the
    rotation in the plane, the common scale, and the two tilts of z. degree < 0: no modes.
    """

    half_size: tuple[float, float]
    degree: int

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Name of each mode: component and degrees in x and y."""
        if self.degree < 1:
            return ()
        powers = _powers(self.degree)
        lateral = [f"{axis}:{a}{b}" for a, b in powers if a + b >= 2 for axis in "xy"]
        return ("stretch", "shear", *lateral, *(f"z:{a}{b}" for a, b in powers if a + b >= 2))

    def __len__(self) -> int:
        return len(self.names)

    @cached_property
    def degrees(self) -> NDArray[np.int64]:
        """Total degree of each mode, (m,)."""
        return np.array(
            [1 if name in ("stretch", "shear") else sum(map(int, name[2:])) for name in self.names]
        )

    def prior_variance(self, sd_xy: float, sd_z: float) -> Array:
        """Variances (m,) of the coefficients, m^2, so that the modes make an error of ``sd_xy`` in x and
        in y and ``sd_z`` in z, rms over the field, each degree FALL times less than the one before: what
        an objective distorts, it distorts smoothly."""
        axial = np.array([name.startswith("z") for name in self.names], bool)
        weight = FALL ** (-2.0 * self.degrees)
        total = np.where(axial, weight[axial].sum(), weight[~axial].sum() / 2)
        return np.asarray(np.where(axial, sd_z, sd_xy) ** 2 * weight / total)

    def evaluate(self, position: Array) -> Array:
        """Modes (n, 3, m) at ``position`` (n, 3) or (n, 2) m in the microscope frame."""
        out = np.zeros((len(position), 3, len(self)))
        if len(self):
            _evaluate(
                position[:, 0] / self.half_size[0], position[:, 1] / self.half_size[1], self.degree, out
            )
        return out


def _powers(degree: int) -> list[tuple[int, int]]:
    return [(total - b, b) for total in range(degree + 1) for b in range(total + 1)]


@njit(cache=True, nogil=True)
def _evaluate(u: Array, v: Array, degree: int, out: Array) -> None:
    px = np.empty(degree + 1)
    py = np.empty(degree + 1)
    for i in range(len(u)):
        px[0] = py[0] = 1.0
        px[1], py[1] = u[i], v[i]
        for k in range(1, degree):  # Bonnet's recursion
            px[k + 1] = ((2 * k + 1) * u[i] * px[k] - k * px[k - 1]) / (k + 1)
            py[k + 1] = ((2 * k + 1) * v[i] * py[k] - k * py[k - 1]) / (k + 1)
        root = math.sqrt(1.5)  # these two move x and y together: 1/sqrt(2) rms in each
        out[i, 0, 0], out[i, 1, 0] = root * u[i], -root * v[i]
        out[i, 0, 1], out[i, 1, 1] = root * v[i], root * u[i]
        m = 2
        for axis in range(2):
            for total in range(2, degree + 1):
                for b in range(total + 1):
                    value = px[total - b] * py[b] * math.sqrt((2.0 * (total - b) + 1) * (2 * b + 1))
                    if axis == 0:
                        out[i, 0, m] = value
                        out[i, 1, m + 1] = value
                        m += 2
                    else:
                        out[i, 2, m] = value
                        m += 1
