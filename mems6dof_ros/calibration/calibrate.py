"""From focus stacks to a calibration: the whole procedure, with its refusals and warnings."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from mems6dof_ros import __version__
from mems6dof_ros.calibration.checks import (
    against_reference,
    drift,
    stage_errors,
    step_against_aperture,
)
from mems6dof_ros.calibration.field_curves import Array
from mems6dof_ros.calibration.file import Calibration, ValidRange
from mems6dof_ros.calibration.focus_stack import BeadStack, FocusStack, Rejection
from mems6dof_ros.calibration.model_fit import (
    GROUPS,
    BeadCurve,
    ModelFit,
    Orders,
    fit_focus,
    fit_model,
    sharpest_stage,
)
from mems6dof_ros.calibration.optical_model import (
    FEATURES,
    FieldMap,
    FocusSurface,
    features,
    field_position,
    fit_field_map,
)
from mems6dof_ros.calibration.psf_fit import Retrieval
from mems6dof_ros.calibration.psf_model import PsfBead, PsfModel, fit_psf
from mems6dof_ros.calibration.psf_pupil import Imaging
from mems6dof_ros.calibration.rho_amp import reference_map
from mems6dof_ros.errors import InputError

#: A bead whose place departs from its neighbours' by this many times the usual mean square is left out.
OUTLIER_SIDEWAYS = 8.0
#: Probability with which a bead like the others is left out for its shape. A local aberration is one number
#: that stays through focus, so mean squares over the median one follow chi-square of one degree of freedom: a
#: tighter limit takes the scatter away that is to be claimed.
OUTLIER_PROBABILITY = 1e-5
OUTLIER = float(chdtri(1, OUTLIER_PROBABILITY) / chdtri(1, 0.5))
#: Shapes do not depend on brightness; noise is in the covariance. Tested from 1/33 to 33 times, by `mems6dof
#: validate calibration`, part brightness.
BRIGHTNESS_FACTOR = 30.0
#: Below this number of beads the scatter between particles is poorly known.
FEW_BEADS = 10
#: Field orders of the illumination map.
ILLUMINATION_ORDERS = (0, 2, 3)
#: Departure of images from the pupil model, relative to their light, that deserves a warning.
PSF_MISFIT = 0.05

#: Orders for a quick look at one stack.
_PLAIN = Orders(dict.fromkeys(GROUPS, 1), dict.fromkeys(GROUPS, 8), 1)


@dataclass(frozen=True)
class CalibrationSettings:
    """``axial_range`` m: largest |defocus| to declare valid (default: all that the stacks cover); stacks that
    reach 2 um further let particles beyond it be recognised. ``orders``: instead of choosing them by
    cross-validation. ``rotations`` rad: the substrate's orientation in each stack.
    ``numerical_aperture`` and ``reference``, an earlier calibration of the same optics: what the stage's step
    and direction are checked against. With ``wavelength`` of emission and ``bead_diameter``, m, as well, the
    point-spread function for method psf is calibrated too."""

    axial_range: float | None = None
    numerical_aperture: float | None = None
    wavelength: float | None = None
    bead_diameter: float | None = None
    reference: Calibration | None = None
    orders: Orders | None = None
    rotations: tuple[float, ...] | None = None


@dataclass(frozen=True)
class CalibrationResult:
    """A ``calibration`` and how it came about: the ``fit``, the ``beads`` used with their curves, the
    ``rejected`` ones, ``warnings``, one sentence each, and the beads' ``pupils`` where they were wanted."""

    calibration: Calibration
    fit: ModelFit
    stacks: tuple[FocusStack, ...]
    beads: tuple[BeadStack, ...]
    curves: tuple[BeadCurve, ...]
    rejected: tuple[Rejection, ...]
    warnings: tuple[str, ...]
    pupils: tuple[Retrieval, ...] = ()


