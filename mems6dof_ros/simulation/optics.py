"""Images of fluorescent spheres through an aberrated objective: a scalar pupil model.

The field of a point at defocus z is the Fourier transform of the pupil

    P(f) = (1 - NA^2 rho^2)^(-1/4) exp(2 pi i [sum_j c_j Z_j(rho, theta) + (z/lambda) sqrt(1 - NA^2 rho^2)])

with rho = |f| lambda/NA <= 1: scalar, exact (not paraxial) defocus in air, and the amplitude of an
aplanatic objective that collects an isotropic emitter (Goodman, Introduction to Fourier Optics,
ch. 6; Hanser et al., J. Microsc. 216, 32, 2004). A sphere is a stack of discs at Gauss-Jacobi nodes in
height, each imaged incoherently at its own defocus; refraction at the sphere is neglected.

How it is computed. Intensity is band-limited to 2 NA/lambda (1.7 cycles/um), so each disc's image is
computed on a grid of twice the camera's pixel, by matrix products with the two one-dimensional Fourier
kernels; it is multiplied in the Fourier domain by the transforms of disc and pixel and by the phase
of the sub-pixel shift, and zero-padded to the camera's grid, which interpolates it exactly.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy.fft
from numpy.typing import NDArray
from scipy.integrate import trapezoid
from scipy.special import j0, j1, roots_jacobi

from mems6dof_ros.errors import InputError
from mems6dof_ros.simulation.aberrations import TERMS, FieldAberrations

#: Side of the window in which a particle is rendered, m; at 5 um defocus it holds 95 % of the light.
WINDOW = 11.2e-6

_PERIOD = 2.0  # of the pupil's sampling, in windows: room for the light that leaves the window
_EDGE_MARGIN = 3  # pupil samples beyond the hard edge
_BATCH = 16  # particles at once: keeps the work in the processor's cache

# A uniform sphere is a stack of discs of area 1 - t^2 at heights t (in radii), the weight of Gauss-Jacobi
# nodes; four of them, taken as two pairs at +t and -t.
_HEIGHTS, _WEIGHTS = (values[2:] for values in roots_jacobi(4, 1, 1))
_WEIGHTS = 0.5 * _WEIGHTS / _WEIGHTS.sum()


class ParticleImages(NamedTuple):
    """Rendered windows: ``corner`` (n, 2) column and row of the first pixel; ``image`` (n, window_px,
    window_px) expected electrons per pixel, float32."""

    corner: NDArray[np.int64]
    image: NDArray[np.float32]


@dataclass(frozen=True)
class Objective:
    """The objective and its sampling: ``wavelength`` and ``pixel_size`` (in object space) in m."""

    numerical_aperture: float = 0.55
    wavelength: float = 645e-9
    pixel_size: float = 127.34e-9


class Optics:
    """Renders spheres at positions in the microscope frame.

    The image of a particle at (X, Y, z) uses the aberrations at (X, Y), the defocus above the focal
    surface there, and the shift that the chief ray's slope gives at that defocus. ``window_px`` is the side
    of a rendered window. Raises InputError for pixels too coarse to sample the image (over
    lambda/(4 NA)).
    """

    def __init__(self, objective: Objective, aberrations: FieldAberrations) -> None:
        self.objective = objective
        self.aberrations = aberrations
        pixel = objective.pixel_size
        cutoff = objective.numerical_aperture / objective.wavelength
        na2 = objective.numerical_aperture**2
        if pixel > 0.25 / cutoff:
            raise InputError("pixel_size", f"{pixel} m", f"at most {0.25 / cutoff:.3g} m, lambda/(4 NA)")
        binning = 2 if pixel <= 0.125 / cutoff else 1
        self.window_px = 4 * round(WINDOW / pixel / 4)
        self._coarse = self.window_px // binning

        # Pupil samples, and a margin for the edge, which the finite window makes soft.
        pitch = 1 / (_PERIOD * self.window_px * pixel)
        half = math.ceil(cutoff / pitch) + _EDGE_MARGIN
        f = np.arange(-half, half + 1) * pitch
        px, py = np.meshgrid(f / cutoff, f / cutoff)
        rho2 = px**2 + py**2
        cosine = np.sqrt(1 - np.minimum(na2 * rho2, 0.99))
        energy = 2 * math.pi * cutoff**2 * (1 - math.sqrt(1 - na2)) / na2  # integral of |P|^2
        scale = pitch**2 * pixel / math.sqrt(energy)  # to electrons per pixel, one in the whole plane
        self._amplitude = (scale * _soft_aperture(rho2, cutoff / pitch) / np.sqrt(cosine)).astype(np.float32)
        self._zernikes = (2 * math.pi * _zernikes(px, py)).reshape(len(TERMS), -1).astype(np.float32)
        # The piston k z is arbitrary; without it single precision is ample.
        self._axial = (2 * math.pi / objective.wavelength * (cosine - 1)).astype(np.float32)
        x = (np.arange(self._coarse) - self._coarse // 2) * binning * pixel
        self._to_image = np.exp(2j * math.pi * np.outer(f, x)).astype(np.complex64)
        self._from_pupil = np.ascontiguousarray(self._to_image.T)

        # Fourier domain of the coarse window: frequencies in cycles per camera pixel.
        self._fx = scipy.fft.rfftfreq(self._coarse, binning).astype(np.float32)
        self._fy = scipy.fft.fftfreq(self._coarse, binning).astype(np.float32)
        self._frequency = np.hypot(*np.meshgrid(self._fx, self._fy)) / pixel
        self._pixel_transfer = np.sinc(self._fy)[:, None] * np.sinc(self._fx)
        # Beyond the optical cutoff there is nothing but the cut of the window; the edge bins of
        # an even transform have no sign and could not be shifted.
        self._pixel_transfer[self._coarse // 2] = 0
        self._pixel_transfer[:, -1] = 0

    def render(
        self,
        position: NDArray[np.float64],
        electrons: NDArray[np.float64],
        diameter: NDArray[np.float64] | float,
        image_size: tuple[int, int],
    ) -> ParticleImages:
        """Images of n spheres at ``position`` (n, 3) m, in the microscope frame.

        ``electrons`` (n,) expected in the whole plane, of which a window holds about
        98 % in focus; ``diameter`` m, (n,) or one for all; ``image_size`` (width, height) px fixes where
        the microscope frame's origin lies. Windows may reach beyond the image.
        """
        position = np.atleast_2d(np.asarray(position, dtype=float))
        electrons = np.broadcast_to(np.asarray(electrons, dtype=float), len(position))
        diameter = np.broadcast_to(np.asarray(diameter, dtype=float), len(position))
        xy = position[:, :2]
        waves = self.aberrations.coefficients(xy)
        defocus = position[:, 2] - self.aberrations.focal_surface(xy)
        apparent = xy + self.aberrations.chief_ray_slope(xy) * defocus[:, None]
        pixel = apparent / self.objective.pixel_size + (np.asarray(image_size) - 1) / 2
        nearest = np.rint(pixel).astype(np.int64)
        shift = pixel - nearest
        image = np.empty((len(position), self.window_px, self.window_px), np.float32)
        for first in range(0, len(position), _BATCH):
            part = slice(first, first + _BATCH)
            image[part] = self._windows(waves[part], defocus[part], shift[part], diameter[part])
            image[part] *= electrons[part, None, None].astype(np.float32)
        return ParticleImages(nearest - self.window_px // 2, image)

    def _windows(
        self,
        waves: NDArray[np.float64],
        defocus: NDArray[np.float64],
        shift: NDArray[np.float64],
        diameter: NDArray[np.float64],
    ) -> NDArray[np.float32]:
        """Windows of unit flux, centred on pixel window_px // 2 plus ``shift`` (n, 2) px."""
        n, side, half = len(defocus), len(self._axial), self._coarse // 2
        phase = (waves.astype(np.float32) @ self._zernikes).reshape(n, side, side)
        phase += defocus.astype(np.float32)[:, None, None] * self._axial
        pupil = self._amplitude * _unit_phasor(phase)

        spectrum = np.zeros((n, self._coarse, half + 1), np.complex64)
        for node, weight in zip(_HEIGHTS, _WEIGHTS, strict=True):
            # A disc above the centre is further out of focus by its height, one below it nearer.
            height = (0.5 * node * diameter).astype(np.float32)[:, None, None]
            above = _unit_phasor(height * self._axial)
            intensity = self._intensity(pupil * above)
            intensity += self._intensity(pupil * above.conj())
            disc = _disc_transfer(self._frequency, 0.5 * diameter * math.sqrt(1 - node**2))
            spectrum += scipy.fft.rfft2(intensity) * (weight * self._pixel_transfer * disc).astype(np.float32)

        shift = shift.astype(np.float32)
        ramp_x = np.exp(-2j * np.float32(math.pi) * shift[:, :1] * self._fx)
        ramp_y = np.exp(-2j * np.float32(math.pi) * shift[:, 1:] * self._fy)
        spectrum *= ramp_y[:, :, None] * ramp_x[:, None, :]
        padded = np.zeros((n, self.window_px, self.window_px // 2 + 1), np.complex64)
        padded[:, :half, : half + 1] = spectrum[:, :half]
        padded[:, -half:, : half + 1] = spectrum[:, half:]
        image = scipy.fft.irfft2(padded) * np.float32((self.window_px / self._coarse) ** 2)
        return np.maximum(image, 0, out=image)

    def _intensity(self, pupil: NDArray[np.complex64]) -> NDArray[np.float32]:
        """Intensity on the coarse grid, (n, coarse, coarse), of pupils (n, side, side)."""
        n, side, _ = pupil.shape
        rows = (pupil.reshape(-1, side) @ self._to_image).reshape(n, side, self._coarse)
        field = self._from_pupil @ rows
        return field.real**2 + field.imag**2


def _unit_phasor(phase: NDArray[np.float32]) -> NDArray[np.complex64]:
    """exp(i phase) in single precision, several times faster than np.exp of complex numbers."""
    phasor = np.empty(phase.shape, np.complex64)
    np.cos(phase, out=phasor.real)
    np.sin(phase, out=phasor.imag)
    return phasor


def _zernikes(px: NDArray[np.float64], py: NDArray[np.float64]) -> NDArray[np.float64]:
    """The Zernike polynomials of TERMS, (5, ...), at pupil coordinates in units of its radius.

    Noll, J. Opt. Soc. Am. 66, 207 (1976), table I.
    """
    rho2 = px**2 + py**2
    return np.stack(
        [
            math.sqrt(6) * 2 * px * py,
            math.sqrt(6) * (px**2 - py**2),
            math.sqrt(8) * (3 * rho2 - 2) * py,
            math.sqrt(8) * (3 * rho2 - 2) * px,
            math.sqrt(5) * (6 * rho2**2 - 6 * rho2 + 1),
        ]
    )


def _soft_aperture(rho2: NDArray[np.float64], radius: float) -> NDArray[np.float64]:
    """The hard aperture rho <= 1 as samples whose images do not fold into each other.

    Sampling the pupil at a pitch of 1/``radius`` repeats its image at distance ``radius`` (in units of
    1/cutoff). The image of the aperture is therefore faded to zero between 0.35 and 0.65 of that
    distance: A(rho) = 2 pi int W(x) J1(2 pi x) J0(2 pi rho x) dx, the Hankel transform of the Airy
    amplitude times that window, one where W = 1 everywhere.
    """
    x = np.linspace(0, 0.65 * radius, 4001)
    fade = np.clip((0.65 - x / radius) / 0.3, 0, 1)
    window = np.sin(0.5 * math.pi * fade) ** 2
    rho, inverse = np.unique(np.sqrt(rho2).round(9), return_inverse=True)
    kernel = window * j1(2 * math.pi * x)
    aperture = 2 * math.pi * trapezoid(kernel * j0(2 * math.pi * rho[:, None] * x), x, axis=1)
    return aperture[inverse].reshape(rho2.shape)


def _disc_transfer(frequency: NDArray[np.float64], radius: NDArray[np.float64]) -> NDArray[np.float64]:
    """Transfer functions (n, ...) of uniform discs of ``radius`` (n,) m: 2 J1(q)/q, q = 2 pi f r."""
    q = 2 * math.pi * radius[:, None, None] * frequency
    return np.where(q < 1e-6, 1.0, 2 * j1(q) / np.maximum(q, 1e-6))


def cramer_rao(
    optics: Optics,
    position: NDArray[np.float64],
    electrons: NDArray[np.float64] | float,
    background: float,
    *,
    diameter: NDArray[np.float64] | float = 1e-6,
    read_noise: float = 0.0,
) -> NDArray[np.float64]:
    """Smallest standard deviations of (x, y, z, electrons, background), (n, 5); m and electrons.

    For n particles at ``position`` (n, 3) m, each alone in its window, with ``electrons`` in the whole plane
    and ``diameter`` m, (n,) or one for all, on ``background`` electrons per pixel. The inverse of the
    Fisher information I_ab = sum_pixels (d mu/d a)(d mu/d b)/(mu + s^2), with ``read_noise`` s
    (electrons rms) counted as Poisson variance (Huang et al., Nat. Methods 10, 653, 2013); derivatives
    are central differences of the rendered images.
    """
    position = np.atleast_2d(np.asarray(position, dtype=float))
    # Steps at which neither curvature (scales of 300 nm and 1 um) nor single precision matters.
    steps = np.diag([20e-9, 20e-9, 40e-9])
    moves = np.concatenate([steps, -steps, np.zeros((1, 3))])
    waves = optics.aberrations.coefficients(position[:, :2])
    defocus = position[:, 2] - optics.aberrations.focal_surface(position[:, :2])
    slope = optics.aberrations.chief_ray_slope(position[:, :2])
    electrons = np.broadcast_to(np.asarray(electrons, dtype=float), len(position))
    diameter = np.broadcast_to(np.asarray(diameter, dtype=float), len(position))
    bounds = np.empty((len(position), 5))
    for i in range(len(position)):
        at = defocus[i] + moves[:, 2]
        shift = (position[i, :2] + moves[:, :2] + slope[i] * at[:, None]) / optics.objective.pixel_size
        shift -= np.rint(shift[-1])
        unit = optics._windows(np.tile(waves[i], (len(at), 1)), at, shift, np.full(len(at), diameter[i]))
        image = electrons[i] * unit.astype(float)
        derivative = [(image[a] - image[a + 3]) / (2 * steps[a, a]) for a in range(3)]
        derivative += [image[6] / electrons[i], np.ones_like(image[6])]
        columns = np.stack(derivative).reshape(5, -1)
        variance = (image[6] + background + read_noise**2).ravel()
        # Scaled to unit diagonal: metres and electrons differ by ten orders.
        information = (columns / variance) @ columns.T
        scale = 1 / np.sqrt(np.diag(information))
        inverse = np.linalg.inv(information * scale[:, None] * scale)
        bounds[i] = scale * np.sqrt(np.diag(inverse))
    return bounds
