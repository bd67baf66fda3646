from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from scipy.spatial import cKDTree

from mems6dof_ros.errors import InputError
from mems6dof_ros.localization.camera import CameraNoise
from mems6dof_ros.localization.fitting import KAPPA, WEIGHTINGS, fit_gaussians
from mems6dof_ros.localization.gaussian import cramer_rao, gaussian, pixel_grid, reference_fit, window_weights
from mems6dof_ros.localization.localizations import Flag, GaussianFits
from mems6dof_ros.localization.neighbours import close_pairs, nearest
from mems6dof_ros.localization.validation import matched_field, physical_field

PERFECT = CameraNoise(0.0, 1.0, 0.0, 65535)
NANOMETRES = 127.34  # per pixel


def spot(height: int, width: int, *parameters: float, seed: int | None = 1) -> np.ndarray:
    columns, rows = np.meshgrid(np.arange(width, dtype=float), np.arange(height, dtype=float))
    mean = gaussian(np.array(parameters), columns, rows)
    return (mean if seed is None else np.random.default_rng(seed).poisson(mean)).astype(np.uint16)


def in_deviations(fits: GaussianFits, expected: np.ndarray) -> np.ndarray:
    return (fits.parameters - expected) / np.sqrt(np.einsum("nii->ni", fits.covariance))


@pytest.mark.parametrize("weighting", ["relative_light_weighting", "light_weighting"])
def test_matched_fits_reach_the_cramer_rao_bound(weighting: str) -> None:
    """20 000 electrons, background 20, 21 px. The ratios of 10 000 fits have an sd of 0.007."""
    image, truth, camera = matched_field(10_000, seed=7)
    start = truth[:, :2] + np.random.default_rng(1).uniform(-1.5, 1.5, (len(truth), 2))
    fits = fit_gaussians(image, start, camera, weighting, 21)
    assert (fits.flags == 0).all()
    errors = fits.parameters - truth
    bound = np.sqrt(np.diag(cramer_rao(np.r_[0, 0, truth[0, 2:]], *pixel_grid(21))))
    chosen = [0, 1, 3, 4, 5]
    assert (np.sqrt(np.mean(errors**2, axis=0)) / bound)[chosen] == pytest.approx(1.0, abs=0.05)
    claimed = np.sqrt(np.einsum("nii->ni", fits.covariance).mean(axis=0))
    assert claimed / errors.std(axis=0) == pytest.approx(1.0, abs=0.05)
    assert fits.chi_square.mean() == pytest.approx(1.0, abs=0.015)


def test_correlations_are_claimed_as_they_are() -> None:
    image, truth, camera = matched_field(4000, seed=8, sigma=(2.5, 4.0), rho=0.5)
    fits = fit_gaussians(image, truth[:, :2], camera, window_px=25)
    actual = np.corrcoef((fits.parameters - truth).T)
    mean = fits.covariance.mean(axis=0)
    deviation = np.sqrt(np.diag(mean))
    assert mean / np.outer(deviation, deviation) == pytest.approx(actual, abs=0.07)


def test_weightings_differ_as_theory_says() -> None:
    """1e5 electrons, sigma 3 px, background 10: light-weighting as precise as Poisson likelihood, uniform a
    third worse, bias of the background about -1/4 and 0; ratios of 2 x 3000 errors have an sd of 0.013,
    much less between two fits of the same images."""
    image, truth, camera = matched_field(3000, 3, 31, 1e5, 10.0, (3.0, 3.0), 0.0)
    deviation, bias = {}, {}
    for weighting in WEIGHTINGS:
        errors = fit_gaussians(image, truth[:, :2], camera, weighting, 31).parameters - truth
        deviation[weighting], bias[weighting] = errors[:, :2].std(), errors[:, 6].mean()
    assert deviation["light_weighting"] == pytest.approx(deviation["poisson"], rel=0.02)
    assert deviation["uniform"] / deviation["poisson"] == pytest.approx(4 / 3, abs=0.08)
    assert deviation["relative_light_weighting"] < 1.08 * deviation["poisson"]
    assert -0.3 < bias["light_weighting"] < -0.15
    for weighting in ("relative_light_weighting", "poisson", "uniform"):
        assert bias[weighting] == pytest.approx(0.0, abs=0.02)


