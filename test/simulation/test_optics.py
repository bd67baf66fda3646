"""The renderer against an over-sampled reference and against facts of physics."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.special import j1, roots_legendre

from mems6dof_ros.errors import InputError
from mems6dof_ros.simulation.aberrations import PRESETS, FieldAberrations
from mems6dof_ros.simulation.optics import Objective, Optics, cramer_rao

OBJECTIVE = Objective()
NONE = FieldAberrations.from_preset("ideal", 1, OBJECTIVE.wavelength)
IMAGE_SIZE = (256, 256)
#: Waves rms: astigmatism 45, astigmatism 0, coma y, coma x, spherical.
WAVES = (0.07, -0.01, 0.02, -0.025, 0.05)


def uniform(waves=(0, 0, 0, 0, 0), field_curvature=0.0, slope=0j):
    """Aberrations that are the same all over the field."""
    astigmatism_45, astigmatism_0, coma_y, coma_x, spherical = waves
    return FieldAberrations(
        astigmatism=(complex(astigmatism_0, astigmatism_45), 0j, 0j),
        coma=(complex(coma_x, coma_y), 0j),
        spherical=spherical,
        field_curvature=field_curvature,
        chief_ray=(slope, 0j),
        local_amplitude=0.0,
        local_wave_vector=np.zeros((1, 2)),
        local_phase=np.zeros((1, 2)),
    )


def picture(optics, position, electrons=1.0, diameter=1e-6, size=IMAGE_SIZE):
    """The expected image of one particle, placed in a frame."""
    corner, image = optics.render(np.array([position]), np.array([electrons]), diameter, size)
    frame = np.zeros((size[1], size[0]))
    (column, row), side = corner[0], image.shape[-1]
    frame[row : row + side, column : column + side] = image[0]
    return frame


def reference(waves, defocus, shift_px, diameter=1e-6, grid=1024):
    """One sphere, unit flux, centred in 88 px plus the shift: a pupil on a plane 65 um wide, hard-edged,
    at half the camera's pixel, the sphere in seven slices of equal thickness rule."""
    pitch = OBJECTIVE.pixel_size / 2
    cutoff = OBJECTIVE.numerical_aperture / OBJECTIVE.wavelength
    frequency = np.fft.fftfreq(grid, pitch)
    fx, fy = np.meshgrid(frequency, frequency)
    rho, theta = np.hypot(fx, fy) / cutoff, np.arctan2(fy, fx)
    sub = (np.arange(8) - 3.5) / 8 * frequency[1]
    aperture = np.mean(
        [np.hypot(fx + a, fy + b) <= cutoff for a in sub for b in sub], axis=0
    )  # edge pixels by the part that lies inside
    zernikes = [
        math.sqrt(6) * rho**2 * np.sin(2 * theta),
        math.sqrt(6) * rho**2 * np.cos(2 * theta),
        math.sqrt(8) * (3 * rho**3 - 2 * rho) * np.sin(theta),
        math.sqrt(8) * (3 * rho**3 - 2 * rho) * np.cos(theta),
        math.sqrt(5) * (6 * rho**4 - 6 * rho**2 + 1),
    ]
    wavefront = sum(c * z for c, z in zip(waves, zernikes, strict=True))
    cosine = np.sqrt(np.maximum(1 - (OBJECTIVE.numerical_aperture * rho) ** 2, 0.1))
    spectrum = 0
    for t, weight in zip(*roots_legendre(7), strict=True):
        path = wavefront + (defocus + t * diameter / 2) / OBJECTIVE.wavelength * cosine
        field = np.fft.ifft2(aperture / np.sqrt(cosine) * np.exp(2j * np.pi * path))
        q = 2 * np.pi * np.hypot(fx, fy) * diameter / 2 * math.sqrt(1 - t**2) + 1e-9
        spectrum = spectrum + weight * (1 - t**2) * np.fft.fft2(np.abs(field) ** 2) * 2 * j1(q) / q
    x, y = fx * OBJECTIVE.pixel_size, fy * OBJECTIVE.pixel_size
    spectrum *= np.sinc(x) * np.sinc(y) * np.exp(-2j * np.pi * (x * shift_px[0] + y * shift_px[1]))
    image = np.fft.fftshift(np.fft.ifft2(spectrum).real)[::2, ::2]
    # Of the whole plane's light, the pupil's energy (Parseval), in a quarter of the samples.
    image /= (aperture / cosine).sum() / grid**2 / 4 * 4 / 3
    middle = grid // 4
    return image[middle - 44 : middle + 44, middle - 44 : middle + 44]


