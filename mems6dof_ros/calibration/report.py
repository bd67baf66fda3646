"""The report of a calibration: one self-contained HTML page with the paper's Figure 2 and what else tells
whether to trust the file."""

from __future__ import annotations

import base64
import io
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader
from matplotlib.figure import Figure as Picture
from numpy.polynomial import Chebyshev

from mems6dof_ros.calibration.calibrate import CalibrationResult
from mems6dof_ros.calibration.field_curves import Array
from mems6dof_ros.calibration.model_fit import GROUPS
from mems6dof_ros.calibration.optical_model import FEATURES
from mems6dof_ros.calibration.psf_fit import WAVEFRONT
from mems6dof_ros.calibration.psf_pupil import PUPIL_TERMS
from mems6dof_ros.calibration.rho_amp import inverse_curves, rho_amp_of_scan
from mems6dof_ros.documents import write_whole

#: The paper's axial range, +/- m.
_PAPER_RANGE = 4e-6

_LABELS = {
    "ln_sigma_x": "ln σx / px",
    "ln_sigma_y": "ln σy / px",
    "atanh_rho": "atanh ρ",
    "rho_amp": "ρ_amp",
    "dx": "dx / nm",
    "dy": "dy / nm",
    "h22": "h22",
}


def write_report(result: CalibrationResult, path: str | Path) -> None:
    """Write the page to ``path``, whole or not at all; InputError where it cannot be written."""
    pictures = [
        ("A bead through focus, with the major axis of its fit (Figure 2a)", through_focus(result)),
        ("ρ_amp against z, every bead, and the polynomial (Figure 2b)", amplitude_curves(result)),
        ("z over the field at one ρ_amp, and residuals of the Zernike model (Figure 2c)", field_maps(result)),
        ("Features against defocus: beads and model at their places", feature_curves(result)),
        ("Scatter of the beads about the model, held out", scatter(result)),
        ("Cross-validation over whole beads", cross_validation(result)),
        ("Focus surface and the beads' own heights", focus_surface(result)),
        ("The beads' pupils and the smooth field through them (method psf)", pupils(result)),
        ("Illumination: the beads' light in focus", illumination(result)),
        ("Beads used and rejected", bead_map(result)),
    ]
    environment = Environment(loader=PackageLoader("mems6dof_ros.calibration", "."), autoescape=True)
    text = environment.get_template("report.html").render(
        calibration=result.calibration,
        provenance=result.calibration.provenance,
        pictures=[(title, _png(picture)) for title, picture in pictures if picture is not None],
        rejected=result.rejected,
        warnings=result.warnings,
        beads=len(result.beads),
    )
    write_whole(path, text)


def through_focus(result: CalibrationResult) -> Picture | None:
    """Windows of one bead at about a dozen stage positions, with the major axis of the fitted Gaussian."""
    stack = result.stacks[0]
    if stack.shown < 0:
        return None
    bead = stack.beads[stack.shown]
    planes = np.unique(np.linspace(0, len(bead.stage_z) - 1, 11).round().astype(int))
    picture = Picture(figsize=(11, 1.6), layout="constrained")
    axes = picture.subplots(1, len(planes))
    size = stack.gallery.shape[1]
    for axis, k in zip(axes, planes, strict=True):
        window = stack.gallery[int(np.argmin(np.abs(stack.stage_z - bead.stage_z[k])))]
        axis.imshow(window, cmap="magma")
        _, _, _, sx, sy, rho, _ = bead.fits.parameters[k]
        values, vectors = np.linalg.eigh([[sx**2, rho * sx * sy], [rho * sx * sy, sy**2]])
        dx, dy = 2 * np.sqrt(values[1]) * vectors[:, 1]
        middle = size / 2 - 0.5
        axis.plot([middle - dx, middle + dx], [middle - dy, middle + dy], "c", lw=1)
        axis.set(xticks=[], yticks=[], xlim=(0, size - 1), ylim=(size - 1, 0))
        defocus = bead.stage_z[bead.in_focus] - bead.stage_z[k]
        axis.set_title(f"{defocus * 1e6:+.1f} µm", fontsize=8)
    return picture


