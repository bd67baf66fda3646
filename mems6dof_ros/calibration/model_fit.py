"""Bead curves to the forward model: heights, focus surface, curves over the field, scatter, orders.

Every bead sits at its own unknown height and place. Its stage position of sharpest image S defines its
defocus u = S - stage_z; S is refined until the bead's curve agrees with its neighbours'. Then

    S_b = p_s + t_s . (X, Y)_b - f(X_b, Y_b) + own height of bead b

separates field curvature f from the substrate's tilt t where stacks of one substrate, turned between
them, are fitted together; in a single stack the tilt belongs to f.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mems6dof_ros.calibration.bead_field import BeadField
from mems6dof_ros.calibration.field_curves import Array, BeadSamples, FieldCurves, FieldRegression
from mems6dof_ros.calibration.optical_model import FEATURES, FieldMap, FocusSurface, OpticalModel
from mems6dof_ros.calibration.zernike import zernike, zernike_count

#: Groups of features that may need different orders, as slices of FEATURES.
GROUPS = {"lateral": slice(0, 2), "shape": slice(2, 5), "rho_amp": slice(5, 6), "moments": slice(6, 11)}
#: Orders that cross-validation chooses from.
FIELD_ORDERS = (0, 1, 2, 3, 4, 5)
DEGREES = (6, 8, 10, 12, 14, 16)
FOCUS_ORDERS = (0, 1, 2, 3, 4)

_FOLDS = 10
_NODES = 41
_ROUNDS = 3
_MANY_BEADS = 20
_LEAST_RESIDUALS = 4.0
#: A plane of a bead is left out where its residual exceeds the median one by this factor (7 sigma).
_OUTLIER = 10.0
#: Rotation of the features into those that scatter independently: size and elongation, not two widths.
_MODES = np.eye(len(FEATURES))
_MODES[2:4, 2:4] = np.array([[1, 1], [1, -1]]) / np.sqrt(2)
#: Of orders whose scores agree within this factor the fewest coefficients are taken.
_AS_GOOD = 1.01
_AS_GOOD_FOCUS = 1.03
#: Scatter assumed before it is known, as standard deviations of FEATURES: of the order of real beads'.
_FIRST_SCATTER = np.diag(np.array([5e-9, 5e-9, *[0.02] * 4, *[5e-4] * 5]) ** 2)


@dataclass(frozen=True)
class BeadCurve:
    """One bead through focus: field position ``x``, ``y`` (m), ``stage_z`` (n,) m, ``features`` (n, k) in
    the order of FEATURES with ``noise`` (n, k, k); dx, dy are here field coordinates of the fitted
    image in m. ``stack``: index of its focus stack."""

    x: float
    y: float
    stage_z: Array
    features: Array
    noise: Array
    stack: int = 0


@dataclass(frozen=True)
class Orders:
    """Zernike ``field`` order and Chebyshev ``degree`` of each of GROUPS; ``focus`` order of the surface."""

    field: dict[str, int]
    degree: dict[str, int]
    focus: int


@dataclass(frozen=True)
class CrossValidation:
    """Held-out scores. ``curves[group][field order, degree]``: mean squared residual over its variance;
    ``focus[order]``: rms in m. Empty where there are too few beads to leave one out."""

    curves: dict[str, dict[tuple[int, int], float]]
    focus: dict[int, float]


class FocusFit(NamedTuple):
    """``scores``: rms left-one-out residual m by order; the ``order`` taken; the focus ``surface``, and the
    beads' ``own_height`` (b,) m about it."""

    scores: dict[int, float]
    order: int
    surface: FocusSurface
    own_height: Array


@dataclass(frozen=True)
class ModelFit:
    """The fitted ``model`` with what tells how good it is.

    Per bead: ``sharpest`` (b,) m, stage position of sharpest image; ``own_height`` (b,) m, about
    substrate and focus surface; ``defocus`` and held-out ``residual``: lists of (n,) m and (n, k).
    """

    model: OpticalModel
    orders: Orders
    validation: CrossValidation
    sharpest: Array
    own_height: Array
    defocus: list[Array]
    residual: list[Array]