@pytest.mark.parametrize(
    ("defocus", "tolerance"), [(0.0, 4e-4), (2e-6, 4e-4), (-2e-6, 4e-4), (-4e-6, 2e-3), (5e-6, 2e-3)]
)
def test_agrees_with_an_oversampled_reference(defocus, tolerance):
    optics = Optics(OBJECTIVE, uniform(WAVES))
    shift = np.array([0.31, -0.42])
    position = np.append((shift + 0.5) * OBJECTIVE.pixel_size, defocus)  # even image: origin between pixels
    corner, image = optics.render(position[None], np.ones(1), 1e-6, IMAGE_SIZE)
    expected = reference(WAVES, defocus, shift)
    assert corner.tolist() == [[128 - 44, 128 - 44]]
    assert np.abs(image[0] - expected).max() < tolerance * expected.max()
    assert image[0].sum() == pytest.approx(expected.sum(), abs=1e-3)


def test_flux_is_linear_in_electrons_and_nearly_kept_through_focus():
    optics = Optics(OBJECTIVE, uniform(WAVES))
    z = np.linspace(-3e-6, 3e-6, 13)
    position = np.column_stack([np.zeros((13, 2)), z])
    flux = optics.render(position, np.full(13, 6e4), 1e-6, IMAGE_SIZE).image.sum(axis=(1, 2))
    assert np.all((flux > 0.96 * 6e4) & (flux < 0.99 * 6e4))  # the rest lies outside the window
    dim = optics.render(position, np.full(13, 6e3), 1e-6, IMAGE_SIZE).image.sum(axis=(1, 2))
    np.testing.assert_allclose(flux, 10 * dim, rtol=1e-5)


def test_without_aberrations_both_sides_of_focus_look_alike():
    optics = Optics(OBJECTIVE, NONE)
    above, below = picture(optics, (0, 0, 2.5e-6)), picture(optics, (0, 0, -2.5e-6))
    assert np.abs(above - below).max() < 1e-5 * above.max()
    np.testing.assert_allclose(above, above.T, atol=1e-5 * above.max())


def covariance(image):
    """Second moments (xx, yy, xy) of what is brighter than a tenth of the peak, px^2."""
    weight = np.where(image > 0.1 * image.max(), image, 0) / image[image > 0.1 * image.max()].sum()
    y, x = np.indices(image.shape)
    x, y = x - (x * weight).sum(), y - (y * weight).sum()
    return [(weight * a * b).sum() for a, b in ((x, x), (y, y), (x, y))]


def test_astigmatism_turns_the_ellipse_through_focus():
    diagonal = Optics(OBJECTIVE, uniform((0.07, 0, 0, 0, 0)))
    upright = Optics(OBJECTIVE, uniform((0, 0.07, 0, 0, 0)))
    for z in (-1.5e-6, 1.5e-6):
        xx, yy, xy = covariance(picture(diagonal, (0, 0, z)))
        assert abs(xx - yy) < 0.02 * xx
        assert np.sign(z) * xy < -0.1 * xx
        xx, yy, xy = covariance(picture(upright, (0, 0, z)))
        assert abs(xy) < 0.02 * xx
        assert np.sign(z) * (xx - yy) < -0.2 * xx
    xx, _, xy = covariance(picture(diagonal, (0, 0, 0)))
    assert abs(xy) < 0.02 * xx