def amplitude_curves(result: CalibrationResult) -> Picture:
    """rho_amp of every bead with its own scan as reference, as the paper; one bead's polynomial."""
    picture = Picture(figsize=(6.5, 4), layout="constrained")
    axis = picture.subplots()
    for bead, sharpest in zip(result.beads, result.fit.sharpest, strict=True):
        axis.plot((sharpest - bead.stage_z) * 1e6, rho_amp_of_scan(bead), **_dots(result))
    bead = result.stacks[0].beads[max(result.stacks[0].shown, 0)]
    z, r = bead.stage_z[bead.in_focus] - bead.stage_z, rho_amp_of_scan(bead)
    near = np.abs(z) <= _PAPER_RANGE
    degree = min(16, int(np.count_nonzero(near)) // 2)
    polynomial = Chebyshev.fit(r[near], z[near], degree)
    at = np.linspace(float(r[near].min()), float(r[near].max()), 400)
    axis.plot(z[near] * 1e6, r[near], "k.", ms=4, label="the bead nearest to the centre")
    axis.plot(polynomial(at) * 1e6, at, "C3", lw=1, label=f"its polynomial z(ρ_amp) of order {degree}")
    reach = 1.25e6 * float(np.abs(z[near]).max())
    axis.set(
        xlabel="z / µm", ylabel="ρ_amp", xlim=(-reach, reach), ylim=(1.3 * r[near].min(), 1.3 * r[near].max())
    )
    axis.legend()
    return picture


def field_maps(result: CalibrationResult) -> Picture | None:
    """z over the field at a common rho_amp, and the residuals of the paper's Zernike model at the beads."""
    if len(result.curves) < 6:
        return None
    fit = result.fit
    order, radius = fit.orders.field["rho_amp"], fit.model.curves.radius
    curves, residual, place = inverse_curves(result.curves, fit.sharpest, radius, order)
    valid = result.calibration.valid
    x, y = np.meshgrid(np.linspace(*valid.x, 60), np.linspace(*valid.y, 60))
    at = np.full(x.size, 0.5 * (curves.interval[0] + curves.interval[1]))
    z = curves.values(curves.local(x.ravel(), y.ravel()), at)[:, 0]
    z = z + result.calibration.model.focus(x.ravel(), y.ravel())
    picture = Picture(figsize=(11, 4), layout="constrained")
    left, middle, right = picture.subplots(1, 3)
    extent = (valid.x[0] * 1e6, valid.x[1] * 1e6, valid.y[1] * 1e6, valid.y[0] * 1e6)
    shown = left.imshow(z.reshape(x.shape) * 1e6, extent=extent, cmap="viridis")
    left.set(title=f"z at ρ_amp = {at[0]:.3g}", xlabel="X / µm", ylabel="Y / µm")
    picture.colorbar(shown, ax=left, label="µm")
    beads, which = np.unique(place, axis=0, return_inverse=True)
    mean = np.bincount(which.ravel(), residual) / np.bincount(which.ravel())
    limit = float(np.percentile(np.abs(mean), 95)) * 1e9
    dots = middle.scatter(*(beads.T * 1e6), c=mean * 1e9, cmap="coolwarm", vmin=-limit, vmax=limit, s=25)
    middle.set(title="mean residual of each bead", xlabel="X / µm", ylabel="Y / µm", aspect="equal")
    middle.invert_yaxis()
    picture.colorbar(dots, ax=middle, label="nm")
    right.hist(residual * 1e9, bins=60)
    right.set(title=f"residuals, {np.std(residual) * 1e9:.0f} nm rms", xlabel="nm")
    return picture


def feature_curves(result: CalibrationResult) -> Picture:
    """Features of all beads, and the model at the centre of the field."""
    names = list(_LABELS)
    picture = Picture(figsize=(11, 5.5), layout="constrained")
    axes = picture.subplots(2, 4).ravel()
    u_model, model = _centre(result)
    for axis, name in zip(axes, names, strict=False):
        index = FEATURES.index(name)
        scale = 1e9 if name in ("dx", "dy") else 1.0
        for curve, sharpest in zip(result.curves, result.fit.sharpest, strict=True):
            u = sharpest - curve.stage_z
            values = curve.features[:, index].copy()
            if name in ("dx", "dy"):
                values -= values[int(np.argmin(np.abs(u)))]
            axis.plot(u * 1e6, values * scale, **_dots(result))
        axis.plot(u_model * 1e6, model[:, index] * scale, "C3", lw=1)
        low, high = np.percentile(model[:, index] * scale, [0, 100])
        margin = 0.5 * (high - low)
        axis.set(title=_LABELS[name], xlabel="defocus / µm", ylim=(low - margin, high + margin))
    axes[-1].axis("off")
    return picture


def scatter(result: CalibrationResult) -> Picture:
    """Standard deviation of the beads about the model against defocus, as an error of z where possible."""
    model = result.calibration.model
    picture = Picture(figsize=(11, 3.6), layout="constrained")
    left, right = picture.subplots(1, 2)
    for name in ("ln_sigma_x", "ln_sigma_y", "atanh_rho"):
        index = FEATURES.index(name)
        left.plot(model.nodes * 1e6, np.sqrt(model.scatter[:, index, index]), label=_LABELS[name])
    left.set(title="scatter of shapes, fit noise taken off", xlabel="defocus / µm", ylim=(0, None))
    left.legend()
    residual = np.concatenate(result.fit.residual)
    u = np.concatenate(result.fit.defocus)
    index = FEATURES.index("atanh_rho")
    right.plot(u * 1e6, residual[:, index], **_dots(result))
    limit = float(np.percentile(np.abs(residual[:, index]), 99))
    right.set(title="held-out residuals of atanh ρ", xlabel="defocus / µm", ylim=(-1.5 * limit, 1.5 * limit))
    return picture


def cross_validation(result: CalibrationResult) -> Picture | None:
    """Held-out scores against Zernike order, one line per polynomial degree, for every group."""
    tables = result.fit.validation.curves
    if not any(len(table) > 1 for table in tables.values()):
        return None
    picture = Picture(figsize=(11, 3.2), layout="constrained")
    for axis, name in zip(picture.subplots(1, len(GROUPS)), GROUPS, strict=True):
        for degree in sorted({degree for _, degree in tables[name]}):
            orders = sorted(order for order, d in tables[name] if d == degree)
            axis.semilogy(orders, [tables[name][o, degree] for o in orders], ".-", label=f"degree {degree}")
        chosen = result.fit.orders.field[name], result.fit.orders.degree[name]
        if chosen in tables[name]:
            axis.plot(chosen[0], tables[name][chosen], "ko", mfc="none", ms=10)
        axis.set_title(f"{name}: order {chosen[0]}, degree {chosen[1]}", fontsize=10)
        axis.set(xlabel="Zernike order", xticks=sorted({order for order, _ in tables[name]}))
    picture.axes[0].set_ylabel("squared residual over variance")
    picture.axes[-1].legend(fontsize=7)
    return picture


def focus_surface(result: CalibrationResult) -> Picture | None:
    """Height of the sharpest focus over the field, with the beads' own heights."""
    if len(result.beads) < 3:
        return None
    valid = result.calibration.valid
    x, y = np.meshgrid(np.linspace(*valid.x, 60), np.linspace(*valid.y, 60))
    z = result.calibration.model.focus(x.ravel(), y.ravel()).reshape(x.shape)
    picture = Picture(figsize=(9, 3.8), layout="constrained")
    left, right = picture.subplots(1, 2)
    extent = (valid.x[0] * 1e6, valid.x[1] * 1e6, valid.y[1] * 1e6, valid.y[0] * 1e6)
    shown = left.imshow(z * 1e6, extent=extent)
    left.set(title="focus surface", xlabel="X / µm", ylabel="Y / µm")
    picture.colorbar(shown, ax=left, label="µm")
    places = np.array([(c.x, c.y) for c in result.curves]) * 1e6
    dots = right.scatter(*places.T, c=result.fit.own_height * 1e9, cmap="coolwarm", s=25)
    right.set(title="own heights of the beads", xlabel="X / µm", ylabel="Y / µm", aspect="equal")
    right.invert_yaxis()
    picture.colorbar(dots, ax=right, label="nm")
    return picture


def pupils(result: CalibrationResult) -> Picture | None:
    """Wavefront coefficients of every bead with the mean of the model; two of them over the field."""
    model = result.calibration.psf
    if model is None:
        return None
    nm = model.imaging.wavelength * 1e9
    found = np.array([pupil.parameters[WAVEFRONT] for pupil in result.pupils]) * nm
    x, y = (np.array([getattr(curve, axis) for curve in result.curves]) for axis in "xy")
    smooth = model.at(x, y)[0] * nm
    picture = Picture(figsize=(11, 3.6), layout="constrained")
    left, middle, right = picture.subplots(1, 3)
    terms = np.arange(len(PUPIL_TERMS))
    left.plot(terms, found.T, ".", color="0.6", ms=3)
    left.errorbar(
        terms,
        smooth.mean(axis=0),
        np.sqrt(np.diag(model.scatter)[:-1]) * nm,
        fmt="C3_",
        label="mean, scatter",
    )
    left.set(title="wavefront, all beads", xlabel="Zernike term (OSA/ANSI)", ylabel="nm rms", xticks=terms)
    left.set_xticklabels([str(term) for term in PUPIL_TERMS])
    left.legend(fontsize=7)
    for axis, index in ((middle, 0), (right, 1)):
        dots = axis.scatter(x * 1e6, y * 1e6, c=found[:, index], cmap="coolwarm", s=25)
        axis.set(title=f"astigmatism, {(45, 0)[index]} degrees", xlabel="X / µm", ylabel="Y / µm")
        axis.set_aspect("equal")
        axis.invert_yaxis()
        picture.colorbar(dots, ax=axis, label="nm rms")
    return picture


def illumination(result: CalibrationResult) -> Picture | None:
    """Light of every bead against its distance from the axis, with the map."""
    light = result.calibration.model.illumination
    if light is None or len(result.beads) < 2:
        return None
    x, y = (np.array([getattr(curve, axis) for curve in result.curves]) for axis in "xy")
    flux = np.array([bead.flux for bead in result.beads])
    picture = Picture(figsize=(6.5, 3.4), layout="constrained")
    axis = picture.subplots()
    radius = np.hypot(x, y) * 1e6
    axis.plot(radius, flux / np.median(flux), "o", color="0.6", ms=4, label="beads")
    axis.plot(radius, np.exp(light(x, y)), "C3.", label="map, 1 on the axis")
    axis.set(xlabel="distance from the axis / µm", ylabel="relative light", ylim=(0, None))
    axis.legend()
    return picture


def bead_map(result: CalibrationResult) -> Picture:
    """Where the used beads are, and the rejected ones by reason."""
    picture = Picture(figsize=(7, 4.2), layout="constrained")
    axis = picture.subplots()
    used = np.array([bead.fits.parameters[bead.in_focus, :2] for bead in result.beads])
    axis.plot(*used.T, "o", color="0.5", ms=4, label=f"used ({len(used)})")
    for reason in sorted({r.reason.split(":")[0] for r in result.rejected}):
        places = np.array([(r.x_px, r.y_px) for r in result.rejected if r.reason.startswith(reason)])
        axis.plot(*places.T, "x", label=f"{reason[:45]} ({len(places)})")
    width, height = result.calibration.image_size
    axis.set(xlim=(0, width), ylim=(height, 0), aspect="equal", xlabel="column / px", ylabel="row / px")
    axis.legend(fontsize=7, loc="center left", bbox_to_anchor=(1, 0.5))
    return picture


def _centre(result: CalibrationResult) -> tuple[Array, Array]:
    """Defocus (n,) and all features (n, k) of the model at the centre of the field."""
    curves = result.calibration.model.curves
    u = np.linspace(*curves.interval, 300)
    local = curves.local(np.zeros(1), np.zeros(1))[0]
    return u, curves.basis(u) @ local.T


def _dots(result: CalibrationResult) -> dict[str, Any]:
    """How single measurements of many or few beads are drawn."""
    return {"ls": "", "marker": ".", "ms": 1.5 if len(result.beads) > 30 else 4, "color": "0.6", "alpha": 0.5}


def _png(picture: Picture) -> str:
    buffer = io.BytesIO()
    picture.savefig(buffer, format="png", dpi=110)
    return base64.b64encode(buffer.getvalue()).decode()