def fit_model(
    beads: Sequence[BeadCurve],
    reference: FieldMap,
    interval: tuple[float, float],
    orders: Orders | None = None,
    rotations: Sequence[float] | None = None,
    progress: Callable[[str], None] = lambda _: None,
) -> ModelFit:
    """Fit the forward model to ``beads`` over the defocus ``interval`` (m).

    ``reference``: ln of reference amplitude over flux, with which the beads' rho_amp was formed.
    ``orders``: taken as given, else chosen by cross-validation over whole beads. ``rotations``: rad, the
    substrate's orientation in each stack, to separate its tilt from the focus surface.
    """
    alignment = _Alignment(beads, reference.radius, interval)
    first = Orders(
        dict.fromkeys(GROUPS, min(2, _affordable_order(len(beads)))),
        dict.fromkeys(GROUPS, min(10, _affordable_degree(beads, interval))),
        0,
    )
    current, validation = first, CrossValidation({}, {})
    nodes = np.linspace(*interval, _NODES)
    scatter = np.repeat(_FIRST_SCATTER[None], _NODES, axis=0)
    for number in range(_ROUNDS + 1):
        progress(f"fit {number + 1} of {_ROUNDS + 1}")
        alignment.scatter = (nodes, scatter)
        regression = alignment.regression(_highest(beads, interval, orders))
        if number > 0 and orders is not None:
            current = orders
        elif number in (1, _ROUNDS) and len(beads) != 2:
            validation = _cross_validate(regression, alignment.pieces(), _highest(beads, interval, None))
            current = _best(validation)
        curves = _fit(regression, current)
        residual = _held_out(regression, alignment, current)
        scatter = _scatter(alignment, residual, alignment.inflation(current), nodes)
        if number < _ROUNDS:
            if number > 0 and len(beads) > 1:
                alignment.drop_outliers(residual)
            alignment.align(curves)
    focus = fit_focus(
        beads, alignment.sharpest, reference.radius, rotations, None if orders is None else orders.focus
    )
    return ModelFit(
        OpticalModel(curves, focus.surface, reference, nodes, scatter),
        Orders(current.field, current.degree, focus.order),
        CrossValidation(validation.curves, focus.scores),
        alignment.sharpest,
        focus.own_height,
        [sample.argument for sample in alignment.samples()],
        residual,
    )


def sharpest_stage(bead: BeadCurve) -> float:
    """Stage position (m) where sigma_x sigma_y is least: vertex of a parabola about the minimum."""
    size = bead.features[:, 2] + bead.features[:, 3]
    centre = bead.stage_z[int(np.argmin(size))]
    reach = max(1e-6, 2.1 * float(np.median(np.abs(np.diff(bead.stage_z)))))
    near = np.abs(bead.stage_z - centre) <= reach
    if near.sum() < 4:
        return float(centre)
    a, b, _ = np.polyfit((bead.stage_z[near] - centre) / reach, size[near], 2)
    vertex = -b / (2 * a) if a > 0 else 0.0
    return float(centre + reach * np.clip(vertex, -1, 1))


def bead_field(beads: Sequence[BeadCurve], radius: float) -> BeadField:
    """Where ``beads`` are, on a disc of ``radius`` m; unknown for a single one: nothing scatters there."""
    places = np.array([(bead.x, bead.y) for bead in beads]) if len(beads) > 1 else np.empty((0, 2))
    return BeadField(radius, places)


def merge_curves(parts: dict[str, FieldCurves]) -> FieldCurves:
    """One FieldCurves from one per group, padded with zeros to the highest orders."""
    shape = np.max([part.coefficients.shape for part in parts.values()], axis=0)
    coefficients = np.zeros((len(FEATURES), shape[1], shape[2]))
    for name, part in parts.items():
        _, j, m = part.coefficients.shape
        coefficients[GROUPS[name], :j, :m] = part.coefficients[GROUPS[name]]
    some = next(iter(parts.values()))
    return FieldCurves(some.radius, some.interval, coefficients)