def calibrate(
    stacks: Sequence[FocusStack],
    settings: CalibrationSettings | None = None,
    progress: Callable[[str], None] = lambda _: None,
) -> CalibrationResult:
    """Calibrate the optics from one or several focus stacks of the same camera and fit.

    Raises InputError where the stacks do not belong together, no bead is usable, or they leave no
    common range through focus.
    """
    settings = settings or CalibrationSettings()
    first = _check_alike(stacks, settings)
    rejected = [replace(r, stack=index) for index, stack in enumerate(stacks) for r in stack.rejected]
    beads = [(index, bead) for index, stack in enumerate(stacks) for bead in stack.beads]
    if not beads:
        reasons = "; ".join(sorted({r.reason for r in rejected})) or "nothing detected"
        raise InputError("focus stack", f"no usable bead ({reasons})", "isolated beads through focus")
    radius = float(np.hypot(*first.image_size)) / 2 * first.pixel_size
    while True:
        reference = reference_map([bead for _, bead in beads], radius, first.pixel_size, first.image_size)
        curves = [_curve(bead, index, reference, first) for index, bead in beads]
        interval = _interval(curves)
        fit = fit_model(curves, reference, interval, settings.orders, settings.rotations, progress)
        departure, feature = _departures(fit)
        sideways = feature < GROUPS["lateral"].stop
        outliers = departure > np.where(sideways, OUTLIER_SIDEWAYS, OUTLIER)
        if not outliers.any() or len(beads) < FEW_BEADS:
            break
        for k in np.flatnonzero(outliers):
            index, bead = beads[k]
            x, y = bead.fits.parameters[bead.in_focus, :2]
            what = "drifts, or moves in another's light" if sideways[k] else "departs from its neighbours"
            rejected.append(Rejection(x, y, f"{what}: {departure[k]:.0f} times the usual scatter", index))
        beads = [bead for bead, out in zip(beads, outliers, strict=True) if not out]
    chosen = [bead for _, bead in beads]
    illumination = _illumination(chosen, curves, radius)
    psf, pupils = _fit_psf(chosen, curves, fit, settings, first.pixel_size, progress)
    calibration = Calibration(
        replace(fit.model, illumination=illumination),
        first.pixel_size,
        first.image_size,
        first.weighting,
        first.window_px,
        first.camera,
        _valid_range(chosen, curves, interval, first, settings.axial_range, illumination),
        provenance=_provenance(stacks, settings, fit, len(beads), len(rejected)),
        psf=psf,
    )
    warnings = _warnings(curves, rejected, fit, settings, first.pixel_size)
    if psf is not None and psf.misfit > PSF_MISFIT:
        warnings.append(
            f"method psf: the images depart from the pupil model by {psf.misfit:.1%} of the light; are"
            " aperture, wavelength and diameter right?"
        )
    return CalibrationResult(
        calibration,
        fit,
        tuple(stacks),
        tuple(chosen),
        tuple(curves),
        tuple(rejected),
        tuple(warnings),
        tuple(pupils),
    )


def _illumination(beads: Sequence[BeadStack], curves: Sequence[BeadCurve], radius: float) -> FieldMap:
    """ln of the beads' light in focus over the field, zero on the axis: what the illumination makes of beads
    that are alike on average."""
    x, y = (np.array([getattr(curve, axis) for curve in curves]) for axis in "xy")
    found, _ = fit_field_map(radius, x, y, np.log([bead.flux for bead in beads]), ILLUMINATION_ORDERS)
    on_axis = found(np.zeros(1), np.zeros(1))[0]
    return FieldMap(radius, found.coefficients - on_axis * (np.arange(len(found.coefficients)) == 0))


