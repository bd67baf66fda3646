"""Images of small spheres from the phase in the objective's pupil, and what each parameter changes in them.

The field of a point at defocus u is the Fourier transform of

    P(s) = (1 - NA^2 s^2)^(-1/4) exp(2 pi i [sum_j c_j Z_j(s) + (u / lambda) (sqrt(1 - NA^2 s^2) - 1)])

over the unit disc of pupil coordinates s: scalar, exact defocus in air, aplanatic (Hanser et al., J. Microsc.
216, 32, 2004). A sphere is a stack of incoherent discs. The coefficients c_j (waves rms) are what a
calibration measures; the derivatives of the image by them need one more transform each,
dI/dc_j = 2 Re(E* dE/dc_j), which is what makes phase retrieval by least squares cheap.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import scipy.fft
from numpy.typing import NDArray
from scipy.special import j1, roots_jacobi

from mems6dof_ros.calibration.field_curves import Array
from mems6dof_ros.calibration.zernike import zernike

#: OSA/ANSI indices of the pupil's Zernike terms: all from second to fourth radial order but defocus.
#: Astigmatism 45 and 0 degrees (3, 5), trefoil and coma (6 to 9), fourth order (10 to 14).
PUPIL_TERMS = (3, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14)

_ORDER = 4
_PERIOD = 2.0  # of the pupil's sampling, in windows: light that has left the window must not come back
_EDGE = 3  # pupil samples beyond its hard edge
_FINE = 16  # pupil samples of the hard aperture per sample of the softened one
# A sphere is discs of area 1 - t^2 at heights t (in radii): Gauss-Jacobi nodes of that weight.
_HEIGHTS, _WEIGHTS = roots_jacobi(3, 1, 1)
_DIAMETER_STEP = 0.02


@dataclass(frozen=True)
class Imaging:
    """What is known of the imaging beforehand: ``numerical_aperture`` (in air), ``wavelength`` of emission m,
    ``diameter`` of the spheres m, ``pixel_size`` m."""

    numerical_aperture: float
    wavelength: float
    diameter: float
    pixel_size: float


class Derivatives(NamedTuple):
    """Images (n, side, side) of unit flux with their derivatives: ``image``; ``by_x``, ``by_y`` per px;
    ``by_defocus`` per m; ``by_wavefront`` (n, terms, side, side) per wave rms; ``by_diameter`` per unit of
    its logarithm."""

    image: Array
    by_x: Array
    by_y: Array
    by_defocus: Array
    by_wavefront: Array
    by_diameter: Array


class PupilImages:
    """Renders windows of ``side_px`` pixels (a multiple of 4) of particles at pixel ``side_px // 2`` plus a
    shift."""

    def __init__(self, imaging: Imaging, side_px: int) -> None:
        self.imaging = imaging
        self.side_px = side_px
        pixel = imaging.pixel_size
        cutoff = imaging.numerical_aperture / imaging.wavelength
        # Intensity is limited to 2 NA / lambda: often every second pixel holds all of it.
        self._binning = 2 if pixel <= 0.24 / 2 / cutoff else 1
        self._coarse = side_px // self._binning
        pitch = 1 / (_PERIOD * side_px * pixel)
        half = math.ceil(cutoff / pitch) + _EDGE
        f = np.arange(-half, half + 1) * pitch
        sx, sy = np.meshgrid(f / cutoff, f / cutoff)
        s2 = np.minimum(sx**2 + sy**2, 1.2)
        cosine = np.sqrt(1 - np.minimum(imaging.numerical_aperture**2 * s2, 0.95))
        amplitude = _soft_aperture(cutoff / pitch, half) / np.sqrt(cosine)
        terms = zernike(_ORDER, sx.ravel(), sy.ravel())[:, PUPIL_TERMS].T
        self._phases = (2 * math.pi * terms).reshape(-1, *sx.shape).astype(np.float32)
        self._axial = (2 * math.pi / imaging.wavelength * (cosine - 1)).astype(np.float32)
        energy = 2 * math.pi * cutoff**2 * (1 - math.sqrt(1 - imaging.numerical_aperture**2))
        energy /= imaging.numerical_aperture**2  # integral of |P|^2 over frequency
        amplitude *= pitch**2 * pixel / math.sqrt(energy)
        self._amplitude = amplitude.astype(np.float32)
        x = (np.arange(self._coarse) - self._coarse // 2) * self._binning * pixel
        self._kernel = np.exp(2j * math.pi * np.outer(f, x)).astype(np.complex64)

    @cached_property
    def _frequency(self) -> tuple[Array, Array, Array]:
        """Along y, along x, and their length, cycles per px, on the grid of the transforms."""
        fy = scipy.fft.fftfreq(self._coarse, self._binning)[:, None]
        fx = scipy.fft.rfftfreq(self._coarse, self._binning)[None, :]
        return fy, fx, np.hypot(fy, fx)

    def images(
        self, wavefront: Array, defocus: Array, shift: Array | None = None, scale: Array | float = 1.0
    ) -> Array:
        """Images (n, side, side) for ``wavefront`` (n, terms) waves, ``defocus`` (n,) m, ``shift`` (n, 2) px
        of the particles, and the diameters' ratio ``scale`` (n,) to the nominal one."""
        spectrum = self._spectra(wavefront, defocus, np.broadcast_to(scale, len(defocus)), False)
        return self._windows(self._shifted(spectrum, shift))[0]

    def derivatives(
        self, wavefront: Array, defocus: Array, shift: Array | None = None, scale: Array | float = 1.0
    ) -> Derivatives:
        """The same images with their derivatives."""
        scale = np.broadcast_to(scale, len(defocus))
        spectra = self._shifted(self._spectra(wavefront, defocus, scale, True), shift)
        fy, fx, _ = self._frequency
        # The image moves with the particle: d/dx = -d/d(column).
        moved = np.stack([-2j * math.pi * fx * spectra[0], -2j * math.pi * fy * spectra[0]])
        by_x, by_y = self._windows(moved)
        step = _DIAMETER_STEP
        larger = self.images(wavefront, defocus, shift, scale * (1 + step))
        smaller = self.images(wavefront, defocus, shift, scale * (1 - step))
        image, by_defocus, *by_wavefront = self._windows(spectra)
        return Derivatives(
            image, by_x, by_y, by_defocus, np.stack(by_wavefront, axis=1), (larger - smaller) / (2 * step)
        )

    def _spectra(self, wavefront: Array, defocus: Array, scale: Array, derive: bool) -> NDArray[np.complex64]:
        """Transforms of the images, then where asked for of their derivatives by defocus and by terms:
        (1 or 2 + terms, n, coarse, coarse // 2 + 1)."""
        n = len(defocus)
        phase = np.tensordot(wavefront.astype(np.float32), self._phases, 1)
        phase += defocus.astype(np.float32)[:, None, None] * self._axial
        factors = [self._axial, *self._phases] if derive else []
        coarse = self._coarse
        spectra = np.zeros((1 + len(factors), n, coarse, coarse // 2 + 1), np.complex64)
        fy, fx, length = self._frequency
        transfer = np.sinc(fy) * np.sinc(fx)
        # The edge of an even transform has no sign of frequency and could not be shifted.
        transfer[coarse // 2] = 0
        transfer[:, -1] = 0
        diameter = self.imaging.diameter * scale
        for height, weight in zip(_HEIGHTS, _WEIGHTS / _WEIGHTS.sum(), strict=True):
            lifted = phase + (0.5 * height * diameter).astype(np.float32)[:, None, None] * self._axial
            pupil = np.empty(lifted.shape, np.complex64)
            np.cos(lifted, out=pupil.real)
            np.sin(lifted, out=pupil.imag)
            pupil *= self._amplitude
            radius = 0.5 * diameter * math.sqrt(1 - height**2) / self.imaging.pixel_size
            q = np.maximum(2 * math.pi * radius[:, None, None] * length, 1e-6)
            disc = (weight * transfer * 2 * j1(q) / q).astype(np.float32)
            field = self._field(pupil)
            spectra[0] += scipy.fft.rfft2(field.real**2 + field.imag**2) * disc
            for k, factor in enumerate(factors):
                changed = self._field(pupil * factor)  # times i: 2 Re(E* i D) = 2 (E_i D_r - E_r D_i)
                difference = 2 * (field.imag * changed.real - field.real * changed.imag)
                spectra[1 + k] += scipy.fft.rfft2(difference) * disc
        return spectra

    def _shifted(self, spectra: NDArray[np.complex64], shift: Array | None) -> NDArray[np.complex64]:
        if shift is None:
            return spectra
        fy, fx, _ = self._frequency
        ramp = np.exp(-2j * math.pi * (shift[:, :1, None] * fx + shift[:, 1:, None] * fy))
        return spectra * ramp.astype(np.complex64)

    def _windows(self, spectra: NDArray[np.complexfloating]) -> Array:
        """Images (..., side, side) of their transforms, interpolated where these are coarser."""
        side, coarse = self.side_px, self._coarse
        if coarse < side:
            half = coarse // 2
            padded = np.zeros((*spectra.shape[:-2], side, side // 2 + 1), np.complex64)
            padded[..., :half, : half + 1] = spectra[..., :half, :]
            padded[..., -half:, : half + 1] = spectra[..., half:, :]
            padded *= np.float32((side / coarse) ** 2)
            return np.asarray(scipy.fft.irfft2(padded), dtype=np.float64)
        return np.asarray(scipy.fft.irfft2(spectra), dtype=np.float64)

    def _field(self, pupil: NDArray[np.complex64]) -> NDArray[np.complex64]:
        n, side, _ = pupil.shape
        rows = (pupil.reshape(-1, side) @ self._kernel).reshape(n, side, self._coarse)
        return np.asarray(self._kernel.T @ rows)


def _soft_aperture(radius: float, half: int) -> Array:
    """The aperture of ``radius`` samples, (2 half + 1)^2 samples, such that its image fades out before the
    image of the next period begins: sampled finely, transformed, faded, transformed back."""
    size = 2 * half + 1
    fine = size * _FINE
    f = (np.arange(fine) - fine // 2) / _FINE
    disc = np.clip(_FINE * (radius - np.hypot(*np.meshgrid(f, f))) + 0.5, 0, 1)
    x = np.abs(scipy.fft.fftfreq(fine, 1 / _FINE))
    fade = np.sin(0.5 * math.pi * np.clip((0.65 - np.hypot(*np.meshgrid(x, x))) / 0.3, 0, 1)) ** 2
    soft = scipy.fft.fftshift(scipy.fft.ifft2(scipy.fft.fft2(scipy.fft.ifftshift(disc)) * fade).real)
    middle = fine // 2
    chosen = middle + _FINE * np.arange(-half, half + 1)
    return np.asarray(soft[np.ix_(chosen, chosen)])
