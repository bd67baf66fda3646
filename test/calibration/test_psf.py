"""The pupil model of method psf: its images, its derivatives, the phase retrieval and the components."""

from __future__ import annotations

import numpy as np
import pytest

from mems6dof_ros.calibration.psf_estimator import compress
from mems6dof_ros.calibration.psf_fit import COUNT, DIAMETER, STAGE, WAVEFRONT, BeadWindows, retrieve
from mems6dof_ros.calibration.psf_pupil import PUPIL_TERMS, Imaging, PupilImages
from mems6dof_ros.simulation.aberrations import FieldAberrations
from mems6dof_ros.simulation.optics import Objective, Optics

IMAGING = Imaging(0.55, 645e-9, 1e-6, 127.34e-9)
#: OSA/ANSI indices of the simulator's terms: astigmatism 45, 0, coma y, x, spherical.
SIMULATED = [PUPIL_TERMS.index(j) for j in (3, 5, 7, 8, 12)]


@pytest.fixture(scope="module")
def optics():
    return Optics(Objective(), FieldAberrations.from_preset("smooth", 1, 645e-9))


@pytest.fixture(scope="module")
def pupil():
    return PupilImages(IMAGING, 56)


def simulated(optics, place, z, electrons=1.0, diameter=1e-6):
    """Windows of 41 px about the pixel nearest to the centre of the field, and their centre's number."""
    position = np.column_stack([np.tile(place, (len(z), 1)), z])
    images = optics.render(position, np.full(len(z), electrons), diameter, (201, 201))
    middle = np.rint(np.array(place) / 127.34e-9 + 100).astype(int)
    windows = []
    for (column, row), image in zip(images.corner, images.image, strict=True):
        c, r = middle - (column, row) - 20
        windows.append(image[r : r + 41, c : c + 41])
    return np.array(windows), middle


@pytest.mark.parametrize("defocus", [-3e-6, -0.7e-6, 0.0, 2e-6])
def test_images_agree_with_the_simulator(optics, pupil, defocus):
    """Two implementations, two samplings of pupil and sphere: equal to 0.5 % of the peak."""
    place = (3.2e-7, -1.4e-7)
    xy = np.array([place])
    wavefront = np.zeros((1, len(PUPIL_TERMS)))
    wavefront[0, SIMULATED] = optics.aberrations.coefficients(xy)[0]
    reference, middle = simulated(optics, place, np.array([defocus]))
    u = defocus - optics.aberrations.focal_surface(xy)
    apparent = np.array(place) + optics.aberrations.chief_ray_slope(xy)[0] * u
    shift = (apparent / 127.34e-9 + 100 - middle)[None]
    found = pupil.images(wavefront, u, shift)[:, 8:49, 8:49]
    assert np.abs(found - reference).max() < 5e-3 * reference.max()


def test_derivatives_are_those_of_the_images(pupil):
    rng = np.random.default_rng(1)
    wavefront, defocus = rng.normal(0, 0.04, (2, len(PUPIL_TERMS))), np.array([-1e-6, 0.6e-6])
    shift = np.array([[0.2, -0.4], [0.1, 0.3]])
    found = pupil.derivatives(wavefront, defocus, shift)

    def difference(step, **moved):
        forth = pupil.images(
            *(a + step * moved.get(k, 0) for k, a in zip("wds", (wavefront, defocus, shift), strict=True))
        )
        back = pupil.images(
            *(a - step * moved.get(k, 0) for k, a in zip("wds", (wavefront, defocus, shift), strict=True))
        )
        return (forth - back) / (2 * step)

    one = np.eye(len(PUPIL_TERMS))[4]
    for numeric, analytic in (
        (difference(2e-8, d=1.0), found.by_defocus),
        (difference(0.02, s=np.array([1.0, 0.0])), found.by_x),
        (difference(0.02, s=np.array([0.0, 1.0])), found.by_y),
        (difference(5e-3, w=one), found.by_wavefront[:, 4]),
    ):
        assert np.abs(numeric - analytic).max() < 5e-3 * np.abs(analytic).max()


def test_phase_retrieval_finds_pupil_diameter_and_focus(optics, pupil):
    """From noisy images of the simulator, within five of their own standard deviations and 2 mwaves."""
    rng = np.random.default_rng(2)
    place, stage = (2e-7, 1e-7), np.linspace(-3e-6, 3e-6, 9)
    clean, middle = simulated(optics, place, 0.3e-6 - stage, 1e5, 1.03e-6)
    electrons = rng.poisson(clean + 10).astype(np.float32)
    windows = BeadWindows((int(middle[0]) - 20, int(middle[1]) - 20), stage, electrons, 0.0)
    start = np.zeros(COUNT)
    start[STAGE], start[1:3] = 0.2, middle
    found = retrieve(windows, pupil, start, start)
    truth = np.zeros(len(PUPIL_TERMS))
    truth[SIMULATED] = optics.aberrations.coefficients(np.array([place]))[0]
    sd = np.sqrt(np.diag(found.covariance))
    error = found.parameters[WAVEFRONT] - truth
    assert np.all(np.abs(error) < 5 * sd[WAVEFRONT] + 5e-4)
    assert np.abs(error).max() < 2e-3
    assert found.parameters[DIAMETER] == pytest.approx(np.log(1.03), abs=5 * sd[DIAMETER] + 2e-3)
    assert found.parameters[STAGE] == pytest.approx(0.3, abs=5 * sd[STAGE] + 2e-3)
    assert found.misfit < 0.03**2


def test_components_reproduce_the_images(calibrated):
    """What the compression loses costs less than one unit of deviance at 1e6 electrons."""
    model, valid = calibrated.calibration.psf, calibrated.calibration.valid
    found = compress(model, 41, (valid.x, valid.y))
    rng = np.random.default_rng(3)
    x, y, u = (rng.uniform(*span, 12) for span in (valid.x, valid.y, (-3e-6, 3e-6)))
    scale = float(np.exp(model.ln_diameter))
    wanted = PupilImages(model.imaging, 56).images(model.at(x, y)[0], u, scale=scale)[:, 8:49, 8:49]
    amplitude = found.curves.values(found.curves.local(x, y), u)[:, : len(found.images)]
    images = np.einsum("nk,kij->nij", amplitude, found.images)[:, 4:-4, 4:-4]
    cost = 1e6 * np.sum((images - wanted) ** 2 / np.maximum(wanted, 1e-5), axis=(1, 2))
    assert np.median(cost) < 1
    assert cost.max() < 5
