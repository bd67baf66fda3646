"""What the localizer needs of a calibration, whatever its method."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from mems6dof_ros.localization.localizations import GaussianFits


@dataclass(frozen=True)
class Positions:
    """Three-dimensional positions of n particles.

    ``position`` (n, 3) m in the microscope frame, ``covariance`` (n, 3, 3) m^2, ``z_gap`` (n,)
    chi-square by which the second-best z is worse (NaN without a second candidate), ``flags`` (n,)
    of Flag to add to those of the fits. ``fits``: of length n, where they are no longer those given because
    one turned out to be of two particles, or what was flagged in them has been resolved; None: those given.
    """

    position: NDArray[np.float64]
    covariance: NDArray[np.float64]
    z_gap: NDArray[np.float64]
    flags: NDArray[np.uint32]
    fits: GaussianFits | None = None


class OpticalCalibration(Protocol):
    """A calibration of the optics: fitted shapes to positions, within a stated range.

    ``calibration_id`` identifies the content (hash); ``pixel_size`` m; ``image_size`` (width,
    height) px; ``weighting`` and ``window_px``: the fit it was made with and must be used with.
    """

    @property
    def calibration_id(self) -> str: ...

    @property
    def method(self) -> str: ...

    @property
    def pixel_size(self) -> float: ...

    @property
    def image_size(self) -> tuple[int, int]: ...

    @property
    def weighting(self) -> str: ...

    @property
    def window_px(self) -> int: ...

    def locate(self, fits: GaussianFits, image: NDArray[np.generic] | None = None) -> Positions:
        """Positions of ``fits``; failed fits give NaN, values beyond the range are flagged.

        ``image`` (height, width) ADU, in which they were fitted, for methods that read more of it.
        """
        ...