def _fit_psf(
    beads: Sequence[BeadStack],
    curves: Sequence[BeadCurve],
    fit: ModelFit,
    settings: CalibrationSettings,
    pixel_size: float,
    progress: Callable[[str], None],
) -> tuple[PsfModel | None, list[Retrieval]]:
    """The point-spread function and every bead's pupil, where it is known what to expect of the images."""
    aperture, wavelength, diameter = (
        settings.numerical_aperture,
        settings.wavelength,
        settings.bead_diameter,
    )
    if aperture is None or wavelength is None or diameter is None:
        return None, []
    found = []
    for bead, curve, sharpest in zip(beads, curves, fit.sharpest, strict=True):
        if bead.windows is None:
            raise InputError("method psf", "beads without their pixels", "stacks measured by measure_stack")
        x, y = bead.fits.parameters[bead.in_focus, :2]
        found.append(PsfBead(bead.windows, curve.x, curve.y, float(sharpest), (float(x), float(y))))
    model = fit.model
    x, y = (np.array([getattr(curve, axis) for curve in curves]) for axis in "xy")

    def focus(stages: Array) -> FocusSurface:
        return fit_focus(curves, stages, model.curves.radius, settings.rotations, fit.orders.focus).surface

    return fit_psf(
        found,
        Imaging(aperture, wavelength, diameter, pixel_size),
        model.curves.radius,
        model.curves.interval,
        fit.sharpest + model.focus(x, y),
        focus,
        lambda done, total: progress(f"pupil of bead {done} of {total}"),
    )


def _check_alike(stacks: Sequence[FocusStack], settings: CalibrationSettings) -> FocusStack:
    if not stacks:
        raise InputError("calibration", "no focus stack", "at least one")
    first = stacks[0]
    for stack in stacks[1:]:
        for name in ("pixel_size", "image_size", "weighting", "window_px"):
            if getattr(stack, name) != getattr(first, name):
                raise InputError(
                    stack.description,
                    f"{name} {getattr(stack, name)}",
                    f"{getattr(first, name)} as in {first.description}",
                )
    if settings.rotations is not None and len(settings.rotations) != len(stacks):
        raise InputError("rotations", f"{len(settings.rotations)} values", f"one per stack, {len(stacks)}")
    return first


def _curve(bead: BeadStack, stack: int, reference: FieldMap, first: FocusStack) -> BeadCurve:
    x, y = field_position(bead.fits.parameters, first.pixel_size, first.image_size)
    values, noise = features(bead.fits, bead.moments, first.pixel_size, reference(x, y))
    values[:, 0], values[:, 1] = x, y
    return BeadCurve(x[bead.in_focus], y[bead.in_focus], bead.stage_z, values, noise, stack)


def _interval(curves: Sequence[BeadCurve]) -> tuple[float, float]:
    """Defocus that at least 80 % of the beads cover, on either side."""
    low, high = [], []
    for curve in curves:
        u = sharpest_stage(curve) - curve.stage_z
        low.append(u.min())
        high.append(u.max())
    interval = (float(np.quantile(low, 0.8)), float(np.quantile(high, 0.2)))
    if not interval[0] < 0 < interval[1]:
        raise InputError("focus stacks", "beads in focus only at the ends", "planes on both sides of focus")
    return interval


def _departures(fit: ModelFit) -> tuple[Array, NDArray[np.intp]]:
    """Mean square of each bead's held-out residuals over the median bead's (b,), in that of FEATURES (b,)
    where it is worst, against the limits."""
    square = np.array([np.mean(residual**2, axis=0) for residual in fit.residual])
    kept = square[:, : FEATURES.index("rho_amp")]
    ratio = kept / np.maximum(np.median(kept, axis=0), 1e-30)
    limits = np.full(kept.shape[1], OUTLIER)
    limits[GROUPS["lateral"]] = OUTLIER_SIDEWAYS
    worst = np.argmax(ratio / limits, axis=1)
    return ratio[np.arange(len(ratio)), worst], worst