class _Alignment:
    """Every bead's stage position of sharpest image and lateral place, refined against the model."""

    def __init__(self, beads: Sequence[BeadCurve], radius: float, interval: tuple[float, float]) -> None:
        self._beads = beads
        self._radius = radius
        self._interval = interval
        self.sharpest = np.array([sharpest_stage(bead) for bead in beads])
        self.place = np.array(
            [
                [np.interp(0, *_ascending(s - bead.stage_z, bead.features[:, k])) for k in (0, 1)]
                for bead, s in zip(beads, self.sharpest, strict=True)
            ]
        )
        self.scatter: tuple[Array, Array]
        self._kept = [np.ones(len(bead.stage_z), dtype=bool) for bead in beads]

    def samples(self) -> list[BeadSamples]:
        """The beads' curves about their present heights and places, within the interval."""
        found = []
        for number, (bead, place) in enumerate(zip(self._beads, self.place, strict=True)):
            u, inside = self._planes(number)
            values = bead.features[inside].copy()
            values[:, :2] -= place
            variance = np.einsum("nkk->nk", self.covariance(bead, u, inside))
            found.append(BeadSamples(bead.x, bead.y, u[inside], values, 1 / variance))
        return found

    def _planes(self, number: int) -> tuple[Array, NDArray[np.bool_]]:
        """Defocus of all planes of a bead, and which of them are used."""
        u = self.sharpest[number] - self._beads[number].stage_z
        return u, (u >= self._interval[0]) & (u <= self._interval[1]) & self._kept[number]

    def drop_outliers(self, residual: list[Array]) -> None:
        """Leave out single planes whose shape is far from that of all beads at the same defocus."""
        u = np.concatenate([sample.argument for sample in self.samples()])
        size = np.abs(np.concatenate(residual)[:, GROUPS["shape"]])
        edges = np.linspace(*self._interval, _NODES // 2)
        for_bin = np.digitize(u, edges)
        usual = np.array([np.median(size[for_bin == k], axis=0) for k in for_bin])
        dropped: NDArray[np.bool_] = np.any(size > _OUTLIER * usual, axis=1)
        start = 0
        for number in range(len(self._beads)):
            inside = np.flatnonzero(self._planes(number)[1])
            self._kept[number][inside[dropped[start : start + len(inside)]]] = False
            start += len(inside)

    def covariance(self, bead: BeadCurve, u: Array, inside: NDArray[np.bool_]) -> Array:
        """Fit noise and scatter of the planes ``inside`` at defocus ``u``: (n, k, k)."""
        nodes, scatter = self.scatter
        nearest = np.clip(np.rint((u - nodes[0]) / (nodes[1] - nodes[0])), 0, len(nodes) - 1).astype(np.intp)
        return bead.noise[inside] + scatter[nearest[inside]]

    def noise(self) -> list[Array]:
        """Fit noise of the planes that ``samples`` has."""
        return [bead.noise[self._planes(number)[1]] for number, bead in enumerate(self._beads)]

    def pieces(self) -> list[BeadSamples]:
        """What is left out together: whole beads, or the planes of the only one."""
        samples = self.samples()
        if len(samples) > 1:
            return samples
        only = samples[0]
        return [
            BeadSamples(only.x, only.y, only.argument[k], only.values[k], only.weights[k])
            for k in (slice(n, n + 1) for n in range(len(only.argument)))
        ]

    def inflation(self, orders: Orders) -> Array:
        """Factor (b, k) by which curves fitted without a bead make the standard deviation of its residuals
        larger than that of beads about the truth; one for the only bead, whose planes are left out."""
        field = bead_field(self._beads, self._radius)
        x, y = field.places.T
        by_feature = tuple(orders.field[name] for name, group in GROUPS.items() for _ in FEATURES[group])
        found = np.ones((len(self._beads), len(FEATURES)))
        for left_out in _folds(len(self._beads)) if len(self._beads) > 1 else ():
            others = replace(field, places=field.places[~left_out])
            found[left_out] = others.inflation(by_feature, x[left_out], y[left_out])
        return found

    def regression(self, highest: tuple[int, int]) -> FieldRegression:
        return FieldRegression(self.pieces(), self._radius, self._interval, *highest)

    def align(self, curves: FieldCurves) -> None:
        """One Gauss-Newton step of every bead's height, then of its lateral place."""
        shape = GROUPS["shape"]
        shift = np.zeros(len(self._beads))
        for number, (bead, sample) in enumerate(zip(self._beads, self.samples(), strict=True)):
            u, inside = self._planes(number)
            covariance = self.covariance(bead, u, inside)
            local = np.repeat(
                curves.local(np.array([bead.x]), np.array([bead.y])), len(sample.argument), axis=0
            )
            residual = sample.values - curves.values(local, sample.argument)
            slope = curves.slopes(local, sample.argument)
            weighted = np.linalg.solve(covariance[:, shape, shape], slope[:, shape, None])[:, :, 0]
            shift[number] = np.sum(weighted * residual[:, shape]) / np.sum(weighted * slope[:, shape])
            weight = sample.weights[:, :2]
            self.place[number] += np.sum(weight * residual[:, :2], axis=0) / np.sum(weight, axis=0)
        # The mean shift is the choice of origin, which stays.
        self.sharpest += np.clip(shift - np.mean(shift), -0.5e-6, 0.5e-6)


def _ascending(x: Array, y: Array) -> tuple[Array, Array]:
    order = np.argsort(x)
    return x[order], y[order]


def _affordable_order(beads: int) -> int:
    """Highest Zernike order with no more terms than half the beads."""
    return max([order for order in FIELD_ORDERS if zernike_count(order) <= beads / 2], default=0)


def _affordable_degree(beads: Sequence[BeadCurve], interval: tuple[float, float]) -> int:
    """Highest degree with at least two planes to a term."""
    step = min(float(np.median(np.abs(np.diff(bead.stage_z)))) for bead in beads)
    return max(DEGREES[0], min(DEGREES[-1], int((interval[1] - interval[0]) / step / 2) - 1))


def _highest(
    beads: Sequence[BeadCurve], interval: tuple[float, float], orders: Orders | None
) -> tuple[int, int]:
    field, degree = _affordable_order(len(beads)), _affordable_degree(beads, interval)
    if orders is not None:
        field, degree = max(field, *orders.field.values()), max(degree, *orders.degree.values())
    return field, degree


def _fit(regression: FieldRegression, orders: Orders, use: NDArray[np.bool_] | None = None) -> FieldCurves:
    """Curves of all groups; dx and dy made zero in focus, where a bead's place is defined."""
    curves = merge_curves(
        {name: regression.fit(orders.field[name], orders.degree[name], use) for name in GROUPS}
    )
    in_focus = curves.coefficients[:2] @ curves.basis(np.zeros(1))[0]
    curves.coefficients[:2, :, 0] -= in_focus
    return curves


def _folds(count: int) -> list[NDArray[np.bool_]]:
    """Masks of the beads left out together; the beads' order is arbitrary, so every k-th goes."""
    folds = min(count, _FOLDS)
    return [np.arange(count) % folds == fold for fold in range(folds)]


def _held_out(regression: FieldRegression, alignment: _Alignment, orders: Orders) -> list[Array]:
    """Residual (n, k) of every bead from the curves fitted without it; of the only one plane by plane."""
    pieces = alignment.pieces()
    residual: list[Array] = [np.empty(0)] * len(pieces)
    for left_out in _folds(len(pieces)):
        curves = _fit(regression, orders, ~left_out)
        for index in np.flatnonzero(left_out):
            residual[index] = _residual(pieces[index], curves)
    return residual if len(alignment.sharpest) > 1 else [np.concatenate(residual)]


def _residual(sample: BeadSamples, curves: FieldCurves) -> Array:
    local = curves.local(np.array([sample.x]), np.array([sample.y]))[0]
    return sample.values - curves.basis(sample.argument) @ local.T


def _cross_validate(
    regression: FieldRegression, pieces: list[BeadSamples], highest: tuple[int, int]
) -> CrossValidation:
    orders = [
        (order, degree)
        for order in FIELD_ORDERS
        for degree in DEGREES
        if order <= highest[0] and degree <= highest[1]
    ]
    total = {key: np.zeros(len(FEATURES)) for key in orders}
    for left_out in _folds(len(pieces)):
        for key in orders:
            curves = regression.fit(*key, ~left_out)
            for index in np.flatnonzero(left_out):
                sample = pieces[index]
                total[key] += np.sum(_residual(sample, curves) ** 2 * sample.weights, axis=0)
    count = sum(len(sample.argument) for sample in pieces)
    return CrossValidation(
        {
            name: {key: float(np.mean(total[key][group]) / count) for key in orders}
            for name, group in GROUPS.items()
        },
        {},
    )


def _best(validation: CrossValidation) -> Orders:
    chosen = {}
    for name, scores in validation.curves.items():
        good = [key for key in scores if scores[key] <= _AS_GOOD * min(scores.values())]
        chosen[name] = min(good, key=lambda key: zernike_count(key[0]) * (key[1] + 1))
    return Orders(
        {name: order for name, (order, _) in chosen.items()},
        {name: degree for name, (_, degree) in chosen.items()},
        0,
    )


def _scatter(alignment: _Alignment, residual: list[Array], inflation: Array, nodes: Array) -> Array:
    """Covariance (g, k, k) of the beads about the true curves near each node, fit noise taken off, from their
    held-out ``residual``, whose standard deviations are larger by ``inflation`` (b, k)."""
    u = np.concatenate([sample.argument for sample in alignment.samples()])
    r = np.concatenate(residual)
    noise = np.concatenate(alignment.noise())
    larger = np.repeat(inflation, [len(one) for one in residual], axis=0)
    excess = (r[:, :, None] * r[:, None, :] - noise) / (larger[:, :, None] * larger[:, None, :])
    r = r / larger
    # Few beads cannot tell how the scatter varies with defocus, nor how features scatter together.
    beads = len(residual)
    width = (nodes[1] - nodes[0]) * max(1.5, 1.5 * np.sqrt(_MANY_BEADS / beads))
    apart = max(0.0, 1 - beads / _MANY_BEADS)
    found = np.empty((len(nodes), len(FEATURES), len(FEATURES)))
    for index, node in enumerate(nodes):
        weight = np.clip(1 - np.abs(u - node) / width, 0, None)
        weight_sum = max(weight.sum(), 1e-12)
        mean = np.einsum("n,nkl->kl", weight, excess) / weight_sum
        modes = _MODES @ mean @ _MODES.T
        modes = (1 - apart) * modes + apart * np.diag(np.diag(modes))
        # A variance known from few residuals: what is measured next follows Student's distribution.
        count = max(weight.sum() ** 2 / max(np.sum(weight**2), 1e-12), _LEAST_RESIDUALS)
        # In units of all that is left over, noise included: the excess alone may be next to nothing.
        units = np.sqrt(np.maximum(np.sum(weight[:, None] * (r @ _MODES.T) ** 2, axis=0) / weight_sum, 1e-24))
        found[index] = count / (count - 2) * _MODES.T @ _positive(modes, units) @ _MODES
    return found


def _positive(matrix: Array, scale: Array) -> Array:
    """The nearest positive semidefinite matrix, in units of ``scale`` (k,)."""
    values, vectors = np.linalg.eigh(matrix / np.outer(scale, scale))
    return (vectors * np.maximum(values, 1e-6)) @ vectors.T * np.outer(scale, scale)


def _focus_design(
    beads: Sequence[BeadCurve], radius: float, order: int, rotations: Sequence[float] | None
) -> tuple[Array, int]:
    """Design matrix of S: one level per stack, then the substrate's tilt if separable, then -f without
    its piston, made zero on the axis. Also the number of columns before those of f."""
    x, y = (np.array([getattr(bead, axis) for bead in beads]) for axis in "xy")
    stack = np.array([bead.stack for bead in beads])
    columns = [(stack == s).astype(np.float64) for s in np.unique(stack)]
    if rotations is not None and np.ptp(np.asarray(rotations)) > 0:
        angle = np.asarray(rotations)[stack]
        columns += [
            (np.cos(angle) * x + np.sin(angle) * y) / radius,
            (np.cos(angle) * y - np.sin(angle) * x) / radius,
        ]
    origin = zernike(order, np.zeros(1), np.zeros(1))
    surface = (zernike(order, x / radius, y / radius) - origin)[:, 1:]
    return np.column_stack([*columns, -surface]), len(columns)


def fit_focus(
    beads: Sequence[BeadCurve],
    sharpest: Array,
    radius: float,
    rotations: Sequence[float] | None,
    order: int | None = None,
) -> FocusFit:
    """Focus surface through the stage positions ``sharpest`` (b,) m of ``beads``.

    ``order``: of the surface, else the lowest that predicts beads left out as well as any.
    """
    scores = _focus_scores(beads, sharpest, radius, rotations)
    if order is None:
        best = min(scores.values(), default=0.0)
        order = next((order for order, score in scores.items() if score <= _AS_GOOD_FOCUS * best), 0)
    return FocusFit(scores, order, *_focus_surface(beads, sharpest, radius, order, rotations))


def _focus_scores(
    beads: Sequence[BeadCurve], sharpest: Array, radius: float, rotations: Sequence[float] | None
) -> dict[int, float]:
    """Rms left-one-out residual (m) of each focus order that the beads can carry."""
    scores = {}
    for order in FOCUS_ORDERS:
        design, _ = _focus_design(beads, radius, order, rotations)
        if design.shape[1] > len(beads) / 2:
            break
        hat = design @ np.linalg.pinv(design)
        left_out = (sharpest - hat @ sharpest) / (1 - np.diag(hat))
        scores[order] = float(np.sqrt(np.mean(left_out**2)))
    return scores


def _focus_surface(
    beads: Sequence[BeadCurve], sharpest: Array, radius: float, order: int, rotations: Sequence[float] | None
) -> tuple[FocusSurface, Array]:
    """Focus surface and the beads' own heights (b,) m about it."""
    design, before = _focus_design(beads, radius, order, rotations)
    inverse = np.linalg.pinv(design)
    solution = inverse @ sharpest
    own_height = sharpest - design @ solution
    freedom = len(beads) - design.shape[1]
    # Heights are the beads' own; the surface through them is uncertain by their mean.
    variance = float(np.sum(own_height**2)) / freedom * design.shape[1] / len(beads) if freedom > 0 else 0.0
    surface = np.concatenate([[0.0], solution[before:]])
    surface[0] = -(zernike(order, np.zeros(1), np.zeros(1))[0] @ surface)
    return FocusSurface(radius, surface, variance, bead_field(beads, radius)), own_height
