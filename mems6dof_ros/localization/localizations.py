"""The localizations of one frame, as parallel arrays: what the localizer hands to the pose."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import IntFlag
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

#: Order of the seven parameters of the bivariate Gaussian, everywhere.
FIT_PARAMETERS = ("x_px", "y_px", "amplitude", "sigma_x_px", "sigma_y_px", "rho", "background")


class Flag(IntFlag):
    """Quality of one localization, bitwise; 0 is good. Equal to the FLAG_ constants of the message."""

    FIT_FAILED = 1
    WINDOW_CUT = 2
    SATURATED = 4
    NEIGHBOUR = 8
    POOR_FIT = 16
    Z_AMBIGUOUS = 32
    Z_OUT_OF_RANGE = 64
    OUT_OF_FIELD = 128
    OUT_OF_BRIGHTNESS = 256
    NO_Z = 512


@dataclass(frozen=True)
class GaussianFits:
    """Bivariate Gaussians fitted to n windows.

    ``parameters`` (n, 7) in the order of FIT_PARAMETERS: positions in px of the whole image with
    pixel centres at integers (column, row), amplitude and background in electrons per pixel.
    ``covariance`` (n, 7, 7) in the same units; ``chi_square`` (n,) reduced; ``iterations`` (n,);
    ``flags`` (n,) of Flag. A failed fit keeps its place, with NaN parameters and FIT_FAILED. ``sought``
    (n, 2) px: where the fits began; None where nobody knows any more.
    """

    parameters: NDArray[np.float64]
    covariance: NDArray[np.float64]
    chi_square: NDArray[np.float64]
    iterations: NDArray[np.int32]
    flags: NDArray[np.uint32]
    sought: NDArray[np.float64] | None = None

    def __len__(self) -> int:
        return len(self.parameters)

    def __getitem__(self, index: NDArray[np.generic]) -> GaussianFits:
        """The fits that ``index`` (numbers or mask) chooses."""
        return GaussianFits(
            self.parameters[index],
            self.covariance[index],
            self.chi_square[index],
            self.iterations[index],
            self.flags[index],
            None if self.sought is None else self.sought[index],
        )

    @cached_property
    def flux(self) -> NDArray[np.float64]:
        """Electrons in each Gaussian, 2 pi A sigma_x sigma_y sqrt(1 - rho^2), (n,)."""
        _, _, amplitude, sigma_x, sigma_y, rho, _ = self.parameters.T
        return 2 * math.pi * amplitude * sigma_x * sigma_y * np.sqrt(1 - rho**2)


@dataclass(frozen=True)
class Latency:
    """Time spent so far, host clocks; s, NaN where unknown. Names as in the messages."""

    capture: float = math.nan
    frame_transport: float = math.nan
    queue: float = math.nan
    localization: float = math.nan
    localization_transport: float = math.nan
    pose: float = math.nan
    total: float = math.nan


@dataclass(frozen=True)
class Localizations:
    """Particles found in one frame.

    ``position`` (n, 3) m in the microscope frame, apparent lateral motion removed, z NaN where no
    axial calibration applies; ``covariance`` (n, 3, 3) m^2; ``fits`` of length n; ``z_gap`` (n,)
    chi-square by which the second-best z is worse, NaN without a second candidate; ``flags`` (n,)
    of Flag, those of the fits included.
    """

    stamp_ns: int
    frame_id: str
    frame_counter: int
    cycle: int
    position: NDArray[np.float64]
    covariance: NDArray[np.float64]
    fits: GaussianFits
    z_gap: NDArray[np.float64]
    flags: NDArray[np.uint32]
    calibration_id: str = ""
    frames_dropped: int = 0
    published_ns: int = 0
    frame_published_ns: int = 0
    latency: Latency = field(default_factory=Latency)

    def __len__(self) -> int:
        return len(self.position)