def test_a_faint_neighbour_pulls_as_theory_says() -> None:
    """5 % of the light, 9 px away: uniform 7 nm, light-weighting 19 nm, Poisson likelihood 27 nm."""
    image, truth, camera = matched_field(300, 3, 51, 1e5, 10.0, (3.0, 3.0), 0.0)
    neighbour = np.zeros(image.shape)
    for parameters in truth:
        faint = parameters * [1, 1, 0.05, 1, 1, 1, 0] + [9, 0, 0, 0, 0, 0, 0]
        columns, rows = pixel_grid(31, (round(faint[0]), round(faint[1])))
        neighbour[rows.astype(int), columns.astype(int)] += gaussian(faint, columns, rows)
    image = image + np.rint(2 * np.random.default_rng(1).poisson(neighbour)).astype(np.uint16)
    pull = {
        w: NANOMETRES * np.mean((fit_gaussians(image, truth[:, :2], camera, w, 31).parameters - truth)[:, 0])
        for w in WEIGHTINGS
    }
    assert pull["uniform"] == pytest.approx(6.5, abs=1)
    assert pull["light_weighting"] == pytest.approx(19, abs=2)
    assert pull["poisson"] == pytest.approx(28, abs=2)
    assert pull["uniform"] < pull["relative_light_weighting"] < 15


@pytest.mark.parametrize("weighting", list(WEIGHTINGS))
def test_kernels_agree_with_the_reference(weighting: str) -> None:
    """Within 0.05 standard deviations, read noise included, on physical images that no Gaussian fits."""
    image, positions, ideal = physical_field(9, 5, 3e4, 1e-6)
    camera = CameraNoise(ideal.offset_adu, ideal.gain_adu_per_electron, 2.0, 65535)
    fits = fit_gaussians(image, positions, camera, weighting)
    electrons = (image - 100.0) / ideal.gain_adu_per_electron[0, 0]
    expected = []
    for found in fits.parameters:
        columns, rows = pixel_grid(31, (round(found[0]), round(found[1])))
        data = electrons[rows.astype(int), columns.astype(int)]
        start = found * [1, 1, 1.1, 0.95, 1.05, 0.8, 1.1]
        rough = reference_fit(data, columns, rows, start, 4.0, "uniform")
        noise: np.ndarray | float = 4.0
        if weighting == "relative_light_weighting":
            noise = gaussian(np.r_[rough[:6], 0], columns, rows) + KAPPA * rough[2]
        inside = window_weights(columns, rows, rough[0], rough[1], 31)
        expected.append(reference_fit(data, columns, rows, start, noise, weighting, inside))
    assert np.abs(in_deviations(fits, np.array(expected))).max() < 0.05


def test_brightness_does_not_move_the_default_fit() -> None:
    """The same particles, out of focus, with 3e4 and 3e5 electrons. Means over 100 particles have sds of
    0.0012 in rho; the paper's light-weighting moves by 0.015 or more."""
    shift = {}
    for weighting in ("relative_light_weighting", "light_weighting"):
        rho = []
        for electrons in (3e4, 3e5):
            image, positions, camera = physical_field(100, 3, electrons, -1e-6)
            rho.append(fit_gaussians(image, positions, camera, weighting).parameters[:, 5].mean())
        shift[weighting] = abs(rho[0] - rho[1])
    assert shift["light_weighting"] > 0.012
    assert shift["relative_light_weighting"] < 0.005


