"""Fits against picassosr, detection against trackpy: one core, processor time, the same images."""

from __future__ import annotations

import importlib
import math
from types import ModuleType
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from mems6dof_ros.bench.material import Material
from mems6dof_ros.bench.table import Row, processor_seconds
from mems6dof_ros.localization.detection import detect
from mems6dof_ros.localization.fitting import fit_gaussians
from mems6dof_ros.localization.gaussian import Array, cramer_rao, pixel_grid
from mems6dof_ros.localization.validation import OFFSET_ADU, matched_field

WINDOW_PX = 21
ABSENT = "not installed: requirements/bench.txt"


def fits(material: Material) -> list[Row]:
    """Gaussian truth, 20 000 electrons, background 20, starts off by up to 1.5 px."""
    count = 400 if material.quick else 2500
    image, truth, camera = matched_field(count, 1, WINDOW_PX)
    start = truth[:, :2] + np.random.default_rng(2).uniform(-1.5, 1.5, (count, 2))
    bound = np.sqrt(np.diag(cramer_rao(np.r_[0, 0, truth[0, 2:]], *pixel_grid(WINDOW_PX))))[:2]
    peer = _optional("picasso.fitting.gaussfit")
    rows = []
    for name, weighting, likelihood, least in (
        ("fits, 21 px, light-weighting", "light_weighting", True, 5.0),
        ("fits, 21 px, uniform", "uniform", False, 4.0),
    ):
        against = f"picassosr, rotated Gaussian, {'maximum likelihood' if likelihood else 'least squares'}"

        def ours(weighting: str = weighting) -> Array:
            return fit_gaussians(image, start, camera, weighting, WINDOW_PX).parameters

        def theirs(likelihood: bool = likelihood) -> Array:
            return _picasso(image, start, likelihood)

        quality = _quality("", ours(), truth, bound)
        if peer is None:
            (seconds,) = processor_seconds(ours)
            rows.append(Row(name, count / seconds, "/s", against, note=ABSENT, details=quality))
        else:
            seconds, reference = processor_seconds(ours, theirs)
            quality |= _quality("picassosr ", theirs(), truth, bound)
            details = {"ratio": reference / seconds, **quality}
            rows.append(
                Row(name, count / seconds, "/s", against, count / reference, reference / seconds, least, None,
                    details=details)
            )  # fmt: skip
        if weighting == "light_weighting":
            worst = max(quality["rms x / Cramer-Rao"], quality["rms y / Cramer-Rao"])
            rows.append(
                Row("  rms over the Cramer-Rao bound", worst, "", "1.02 and sampling error", None,
                    worst, None, 1.02 + 2 / math.sqrt(2 * count))
            )  # fmt: skip
            failed = float(quality["failures"])
            rows.append(Row("  failures", failed, "fits", figure=failed, most=0.0))
    return rows


def _quality(prefix: str, parameters: Array, truth: Array, bound: Array) -> dict[str, float]:
    error = parameters[:, :2] - truth[:, :2]
    lost = ~(np.abs(error) < 1.0).all(axis=1)
    rms = np.sqrt(np.mean(error[~lost] ** 2, axis=0)) / bound
    return {
        f"{prefix}rms x / Cramer-Rao": float(rms[0]),
        f"{prefix}rms y / Cramer-Rao": float(rms[1]),
        f"{prefix}failures": int(lost.sum()),
    }


def _picasso(image: np.ndarray, start: Array, likelihood: bool) -> Array:
    """x and y (n, 2) px by picassosr from windows cut about ``start``, with its own first guesses."""
    gaussfit = importlib.import_module("picasso.fitting.gaussfit")
    seeds = importlib.import_module("picasso.fitting.seeds")
    corner = np.rint(start).astype(int) - WINDOW_PX // 2
    reach = np.arange(WINDOW_PX)
    rows, columns = corner[:, 1, None, None] + reach[:, None], corner[:, 0, None, None] + reach
    inside = np.clip(rows, 0, image.shape[0] - 1), np.clip(columns, 0, image.shape[1] - 1)
    spots = (image[inside].astype(np.float32) - OFFSET_ADU) / 2.0
    guess = seeds.initial_parameters_gauss(spots, WINDOW_PX, rotated=True)
    parameters = gaussfit.fit_spots(gaussfit.ROTATED, spots, guess, mle=likelihood)[0]
    return np.asarray(parameters[:, 1:3] + corner, float)


def detection(material: Material) -> list[Row]:
    """One full frame; particles with none within 4 um and a whole window, found by either."""
    frame = material.frames[0]
    peer = _optional("trackpy")
    truth = frame.truth[0].position[:, :2]
    limit = 0.5 * material.size * frame.pixel_size - 3e-6
    wanted = (cKDTree(truth).query(truth, k=2)[0][:, 1] > 4e-6) & (np.abs(truth).max(axis=1) < limit)

    def found(positions_px: Array) -> int:
        positions = (positions_px - (material.size - 1) / 2) * frame.pixel_size
        return int((cKDTree(positions).query(truth[wanted])[0] < 0.5e-6).sum()) if len(positions) else 0

    def ours() -> Array:
        return detect(frame.image)

    details: dict[str, Any] = {"isolated particles": int(wanted.sum()), "found": found(ours())}
    if peer is None:
        (seconds,) = processor_seconds(ours)
        return [
            Row("detection, one frame", seconds * 1e3, "ms", "trackpy.locate", note=ABSENT, details=details)
        ]

    def theirs() -> Array:
        table = peer.locate(frame.image, 21, minmass=20_000, engine="numba")
        return np.asarray(table[["x", "y"]], float)

    seconds, reference = processor_seconds(ours, theirs, repeats=3)
    details["found by trackpy"] = found(theirs())
    same = details["found"] >= details["found by trackpy"]
    return [
        Row("detection, one frame", seconds * 1e3, "ms", "trackpy.locate", reference * 1e3,
            reference / seconds if same else 0.0, 100.0, None,
            note="" if same else "trackpy finds particles that detection misses", details=details)
    ]  # fmt: skip


def _optional(name: str) -> ModuleType | None:
    try:
        return importlib.import_module(name)
    except ImportError:
        return None