def centroid(image):
    """Centroid (x, y) in px under a round weight that moves along (the wings would weigh in the rest)."""
    y, x = np.indices(image.shape)
    row, column = np.unravel_index(image.argmax(), image.shape)
    at = np.array([column, row], dtype=float)
    for _ in range(50):
        weight = image * np.exp(-((x - at[0]) ** 2 + (y - at[1]) ** 2) / (2 * 8**2))
        at = np.array([(x * weight).sum(), (y * weight).sum()]) / weight.sum()
    return at


@pytest.mark.parametrize("offset", [(0.0, 0.0), (0.25, -0.4), (-3.3, 7.45), (12.5, 0.1)])
def test_a_particle_is_drawn_where_it_is(offset):
    place = np.array([*offset, 0.0]) * OBJECTIVE.pixel_size
    at = centroid(picture(Optics(OBJECTIVE, NONE), place, size=(255, 251)))
    np.testing.assert_allclose(at - (127, 125), offset, atol=1e-3)  # 0.13 nm


def test_a_leaning_chief_ray_shifts_the_image_by_slope_times_defocus():
    optics = Optics(OBJECTIVE, uniform(slope=0.03 - 0.02j))
    shift = centroid(picture(optics, (0, 0, 2e-6))) - centroid(picture(optics, (0, 0, 0)))
    np.testing.assert_allclose(shift * OBJECTIVE.pixel_size, [60e-9, -40e-9], atol=0.2e-9)


def test_field_curvature_moves_the_focus():
    """The sharpest image of a particle at the corner lies at the sag of the focal surface."""
    optics = Optics(OBJECTIVE, uniform(field_curvature=0.8e-6))
    z = np.arange(-1.0e-6, 2.01e-6, 0.1e-6)
    position = np.column_stack([np.full(len(z), 184e-6 * 0.6), np.full(len(z), 184e-6 * 0.8), z])
    peak = optics.render(position, np.ones(len(z)), 1e-6, (2048, 2048)).image.max(axis=(1, 2))
    best = np.polynomial.Polynomial.fit(z, np.log(peak), 4).deriv().roots()
    real = best[np.isreal(best)].real
    assert np.abs(real - 0.8e-6).min() < 10e-9


def test_larger_spheres_make_wider_images():
    optics = Optics(OBJECTIVE, NONE)
    small, large = (covariance(picture(optics, (0, 0, 0), diameter=d))[0] for d in (0.5e-6, 1.5e-6))
    point = covariance(picture(optics, (0, 0, 0), diameter=0.05e-6))[0]
    assert point < small < large
    # Variance of a projected uniform sphere: R^2/5 along each axis (some of it is in the cut wings).
    added = (large - point) * OBJECTIVE.pixel_size**2
    assert added == pytest.approx(0.75e-6**2 / 5, rel=0.25)


def test_cramer_rao_bound_is_reached_by_maximum_likelihood():
    """200 trials by Fisher scoring from 20 nm and 100 nm off: sd within three of its standard errors."""
    optics = Optics(OBJECTIVE, uniform(WAVES))
    truth = np.array([6e-8, 7e-8, 0.5e-6, 3e4, 10.0])  # in the middle of a pixel: the window stays
    bound = cramer_rao(optics, truth[None, :3], truth[3], truth[4])[0]
    steps = np.diag([20e-9, 20e-9, 40e-9])

    def model(parameters):
        places = np.concatenate([parameters[:3] + steps, parameters[:3] - steps, parameters[None, :3]])
        corner, image = optics.render(places, np.full(7, parameters[3]), 1e-6, IMAGE_SIZE)
        assert len({tuple(c) for c in corner}) == 1
        image = image.reshape(7, -1).astype(float)
        rows = [(image[i] - image[i + 3]) / (2 * steps[i, i]) for i in range(3)]
        return image[6] + parameters[4], np.stack([*rows, image[6] / parameters[3], np.ones_like(image[6])])

    rng = np.random.default_rng(3)
    expected, _ = model(truth)
    found = []
    for _ in range(200):
        counts = rng.poisson(expected)
        estimate = truth + np.array([20e-9, -20e-9, 100e-9, 500.0, 0.2])
        for _ in range(4):
            mean, rows = model(estimate)
            scale = 1 / np.sqrt(((rows**2) / mean).sum(axis=1))
            rows *= scale[:, None]
            estimate = estimate + scale * np.linalg.solve((rows / mean) @ rows.T, rows @ (counts / mean - 1))
        found.append(estimate)
    ratio = np.std(found, axis=0, ddof=5) / bound
    assert np.all(np.abs(ratio - 1) < 3 / math.sqrt(2 * 200)), ratio
    assert np.all(np.abs(np.mean(found, axis=0) - truth) < 4 * bound / math.sqrt(200))


