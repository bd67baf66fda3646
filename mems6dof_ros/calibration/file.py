"""The calibration and its file: YAML text with format version, units, provenance and valid ranges.

One file is all that localizing needs: the forward model, the fit that it was made with and must be used
with, the camera's numbers. ``calibration_id`` is a hash of exactly that content, so that equal
calibrations have equal names whoever wrote the file and when. A reader for every version ever written
stays in ``_READERS``. Version 2 adds a field correction; without one, files stay as in version 1.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from mems6dof_ros.calibration import psf_model
from mems6dof_ros.calibration.bead_field import BeadField
from mems6dof_ros.calibration.estimator import ALL_FEATURES, METHODS, SHAPE, Estimator
from mems6dof_ros.calibration.field_correction import FieldCorrection
from mems6dof_ros.calibration.field_curves import Array, FieldCurves
from mems6dof_ros.calibration.field_modes import FieldModes
from mems6dof_ros.calibration.interface import Positions
from mems6dof_ros.calibration.moments import residual_moments
from mems6dof_ros.calibration.optical_model import (
    FEATURES,
    FieldMap,
    FocusSurface,
    OpticalModel,
    field_position,
)
from mems6dof_ros.calibration.psf_estimator import PsfEstimator
from mems6dof_ros.calibration.psf_model import PsfModel
from mems6dof_ros.documents import read_document, write_whole
from mems6dof_ros.errors import InputError
from mems6dof_ros.localization.camera import CameraNoise
from mems6dof_ros.localization.fitting import WEIGHTINGS
from mems6dof_ros.localization.localizations import Flag, GaussianFits

FORMAT = "mems6dof-calibration"
DEFAULT_METHOD = "joint"
#: Standard deviations by which two estimates of z differ if they are on different branches, or if that from
#: one feature is beyond the reach of its linearised covariance.
BRANCHES_APART = 4.0


@dataclass(frozen=True)
class ValidRange:
    """Where the calibration holds: defocus ``z`` about the focus surface, field ``x`` and ``y`` (m), and
    ``flux`` of the fitted Gaussian (electrons), each (lowest, highest)."""

    z: tuple[float, float]
    x: tuple[float, float]
    y: tuple[float, float]
    flux: tuple[float, float]


@dataclass(frozen=True)
class Calibration:
    """A calibration of the optics; implements OpticalCalibration. ``method``: see estimator.METHODS.
    ``correction``: of the field error, None before it was measured.

    ``provenance``: plain values for the file (software, settings, inputs, quality), not part of the id.
    """

    model: OpticalModel
    pixel_size: float
    image_size: tuple[int, int]
    weighting: str
    window_px: int
    camera: CameraNoise
    valid: ValidRange
    method: str = DEFAULT_METHOD
    provenance: Mapping[str, Any] = field(default_factory=dict)
    psf: PsfModel | None = None
    correction: FieldCorrection | None = None

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise InputError("calibration method", repr(self.method), f"one of {', '.join(METHODS)}")
        if self.method == "psf" and self.psf is None:
            raise InputError(
                "calibration method",
                "'psf', which this calibration does not contain",
                "'joint' or 'rho_amp', or a calibration made with aperture, wavelength and diameter",
            )
        if self.correction is not None and self.correction.method != self.method:
            made = f"{self.correction.method!r}, with which the field correction was measured"
            raise InputError("calibration method", repr(self.method), made)

    @cached_property
    def calibration_id(self) -> str:
        """First 16 hexadecimal digits of the SHA-256 of the content, method excluded."""
        text = json.dumps(_content(self), sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    def _estimator(self, names: tuple[str, ...]) -> Estimator:
        return Estimator(self.model, names, self.valid.z, self.pixel_size, self.image_size)

    @cached_property
    def _by_amplitude(self) -> Estimator:
        return self._estimator(("rho_amp",))

    @cached_property
    def _by_shape(self) -> Estimator:
        return self._estimator(SHAPE)

    @cached_property
    def _by_all_features(self) -> Estimator:
        return self._estimator(ALL_FEATURES)

    @cached_property
    def _by_pixels(self) -> PsfEstimator:
        assert self.psf is not None
        field = self.valid.x, self.valid.y
        return PsfEstimator(
            self.psf,
            self._by_all_features,
            self.camera,
            self.window_px,
            self.valid.z,
            self.pixel_size,
            self.image_size,
            field,
        )

    def locate(self, fits: GaussianFits, image: NDArray[np.generic] | None = None) -> Positions:
        """Positions of ``fits``; failed fits give NaN, values beyond the valid range are flagged.

        ``image`` (height, width) ADU, in which they were fitted: method joint reads from it what the
        Gaussians leave over, and is less precise without; method psf raises InputError without.
        """
        moments = None if image is None else residual_moments(image, fits, self.camera, self.window_px)
        if self.method == "psf":
            if image is None or moments is None:
                raise InputError("calibration method", "'psf' without an image", "the image of the fits")
            found = self._by_pixels.locate(fits, moments, image)
        else:
            found = (self._by_shape if moments is None else self._by_all_features).locate(fits, moments)
            if self.method == "rho_amp":
                found = _guarded(self._by_amplitude.locate(fits), found)
        fits = fits if found.fits is None else found.fits
        x, y = field_position(fits.parameters, self.pixel_size, self.image_size)
        with np.errstate(invalid="ignore"):
            outside = _outside(x, self.valid.x) | _outside(y, self.valid.y)
            brightness = _outside(self.model.brightness(fits, x, y), self.valid.flux)
        flags = np.where(outside, Flag.OUT_OF_FIELD, 0) | np.where(brightness, Flag.OUT_OF_BRIGHTNESS, 0)
        position = self.correction.apply(found.position) if self.correction else found.position
        return replace(found, position=position, flags=found.flags | flags.astype(np.uint32))

    def with_method(self, method: str) -> Calibration:
        """The same calibration read by another ``method``; InputError for an unknown one, and for one with
        which the field correction was not measured."""
        return replace(self, method=method)

    def corrected(
        self, modes: FieldModes, mean: Array, covariance: Array, provenance: Mapping[str, Any]
    ) -> Calibration:
        """With the field error that a session measured by this calibration: coefficients ``mean`` (k,) m of
        ``modes``, known to ``covariance`` (k, k) m^2, on top of the correction there may be.

        Raises InputError where that correction is one of other modes.
        """
        if (earlier := self.correction) is None:
            correction = FieldCorrection(modes, mean, covariance, self.method, provenance)
        elif earlier.modes == modes:
            correction = earlier.refined(mean, covariance, provenance)
        else:
            raise InputError("field error", f"{modes}", f"{earlier.modes}, as in the calibration")
        return self.with_correction(correction)

    def with_correction(self, correction: FieldCorrection | None) -> Calibration:
        """The same calibration with another ``correction`` of the field error, or without."""
        return replace(self, correction=correction)


def _guarded(found: Positions, shape: Positions) -> Positions:
    """Flag as ambiguous what all features of the ``shape`` place on another branch, with their own flags what
    they place out of range or nowhere: one alone cannot tell."""
    difference = np.abs(found.position[:, 2] - shape.position[:, 2])
    variance = found.covariance[:, 2, 2] + shape.covariance[:, 2, 2]
    with np.errstate(invalid="ignore"):
        apart = difference > BRANCHES_APART * np.sqrt(variance)
    nowhere = shape.flags & (Flag.Z_OUT_OF_RANGE | Flag.POOR_FIT)
    elsewhere = np.where(apart, Flag.Z_AMBIGUOUS, 0) | nowhere
    return replace(found, flags=found.flags | elsewhere.astype(np.uint32))


def _outside(value: Array, limits: tuple[float, float]) -> NDArray[np.bool_]:
    return (value < limits[0]) | (value > limits[1])


def save_calibration(calibration: Calibration, path: str | Path) -> None:
    """Write ``calibration`` to ``path``, whole or not at all; InputError where it cannot be written."""
    document = {
        "format": FORMAT,
        "version": 1 if calibration.correction is None else 2,
        "calibration_id": calibration.calibration_id,
        "method": calibration.method,
        "provenance": dict(calibration.provenance),
        **_content(calibration),
    }
    if calibration.correction is not None:
        document["field_correction"]["provenance"] = dict(calibration.correction.provenance)
    text = _HEADER + yaml.dump(document, Dumper=_Dumper, sort_keys=False, default_flow_style=None, width=110)
    write_whole(path, text)


def load_calibration(path: str | Path, method: str | None = None) -> Calibration:
    """Read a calibration file; ``method`` replaces the file's own choice.

    Raises InputError for a missing or malformed file, another format, a version from the future, and
    content that does not match its own calibration_id.
    """
    where = str(path)
    document = read_document(path, "YAML", "a calibration file made by 'mems6dof calibrate'")
    if not isinstance(document, dict) or document.get("format") != FORMAT:
        raise InputError(where, "no calibration", f"a file with 'format: {FORMAT}'")
    version = document.get("version")
    if not isinstance(version, int) or version not in _READERS:
        raise InputError(f"{where}: version", repr(version), f"one of {', '.join(map(str, _READERS))}")
    calibration = _READERS[version](_Fields(document, where))
    stated = document.get("calibration_id")
    if stated != calibration.calibration_id:
        raise InputError(
            f"{where}: calibration_id", repr(stated), f"{calibration.calibration_id}: the content was changed"
        )
    return calibration.with_method(method) if method else calibration


_Dumper: Any = getattr(yaml, "CSafeDumper", yaml.SafeDumper)

_HEADER = """\
# Calibration of the optics: what the Gaussian fit sees of a particle at (X, Y, z). Units are in the
# names; features are, in this order, dx and dy (m), ln(sigma_x/px), ln(sigma_y/px), atanh(rho), rho_amp.
# Curves: sum over j, m of coefficients[feature][j][m] Z_j(X/R, Y/R) T_m(u scaled to -1..1), Z Zernike in
# OSA/ANSI order with unit rms, T Chebyshev, R disc_radius_m, u = z - focus_surface(X, Y).
# field_correction (if any): measured minus true position, sum over k of coefficients_m[k] mode_k(X, Y); mode
# "x:ab" moves x alone by L_a(X/half width) L_b(Y/half height), L Legendre with 1 rms over the field.
"""


def _content(calibration: Calibration) -> dict[str, Any]:
    """Everything that determines positions, as plain values: the body of a file."""
    content = _content_of_optics(calibration)
    if (correction := calibration.correction) is not None:
        content["field_correction"] = {
            "half_size_m": [float(v) for v in correction.modes.half_size],
            "degree": int(correction.modes.degree),
            "method": correction.method,
            "modes": list(correction.modes.names),
            "coefficients_m": correction.mean.tolist(),
            "covariance_m2": correction.covariance.tolist(),
        }
    return content


def _content_of_optics(calibration: Calibration) -> dict[str, Any]:
    model, camera, valid = calibration.model, calibration.camera, calibration.valid
    light = model.illumination
    illumination = {} if light is None else {"ln_illumination": light.coefficients.tolist()}
    beads = model.focus.beads.places
    places = {"bead_places_m": beads.tolist()} if len(beads) else {}
    psf = {} if calibration.psf is None else {"psf": psf_model.content(calibration.psf)}
    return {
        "optics": {
            "pixel_size_m": float(calibration.pixel_size),
            "image_size_px": [int(n) for n in calibration.image_size],
        },
        "camera": {
            "offset_adu": _mean(camera.offset_adu),
            "gain_adu_per_electron": _mean(camera.gain_adu_per_electron),
            "read_noise_electrons": _mean(camera.read_noise_electrons),
            "saturation_adu": float(camera.saturation_adu),
        },
        "fit": {"weighting": calibration.weighting, "window_px": int(calibration.window_px)},
        "valid": {
            "defocus_m": [float(v) for v in valid.z],
            "x_m": [float(v) for v in valid.x],
            "y_m": [float(v) for v in valid.y],
            "flux_electrons": [float(v) for v in valid.flux],
        },
        "model": {
            "disc_radius_m": float(model.curves.radius),
            "defocus_interval_m": [float(v) for v in model.curves.interval],
            "features": list(FEATURES),
            "coefficients": model.curves.coefficients.tolist(),
            "focus_surface_m": model.focus.coefficients.tolist(),
            "focus_variance_m2": float(model.focus.mean_variance),
            **places,
            "ln_reference_amplitude_per_flux": model.reference.coefficients.tolist(),
            "scatter_defocus_m": model.nodes.tolist(),
            "scatter_covariance": model.scatter.tolist(),
            **illumination,
        },
        **psf,
    }


def _mean(value: Any) -> float:
    return float(np.mean(value))


class _Fields:
    """Reads checked values from a document, naming the field in every complaint."""

    def __init__(self, values: Any, where: str) -> None:
        if not isinstance(values, dict):
            raise InputError(where, type(values).__name__, "named values")
        self._values, self._where = values, where

    def __contains__(self, name: str) -> bool:
        return name in self._values

    def __call__(self, name: str) -> Any:
        if name not in self._values:
            raise InputError(f"{self._where}: {name}", "nothing", "a value")
        return self._values[name]

    def section(self, name: str) -> _Fields:
        return _Fields(self(name), f"{self._where}: {name}")

    def array(self, name: str, *shape: int) -> Array:
        """Finite numbers of ``shape``; -1 stands for any length."""
        try:
            array = np.array(self(name), dtype=np.float64)
        except (TypeError, ValueError, OverflowError):
            array = np.empty(0)
        fits = array.ndim == len(shape) and all(
            want in (-1, got) for want, got in zip(shape, array.shape, strict=True)
        )
        if not fits or array.size == 0 or not np.isfinite(array).all():
            raise InputError(f"{self._where}: {name}", "something else", f"finite numbers of shape {shape}")
        return array

    def number(self, name: str) -> float:
        return float(self.array(name))

    def interval(self, name: str) -> tuple[float, float]:
        low, high = self.array(name, 2)
        if not low < high:
            raise InputError(f"{self._where}: {name}", f"{low} to {high}", "lowest, then highest")
        return float(low), float(high)


def _read_version_1(fields: _Fields) -> Calibration:
    optics, camera, fit = (fields.section(name) for name in ("optics", "camera", "fit"))
    valid, model = fields.section("valid"), fields.section("model")
    weighting = fit("weighting")
    if weighting not in WEIGHTINGS:
        raise InputError("calibration: fit: weighting", repr(weighting), f"one of {', '.join(WEIGHTINGS)}")
    if model("features") != list(FEATURES):
        raise InputError("calibration: model: features", repr(model("features")), repr(list(FEATURES)))
    radius = model.number("disc_radius_m")
    nodes = model.array("scatter_defocus_m", -1)
    width, height = optics.array("image_size_px", 2)
    count = len(FEATURES)
    places = model.array("bead_places_m", -1, 2) if "bead_places_m" in model else np.empty((0, 2))
    beads = BeadField(radius, places)
    return Calibration(
        OpticalModel(
            FieldCurves(
                radius, model.interval("defocus_interval_m"), model.array("coefficients", count, -1, -1)
            ),
            FocusSurface(
                radius, model.array("focus_surface_m", -1), model.number("focus_variance_m2"), beads
            ),
            FieldMap(radius, model.array("ln_reference_amplitude_per_flux", -1)),
            nodes,
            model.array("scatter_covariance", len(nodes), count, count),
            FieldMap(radius, model.array("ln_illumination", -1)) if "ln_illumination" in model else None,
        ),
        pixel_size=optics.number("pixel_size_m"),
        image_size=(int(width), int(height)),
        weighting=weighting,
        window_px=int(fit.number("window_px")),
        camera=CameraNoise(
            camera.number("offset_adu"),
            camera.number("gain_adu_per_electron"),
            camera.number("read_noise_electrons"),
            camera.number("saturation_adu"),
        ),
        valid=ValidRange(
            valid.interval("defocus_m"),
            valid.interval("x_m"),
            valid.interval("y_m"),
            valid.interval("flux_electrons"),
        ),
        method=fields("method"),
        provenance=fields("provenance"),
        psf=psf_model.read(fields.section("psf"), beads) if "psf" in fields else None,
    )


def _read_version_2(fields: _Fields) -> Calibration:
    stored = fields.section("field_correction")
    half_width, half_height = stored.array("half_size_m", 2)
    modes = FieldModes((float(half_width), float(half_height)), int(stored.number("degree")))
    if stored("modes") != list(modes.names):
        raise InputError(
            "calibration: field_correction: modes", repr(stored("modes")), repr(list(modes.names))
        )
    mean, covariance = stored.array("coefficients_m", -1), stored.array("covariance_m2", -1, -1)
    correction = FieldCorrection(modes, mean, covariance, stored("method"), stored("provenance"))
    return _read_version_1(fields).with_correction(correction)


_READERS = {1: _read_version_1, 2: _read_version_2}