def test_covariance_holds_where_a_gaussian_is_an_approximation() -> None:
    """Physical images at three defocuses, pooled: the ratios have an sd of 0.02."""
    ratios = []
    for defocus in (-1.5e-6, 0.0, 1.5e-6):
        image, positions, camera = physical_field(300, 4, 6e4, defocus)
        fits = fit_gaussians(image, positions, camera)
        assert (fits.flags == 0).all()
        errors = fits.parameters.copy()
        errors[:, :2] -= positions
        ratios.append(np.einsum("nii->ni", fits.covariance).mean(axis=0) / errors.var(axis=0))
    assert np.sqrt(np.mean(ratios, axis=0))[[0, 1, 3, 4, 5]] == pytest.approx(1.0, abs=0.1)


def test_neither_start_nor_place_between_pixels_moves_a_fit() -> None:
    """3e6 electrons, defocused by 2 um, where windows of whole pixels scatter fits by up to 3 standard
    deviations. The ratios of 200 fits have an sd of 0.05."""
    image, positions, camera = physical_field(200, 3, 3e6, 2e-6)
    moved = positions + np.random.default_rng(0).uniform(-3, 3, positions.shape)
    fits, again = fit_gaussians(image, positions, camera), fit_gaussians(image, moved, camera)
    assert (fits.flags == 0).all()
    assert (again.flags == 0).all()
    assert np.abs(in_deviations(again, fits.parameters)).max() < 0.1
    errors = fits.parameters.copy()
    errors[:, :2] -= positions
    claimed = np.sqrt(np.einsum("nii->ni", fits.covariance).mean(axis=0))
    assert (errors.std(axis=0) / claimed)[[0, 1, 3, 4, 5]] == pytest.approx(1.0, abs=0.2)


def test_uint8_and_pixel_maps_give_what_electrons_say() -> None:
    rng = np.random.default_rng(3)
    mean = spot(41, 43, 21.3, 19.6, 80.0, 3.0, 4.0, 0.3, 10.0, seed=None).astype(float)
    offset, gain = rng.uniform(10, 20, mean.shape), rng.uniform(1.2, 1.8, mean.shape)
    image = np.rint(offset + gain * mean).astype(np.uint8)
    fits = fit_gaussians(image, [[21, 20]], CameraNoise(offset, gain, 1.0, 255))
    assert fits.parameters[0] == pytest.approx([21.3, 19.6, 80, 3, 4, 0.3, 10], rel=0.02)
    flat = fit_gaussians(image, [[21, 20]], CameraNoise(15.0, 1.5, 1.0, 255))
    assert flat.chi_square[0] > 3 * fits.chi_square[0]


def test_particles_at_the_edge_are_fitted_and_flagged() -> None:
    image = spot(60, 80, 70.0, 30.0, 500.0, 3.0, 3.5, 0.2, 10.0)
    fits = fit_gaussians(image, [[70, 30]], PERFECT)
    assert fits.flags[0] == Flag.WINDOW_CUT  # 6 of 31 columns
    assert np.abs(in_deviations(fits, np.array([70, 30, 500, 3, 3.5, 0.2, 10]))).max() < 4
    image = spot(60, 80, 67.0, 30.0, 500.0, 3.0, 3.5, 0.2, 10.0)
    assert fit_gaussians(image, [[67, 30]], PERFECT).flags[0] == 0  # 3 of 31 columns


def test_saturation_is_flagged() -> None:
    image = spot(61, 61, 30.0, 30.0, 500.0, 3.0, 3.0, 0.0, 10.0)
    fits = fit_gaussians(image, [[30, 30]], CameraNoise(0, 1, 0, float(image.max())))
    assert fits.flags[0] == Flag.SATURATED
    assert fit_gaussians(image, [[30, 30]], CameraNoise(0, 1, 0, image.max() + 1.0)).flags[0] == 0


