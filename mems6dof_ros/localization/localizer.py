"""From a frame to its localizations: detect, fit, judge, and read z from a calibration."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from mems6dof_ros.calibration.interface import OpticalCalibration, Positions
from mems6dof_ros.errors import InputError
from mems6dof_ros.frame import Frame
from mems6dof_ros.localization.camera import CameraNoise
from mems6dof_ros.localization.detection import DetectionSettings, detect
from mems6dof_ros.localization.fitting import DEFAULT_WEIGHTING, check_fit, fit_gaussians
from mems6dof_ros.localization.localizations import Flag, GaussianFits, Localizations
from mems6dof_ros.localization.neighbours import close_pairs

_GATES = ("least_significance", "most_sigma", "most_misfit")

#: Relative difference of two pixel sizes that still counts as equal: 0.03 um over the field of 260 um.
PIXEL_SIZE_TOLERANCE = 1e-4


@dataclass(frozen=True)
class LocalizerSettings:
    """How a frame becomes localizations.

    ``detection``: see DetectionSettings. ``weighting``, ``window_px``: the fit where no calibration
    prescribes it (see fit_gaussians). ``pixel_size`` m: where neither calibration nor frame states it,
    NaN: unknown. ``neighbour_distance`` m: particles closer than this flag each other NEIGHBOUR.
    ``neighbour_flux``: fraction of a particle's light from which a neighbour disturbs it.
    ``least_significance``: amplitude in its standard deviations, ``most_sigma``: width as a fraction of the
    window, ``most_misfit``: rms residual as a fraction of the particle's light, beyond its noise; a fit
    outside these is flagged POOR_FIT.
    """

    detection: DetectionSettings = field(default_factory=DetectionSettings)
    weighting: str = DEFAULT_WEIGHTING
    window_px: int = 31
    pixel_size: float = math.nan
    neighbour_distance: float = 4e-6
    neighbour_flux: float = 0.02
    least_significance: float = 8.0
    most_sigma: float = 0.4
    most_misfit: float = 0.4

    def __post_init__(self) -> None:
        check_fit(self.weighting, self.window_px)
        for name in ("neighbour_distance", "neighbour_flux", *_GATES):
            if not 0 <= getattr(self, name) < math.inf:
                raise InputError(f"localizer.{name}", f"{getattr(self, name)}", "a number of 0 or more")
        if not (math.isnan(self.pixel_size) or 0 < self.pixel_size < math.inf):
            raise InputError("localizer.pixel_size", f"{self.pixel_size}", "positive m, or NaN for unknown")


class Localizer:
    """Localizes the particles of frames of one camera and one calibration; keeps no state of them."""

    def __init__(
        self,
        camera: CameraNoise,
        calibration: OpticalCalibration | None,
        settings: LocalizerSettings | None = None,
    ) -> None:
        """``calibration`` None: x and y only, flagged NO_Z."""
        self.camera = camera
        self.calibration = calibration
        self.settings = settings or LocalizerSettings()
        self._weighting = calibration.weighting if calibration else self.settings.weighting
        self._window_px = calibration.window_px if calibration else self.settings.window_px

    def localize(self, frame: Frame, candidates: NDArray[np.float64] | None = None) -> Localizations:
        """Localizations of all particles in ``frame``, none where it shows none.

        ``candidates`` (n, 2), column and row in px: where to fit; None: wherever something is detected.
        Raises InputError for a frame that contradicts the calibration or the camera.
        """
        pixel_size = self.check(frame)
        if candidates is None:
            candidates = detect(frame.image, self.settings.detection)
        fits = fit_gaussians(frame.image, candidates, self.camera, self._weighting, self._window_px)
        again = _again(fits, self.settings.detection.separation_px / 2)
        # Perhaps a fit to the light of several, in which they can yet be told apart: it keeps its place.
        fits.parameters[again], fits.covariance[again] = np.nan, np.nan
        fits.flags[again] |= np.uint32(Flag.FIT_FAILED)
        fits.flags[:] |= self._quality_flags(fits, pixel_size)
        if self.calibration:
            found = self.calibration.locate(fits, frame.image)
            fits = fits if found.fits is None else found.fits
        else:
            found = _lateral_positions(fits, pixel_size, frame.image.shape)
        keep = (fits.flags & Flag.FIT_FAILED) == 0
        keep[: len(again)] |= ~again
        fits = fits[keep]
        return Localizations(
            stamp_ns=frame.stamp_ns,
            frame_id=frame.frame_id,
            frame_counter=frame.frame_counter,
            cycle=frame.cycle,
            position=found.position[keep],
            covariance=found.covariance[keep],
            fits=fits,
            z_gap=found.z_gap[keep],
            flags=fits.flags | found.flags[keep].astype(np.uint32),
            calibration_id=self.calibration.calibration_id if self.calibration else "",
            frames_dropped=frame.frames_dropped,
            frame_published_ns=frame.published_ns,
        )

    def check(self, frame: Frame) -> float:
        """The pixel size of ``frame``, m; InputError where it contradicts the camera or the calibration."""
        where = f"frame {frame.frame_counter}"
        if 0 < frame.saturation_adu < self.camera.saturation_adu:
            raise InputError(
                where,
                f"saturation at {frame.saturation_adu} ADU",
                f"no less than the camera's, set to {self.camera.saturation_adu:g} ADU",
            )
        if self.calibration:
            height, width = frame.image.shape
            if (width, height) != tuple(self.calibration.image_size):
                expected = "{} x {} px of calibration {}".format(
                    *self.calibration.image_size, self.calibration.calibration_id
                )
                raise InputError(where, f"an image of {width} x {height} px", expected)
        stated = self.calibration.pixel_size if self.calibration else self.settings.pixel_size
        if math.isnan(stated):
            if math.isnan(frame.pixel_size):
                raise InputError(where, "no pixel size", "one in the frame, the settings or a calibration")
            return frame.pixel_size
        if abs(frame.pixel_size - stated) > PIXEL_SIZE_TOLERANCE * stated:
            source = f"calibration {self.calibration.calibration_id}" if self.calibration else "the settings"
            raise InputError(
                where,
                f"a pixel size of {frame.pixel_size * 1e9:.3f} nm",
                f"{stated * 1e9:.3f} nm of {source}",
            )
        return stated

    def _quality_flags(self, fits: GaussianFits, pixel_size: float) -> NDArray[np.uint32]:
        settings = self.settings
        amplitude, sigma_x, sigma_y = fits.parameters[:, 2:5].T
        with np.errstate(invalid="ignore"):
            poor = amplitude < settings.least_significance * np.sqrt(fits.covariance[:, 2, 2])
            poor |= np.maximum(sigma_x, sigma_y) > settings.most_sigma * self._window_px
            poor |= misfit(fits, self._window_px) > settings.most_misfit
        flags = np.where(poor, Flag.POOR_FIT, 0).astype(np.uint32)
        disturbed = _disturbed(fits, settings.neighbour_distance / pixel_size, settings.neighbour_flux)
        flags[disturbed] |= np.uint32(Flag.NEIGHBOUR)
        return flags


def misfit(fits: GaussianFits, window_px: int) -> NDArray[np.float64]:
    """Residual relative to the particle's light, as far as noise does not explain it, (n,).

    A model wrong by the fraction m adds ``m^2 flux`` to chi-square, however bright the particle:
    ``m = sqrt((chi_square - noise) (window_px^2 - 7) / flux)``, where noise reaches 3 standard deviations
    above 1.
    """
    degrees = window_px**2 - 7
    excess = np.maximum(fits.chi_square - 1 - 3 * math.sqrt(2 / degrees), 0)
    return np.sqrt(excess * degrees / fits.flux)


def _again(fits: GaussianFits, distance_px: float) -> NDArray[np.bool_]:
    """Fits that have wandered to a particle that an earlier candidate found."""
    again = np.zeros(len(fits), dtype=bool)
    good = np.nonzero((fits.flags & Flag.FIT_FAILED) == 0)[0]
    for a, b in close_pairs(fits.parameters[good, :2], distance_px):
        if not again[good[a]]:
            again[good[b]] = True
    return again


def _disturbed(fits: GaussianFits, distance_px: float, least_flux: float) -> NDArray[np.bool_]:
    """Fits with a neighbour within ``distance_px`` that has at least ``least_flux`` of their light."""
    disturbed = np.zeros(len(fits), dtype=bool)
    good = np.nonzero((fits.flags & Flag.FIT_FAILED) == 0)[0]
    pairs = close_pairs(fits.parameters[good, :2], distance_px)
    a, b = good[pairs[:, 0]], good[pairs[:, 1]]
    flux = fits.flux
    disturbed[a[flux[b] > least_flux * flux[a]]] = True
    disturbed[b[flux[a] > least_flux * flux[b]]] = True
    return disturbed


def _lateral_positions(fits: GaussianFits, pixel_size: float, shape: tuple[int, ...]) -> Positions:
    """x and y as fitted, z unknown."""
    n = len(fits)
    height, width = shape
    position, covariance = np.full((n, 3), np.nan), np.full((n, 3, 3), np.nan)
    centre = np.array([(width - 1) / 2, (height - 1) / 2])
    position[:, :2] = (fits.parameters[:, :2] - centre) * pixel_size
    covariance[:, :2, :2] = fits.covariance[:, :2, :2] * pixel_size**2
    return Positions(position, covariance, np.full(n, np.nan), np.full(n, Flag.NO_Z, dtype=np.uint32))