def test_cramer_rao_improves_with_light():
    optics = Optics(OBJECTIVE, uniform(WAVES))
    places = np.zeros((2, 3))
    sd = cramer_rao(optics, places, np.array([1e6, 4e6]), 0.01)
    np.testing.assert_allclose(sd[0, :3] / sd[1, :3], 2, rtol=0.02)


def test_presets_keep_their_promises():
    x = np.linspace(-130e-6, 130e-6, 14)
    grid = np.stack(np.meshgrid(x, x), axis=-1).reshape(-1, 2)
    for seed in range(20):
        drawn = {n: FieldAberrations.from_preset(n, seed, OBJECTIVE.wavelength) for n in PRESETS}
        at_45 = {name: a.coefficients(grid)[:, 0] for name, a in drawn.items()}
        assert at_45["paper"].min() > 0.015
        assert at_45["smooth"].min() > 0.015
        assert at_45["sign_change"].min() < -0.01
        assert at_45["sign_change"].max() > 0.01
        assert not drawn["ideal"].coefficients(grid).any()
        total = np.hypot(*drawn["sign_change"].coefficients(grid)[:, :2].T)
        assert total.min() > 0.005  # nowhere without astigmatism
    assert not np.array_equal(drawn["paper"].coefficients(grid), at_45["paper"])


def test_local_astigmatism_is_local_and_of_the_stated_size():
    paper = FieldAberrations.from_preset("paper", 4, OBJECTIVE.wavelength)
    smooth = FieldAberrations.from_preset("smooth", 4, OBJECTIVE.wavelength)
    place = np.random.default_rng(0).uniform(-130e-6, 130e-6, (3000, 2))

    def local(xy):
        return (paper.coefficients(xy) - smooth.coefficients(xy)) * OBJECTIVE.wavelength

    here = local(place)
    np.testing.assert_allclose(here[:, :2].std(axis=0), 2e-9, rtol=0.2)
    np.testing.assert_allclose(here[:, 2:], 0, atol=1e-20)
    near, far = local(place + np.array([1e-6, 0])), local(place + np.array([20e-6, 0]))
    assert np.corrcoef(here[:, 0], near[:, 0])[0, 1] > 0.9
    assert abs(np.corrcoef(here[:, 0], far[:, 0])[0, 1]) < 0.3


def test_impossible_optics_are_refused():
    with pytest.raises(InputError, match=r"pixel_size.*lambda/\(4 NA\)"):
        Optics(Objective(pixel_size=400e-9), NONE)
    with pytest.raises(InputError, match="one of ideal, smooth, paper, sign_change"):
        FieldAberrations.from_preset("perfect", 1, 645e-9)


def test_coarse_and_fine_cameras_see_the_same_light():
    """Binning 4 fine pixels gives the coarse camera's image: the two sampling paths agree."""
    fine = picture(Optics(Objective(pixel_size=100e-9), uniform(WAVES)), (0, 0, 1e-6), size=(256, 256))
    coarse = picture(Optics(Objective(pixel_size=200e-9), uniform(WAVES)), (0, 0, 1e-6), size=(128, 128))
    binned = fine.reshape(128, 2, 128, 2).sum(axis=(1, 3))
    assert np.abs(binned - coarse).max() < 1e-3 * coarse.max()