@pytest.mark.parametrize("weighting", list(WEIGHTINGS))
def test_hopeless_windows_fail_in_their_place(weighting: str) -> None:
    image = spot(200, 300, 40.0, 40.0, 500.0, 3.0, 3.5, 0.2, 10.0)
    image[100:, :100] = 0
    image[100:, 200:] = 65535
    positions = [[40, 40], [50, 150], [250, 150], [math.nan, 5], [-30, 10], [1e9, 1e9], [250, 50]]
    fits = fit_gaussians(image, positions, PERFECT, weighting)
    assert fits.flags[0] == 0
    failed = fits.flags & Flag.FIT_FAILED != 0
    assert failed[1:6].all()
    assert np.isnan(fits.parameters[failed]).all()
    assert np.isnan(fits.covariance[failed]).all()
    assert np.isfinite(fits.parameters[~failed]).all()


@pytest.mark.parametrize("weighting", list(WEIGHTINGS))
def test_noise_alone_ends_in_numbers_or_in_failure(weighting: str) -> None:
    image = np.random.default_rng(5).poisson(3.0, (400, 400)).astype(np.uint16)
    positions = np.random.default_rng(6).uniform(0, 400, (300, 2))
    fits = fit_gaussians(image, positions, PERFECT, weighting, 21)
    good = fits.flags & Flag.FIT_FAILED == 0
    assert np.isfinite(fits.parameters[good]).all()
    assert np.isfinite(fits.covariance[good]).all()
    assert (np.einsum("nii->ni", fits.covariance[good]) > 0).all()


def test_no_positions_no_fits() -> None:
    assert len(fit_gaussians(np.zeros((50, 50), np.uint16), np.empty((0, 2)), PERFECT)) == 0


def test_threads_give_what_one_thread_gives() -> None:
    image, truth, camera = matched_field(400, seed=2)
    expected = fit_gaussians(image, truth[:, :2], camera, window_px=21).parameters
    with ThreadPoolExecutor(4) as pool:
        runs = pool.map(lambda _: fit_gaussians(image, truth[:, :2], camera, window_px=21), range(8))
        for fits in runs:
            np.testing.assert_array_equal(fits.parameters, expected)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"weighting": "lightweighting"}, "relative_light_weighting"),
        ({"window_px": 30}, "odd"),
        ({"window_px": 5}, "odd"),
        ({"kappa": math.nan}, "kappa"),
        ({"image": np.zeros((50, 50))}, "uint16"),
        ({"image": np.zeros((50, 50, 3), np.uint8)}, "height, width"),
        ({"camera": CameraNoise(np.zeros((20, 20)), 1, 0, 255)}, "offset_adu"),
    ],
)
def test_unusable_input_is_refused(change: dict, named: str) -> None:
    values = {"image": np.zeros((50, 50), np.uint16), "positions_px": [[25, 25]], "camera": PERFECT}
    with pytest.raises(InputError, match=named):
        fit_gaussians(**(values | change))


@pytest.mark.parametrize("count", [0, 1, 100, 1000])
def test_close_pairs_are_those_of_a_tree(count: int) -> None:
    positions = np.random.default_rng(count).uniform(0, 100, (count, 2))
    expected = sorted(cKDTree(positions).query_pairs(7.0)) if count else []
    np.testing.assert_array_equal(close_pairs(positions, 7.0), np.array(expected).reshape(-1, 2))


def test_the_nearest_are_those_of_a_tree() -> None:
    rng = np.random.default_rng(3)
    positions, others = rng.uniform(0, 1e-4, (50, 3)), rng.uniform(0, 1e-4, (70, 2))
    distance, index = nearest(positions, others)
    expected = cKDTree(others).query(positions[:, :2])
    np.testing.assert_allclose(distance, expected[0], rtol=1e-12)
    np.testing.assert_array_equal(index, expected[1])
    nothing, none = nearest(positions, others[:0])
    assert (nothing == np.inf).all()
    assert (none == -1).all()
