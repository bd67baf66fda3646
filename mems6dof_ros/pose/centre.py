"""Centre of rotation: the point of the body that stays where it is while the body turns.

With the poses ``q = R p + t`` the centre c on the body stays at C in the microscope frame:
``Rz(psi) c + t = C``: two unknown points in the plane, linear least squares over all cycles. It needs
no whole revolution. Over whole revolutions C is the mean position of every particle, which is how
the paper defines the centre. Play is what remains, and sets the uncertainty.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class CentreEstimate(NamedTuple):
    """``body`` (2,) m: the centre in the map frame; ``microscope`` (2,) m: where it stays; ``sd`` m of
    either per axis, ``play`` m rms per axis of the motion about it."""

    body: Array
    microscope: Array
    sd: float
    play: float


class CentreOfRotation:
    """Fixed point of rotations, from sums over the cycles: constant time and memory."""

    def __init__(self) -> None:
        self._n = 0
        self._turn = 0j  # sum of exp(i psi)
        self._shift = 0j  # sum of t
        self._cross = 0j  # sum of exp(-i psi) t
        self._square = 0.0  # sum of |t|^2

    def add(self, rotation: Array, translation: Array) -> None:
        """One pose: ``rotation`` (3, 3), ``translation`` (3,) m of the map frame's origin."""
        turn = complex(rotation[0, 0] + rotation[1, 1], rotation[1, 0] - rotation[0, 1])
        turn /= abs(turn)
        shift = complex(translation[0], translation[1])
        self._n += 1
        self._turn += turn
        self._shift += shift
        self._cross += turn.conjugate() * shift
        self._square += abs(shift) ** 2

    def estimate(self) -> CentreEstimate | None:
        """The centre so far; None before the body has turned."""
        n = self._n
        # Minimise sum |turn c + t - C|^2: C = (turn c + t) averaged; determinant n^2 - |sum turn|^2.
        determinant = n * n - abs(self._turn) ** 2
        if n < 3 or determinant < 1e-9 * n * n:
            return None
        c = (self._turn.conjugate() * self._shift - n * self._cross) / determinant
        place = (self._turn * c + self._shift) / n
        # Residual sum at the solution, from the sums alone.
        cost = (
            n * abs(c) ** 2 + self._square + n * abs(place) ** 2
            + 2 * (c.conjugate() * self._cross).real
            - 2 * (place.conjugate() * (self._turn * c + self._shift)).real
        )  # fmt: skip
        play = math.sqrt(max(0.0, cost) / max(2 * n - 4, 1))
        sd = play * math.sqrt(n / determinant)
        return CentreEstimate(np.array([c.real, c.imag]), np.array([place.real, place.imag]), sd, play)