def _valid_range(
    beads: Sequence[BeadStack],
    curves: Sequence[BeadCurve],
    interval: tuple[float, float],
    first: FocusStack,
    limit: float | None,
    illumination: FieldMap,
) -> ValidRange:
    """Half a bead distance beyond the outermost beads, inside the image; the whole image for few beads."""
    half = [(n - 1) / 2 * first.pixel_size for n in first.image_size]
    margin = np.inf if len(beads) < FEW_BEADS else np.sqrt(half[0] * half[1] / len(beads))
    x, y = (
        (max(-edge, min(values) - margin), min(edge, max(values) + margin))
        for edge, values in zip(
            half, ([curve.x for curve in curves], [curve.y for curve in curves]), strict=True
        )
    )
    x_bead, y_bead = (np.array([getattr(curve, axis) for curve in curves]) for axis in "xy")
    flux = np.array([bead.flux for bead in beads]) / np.exp(illumination(x_bead, y_bead))
    if limit is not None:
        interval = (max(interval[0], -limit), min(interval[1], limit))
    return ValidRange(
        interval, x, y, (float(flux.min()) / BRIGHTNESS_FACTOR, float(flux.max()) * BRIGHTNESS_FACTOR)
    )


def _warnings(
    curves: Sequence[BeadCurve],
    rejected: Sequence[Rejection],
    fit: ModelFit,
    settings: CalibrationSettings,
    pixel_size: float,
) -> list[str]:
    found = []
    beads = len(curves)
    if settings.numerical_aperture is not None:
        found += step_against_aperture(curves, pixel_size, settings.numerical_aperture)
    if settings.reference is not None:
        found += against_reference(curves, settings.reference.model, "the reference calibration")
    found += _against_each_other(curves, fit)
    found += drift(fit, curves)
    found += stage_errors(fit, curves)
    saturated = sum(r.reason.startswith("saturated") for r in rejected)
    if saturated > 0.1 * (beads + saturated):
        found.append(f"{saturated} of {beads + saturated} beads are saturated: lower the light or exposure")
    if beads == 1:
        found.append("one bead: field dependence and the scatter between particles are unknown")
    elif beads < FEW_BEADS:
        found.append(f"only {beads} beads: the scatter between particles is poorly known")
    return found


def _against_each_other(curves: Sequence[BeadCurve], fit: ModelFit) -> list[str]:
    """Step and direction of every further stack against the first alone."""
    stacks = [[curve for curve in curves if curve.stack == index] for index in {c.stack for c in curves}]
    if len(stacks) < 2:
        return []
    alone = fit_model(stacks[0], fit.model.reference, fit.model.curves.interval, _PLAIN).model
    return [
        f"stack {stack[0].stack + 1}: {warning}"
        for stack in stacks[1:]
        for warning in against_reference(stack, alone, "the first stack")
    ]


def _provenance(
    stacks: Sequence[FocusStack], settings: CalibrationSettings, fit: ModelFit, used: int, rejected: int
) -> dict[str, Any]:
    scores = {
        name: {f"field {order}, degree {degree}": round(score, 4) for (order, degree), score in table.items()}
        for name, table in fit.validation.curves.items()
    }
    middle = int(np.argmin(np.abs(fit.model.nodes)))
    return {
        "software": f"mems6dof_ros {__version__}",
        "settings": {
            "axial_range_m": settings.axial_range,
            "numerical_aperture": settings.numerical_aperture,
            "wavelength_m": settings.wavelength,
            "bead_diameter_m": settings.bead_diameter,
            "reference": settings.reference.calibration_id if settings.reference else None,
            "orders": "cross-validation" if settings.orders is None else asdict(settings.orders),
            "rotations_rad": None if settings.rotations is None else list(settings.rotations),
        },
        "inputs": [
            {
                "description": stack.description,
                "sha256": stack.sha256,
                "planes": len(stack.stage_z),
                "stage_z_m": [float(stack.stage_z.min()), float(stack.stage_z.max())],
                "beads": len(stack.beads),
            }
            for stack in stacks
        ],
        "beads_used": used,
        "beads_rejected": rejected,
        "orders": {name: [fit.orders.field[name], fit.orders.degree[name]] for name in GROUPS}
        | {"focus_surface": fit.orders.focus},
        "own_heights_rms_m": float(np.std(fit.own_height)),
        "scatter_in_focus": {
            name: float(np.sqrt(fit.model.scatter[middle, k, k])) for k, name in enumerate(FEATURES)
        },
        "cross_validation": scores,
    }
