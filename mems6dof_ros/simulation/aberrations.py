"""Wavefront aberrations that vary over the field: named presets, drawn from a seed.

The smooth terms follow nodal aberration theory of a slightly misaligned objective (Shack and
Thompson, Proc. SPIE 251, 1980): coma linear in the field, astigmatism quadratic in it, each
about its own node, on a constant that a tilted element adds. On top comes *local* astigmatism,
a random field with a correlation length of a few micrometres, as dust, the surface under a
particle and the particle itself cause.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mems6dof_ros.errors import InputError

#: Field radius at which the presets state their field-dependent terms: the corner of 260 um x 260 um.
FIELD_RADIUS = 184e-6

#: Zernike terms of a wavefront, in Noll's order and normalisation (rms over the pupil is the
#: coefficient): astigmatism at 45 and 0 degrees, coma along y and x, spherical (Noll 5 to 8, 11).
TERMS = ("astigmatism_45", "astigmatism_0", "coma_y", "coma_x", "spherical")


@dataclass(frozen=True)
class Preset:
    """What a named set of optics has in common; waves rms unless noted, field terms at FIELD_RADIUS.

    ``astigmatism`` is the constant term as the complex number (0 degrees) + i (45 degrees);
    ``astigmatism_linear``, ``astigmatism_quadratic`` and ``coma_linear`` are magnitudes whose
    directions the seed draws; so is that of ``coma``. ``local_astigmatism`` m rms of each of the two
    components, ``field_curvature`` m sag of the focal surface, ``chief_ray_slope`` rad departure
    from telecentricity.
    """

    astigmatism: complex = 0j
    astigmatism_linear: float = 0.0
    astigmatism_quadratic: float = 0.0
    coma: float = 0.0
    coma_linear: float = 0.0
    spherical: float = 0.0
    local_astigmatism: float = 0.0
    field_curvature: float = 0.0
    chief_ray_slope: float = 0.0


_SMOOTH = Preset(
    astigmatism=0.07j,
    astigmatism_linear=0.015,
    astigmatism_quadratic=0.01,
    coma=0.025,
    coma_linear=0.015,
    spherical=0.05,
    field_curvature=0.8e-6,
    chief_ray_slope=0.01,
)

PRESETS: dict[str, Preset] = {
    "ideal": Preset(),
    "smooth": _SMOOTH,
    "paper": replace(_SMOOTH, local_astigmatism=2e-9),
    "sign_change": replace(_SMOOTH, astigmatism=0.07, astigmatism_linear=0.05, local_astigmatism=2e-9),
}

_LOCAL_CORRELATION = 5e-6
_LOCAL_WAVES = 128


@dataclass(frozen=True)
class FieldAberrations:
    """The aberrations of one objective as functions of the field position.

    With H = (X + iY)/FIELD_RADIUS, in waves rms: astigmatism (0 degrees) + i (45 degrees) =
    sum_k ``astigmatism[k]`` H^k plus the local part; coma x + i y = ``coma[0]`` + ``coma[1]`` H;
    ``spherical`` constant. The focal surface lies at ``field_curvature`` |H|^2 (m), and the chief ray
    leans by ``chief_ray[0]`` + ``chief_ray[1]`` H (rad, complex as x + iy). ``local_wave_vector``
    (m, 2) rad/m, ``local_phase`` (m, 2) rad and ``local_amplitude`` (waves rms) define the local part.
    """

    astigmatism: tuple[complex, complex, complex]
    coma: tuple[complex, complex]
    spherical: float
    field_curvature: float
    chief_ray: tuple[complex, complex]
    local_amplitude: float
    local_wave_vector: NDArray[np.float64]
    local_phase: NDArray[np.float64]

    @classmethod
    def from_preset(cls, name: str, seed: int, wavelength: float) -> FieldAberrations:
        """Draw the optics number ``seed`` of the preset ``name``; magnitudes vary by about 10 %.

        ``wavelength`` m converts the local wavefront to waves. Raises InputError for an unknown name.
        """
        if name not in PRESETS:
            raise InputError("optics", repr(name), f"one of {', '.join(PRESETS)}")
        preset = PRESETS[name]
        rng = np.random.default_rng([seed, 0x0B71C5])

        def vary() -> float:
            return float(np.clip(rng.normal(1.0, 0.1), 0.8, 1.2))

        def direction() -> complex:
            return complex(np.exp(1j * rng.uniform(0, 2 * math.pi)))

        return cls(
            astigmatism=(
                preset.astigmatism * vary(),
                preset.astigmatism_linear * vary() * direction(),
                preset.astigmatism_quadratic * vary() * direction(),
            ),
            coma=(preset.coma * vary() * direction(), complex(preset.coma_linear * vary())),
            spherical=preset.spherical * vary(),
            field_curvature=preset.field_curvature * vary(),
            chief_ray=(
                preset.chief_ray_slope * vary() * direction(),
                complex(preset.chief_ray_slope * vary()),
            ),
            local_amplitude=preset.local_astigmatism / wavelength,
            local_wave_vector=rng.normal(0, 1 / _LOCAL_CORRELATION, (_LOCAL_WAVES, 2)),
            local_phase=rng.uniform(0, 2 * math.pi, (_LOCAL_WAVES, 2)),
        )

    def coefficients(self, xy: NDArray[np.float64]) -> NDArray[np.float64]:
        """Zernike coefficients (n, 5), waves rms, in the order of TERMS at positions (n, 2) m."""
        field = (xy[:, 0] + 1j * xy[:, 1]) / FIELD_RADIUS
        astigmatism = np.polynomial.polynomial.polyval(field, self.astigmatism)
        if self.local_amplitude:
            # A sum of random plane waves tends to a Gaussian random field of Gaussian correlation.
            phase = (xy @ self.local_wave_vector.T)[:, :, None] + self.local_phase
            local = self.local_amplitude * math.sqrt(2 / len(self.local_phase)) * np.cos(phase).sum(axis=1)
            astigmatism = astigmatism + local[:, 0] + 1j * local[:, 1]
        coma = self.coma[0] + self.coma[1] * field
        spherical = np.full(len(xy), self.spherical)
        return np.stack([astigmatism.imag, astigmatism.real, coma.imag, coma.real, spherical], axis=1)

    def focal_surface(self, xy: NDArray[np.float64]) -> NDArray[np.float64]:
        """Height of the surface of best focus above the focal plane, (n,) m, at positions (n, 2) m."""
        return self.field_curvature * (xy**2).sum(axis=1) / FIELD_RADIUS**2

    def chief_ray_slope(self, xy: NDArray[np.float64]) -> NDArray[np.float64]:
        """Lateral shift of the image per defocus, (n, 2) rad, at positions (n, 2) m."""
        slope = self.chief_ray[0] + self.chief_ray[1] * (xy[:, 0] + 1j * xy[:, 1]) / FIELD_RADIUS
        return np.stack([slope.real, slope.imag], axis=1)
