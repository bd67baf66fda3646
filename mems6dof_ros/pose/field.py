"""The field error as known now: smooth errors of the optics, common to all bodies in view.

They are common to neighbours and to cycles, so averaging does not remove them. They are a linear
combination of polynomial modes with a prior covariance: every solution marginalises them, and rotating
bodies, which carry each particle through many places, gradually measure them. Given its coefficients, bodies
tell nothing of each other; so each tells what it has seen of them, and the sum is the exact solution.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mems6dof_ros.calibration.field_correction import FieldCorrection
from mems6dof_ros.calibration.field_modes import FieldModes
from mems6dof_ros.pose.settings import PoseSettings

Array = NDArray[np.float64]


class FieldError:
    """Gaussian estimate of the k coefficients of ``modes``: ``mean`` (k,) m, ``covariance`` (k, k) m^2 and
    its Cholesky ``factor``, from a ``prior`` covariance (k, k) m^2 about zero and all that was told."""

    def __init__(self, modes: FieldModes, prior: Array) -> None:
        self.modes, self.prior = modes, prior
        self._scale = np.sqrt(np.diag(prior))  # information is summed without units: its inverse is sound
        self._become({})

    @classmethod
    def assumed(cls, settings: PoseSettings, half_size: Array) -> FieldError:
        """What ``settings`` assume, of the field that they state or of half-widths ``half_size`` (2,) m."""
        width, height = settings.field_size or 2 * half_size
        degree = settings.field_degree if settings.reference == "map" else 0
        modes = FieldModes((float(width) / 2, float(height) / 2), degree)
        return cls(modes, np.diag(modes.prior_variance(settings.field_sd_xy, settings.field_sd_z)))

    @classmethod
    def remaining(cls, correction: FieldCorrection | None, settings: PoseSettings) -> FieldError | None:
        """What is left of it where a calibration has a ``correction``, which positions have had; None without
        one, or where ``settings`` do not estimate a field error."""
        if correction is None or settings.reference != "map" or settings.field_degree == 0:
            return None
        return cls(correction.modes, correction.covariance)

    def tell(self, body: str, information: Array, vector: Array) -> None:
        """The evidence of ``body`` so far, its particles and poses eliminated: ``information`` (k, k) m^-2,
        ``vector`` (k,) m^-1, in place of what it told before. Raises LinAlgError, and changes nothing, where
        numbers cannot hold the sum."""
        scaled = information * np.outer(self._scale, self._scale), vector * self._scale
        self._become(self._told | {body: scaled})

    def forget(self, body: str) -> None:
        """Take back what ``body`` told."""
        self._become({other: told for other, told in self._told.items() if other != body})

    def _become(self, told: dict[str, tuple[Array, Array]]) -> None:
        information = np.linalg.inv(self.prior / np.outer(self._scale, self._scale))
        vector = np.zeros(len(self.modes))
        for more, pull in told.values():
            information, vector = information + more, vector + pull
        inverse = np.linalg.inv(information)
        covariance = inverse * np.outer(self._scale, self._scale)
        self.factor = np.linalg.cholesky(covariance)
        self.mean, self.covariance, self._told = self._scale * (inverse @ vector), covariance, told
