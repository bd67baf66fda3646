"""From expected electrons to a digital image: shot noise, read noise, gain, offset, saturation."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from mems6dof_ros.simulation.optics import ParticleImages
from mems6dof_ros.simulation.settings import SimulationSettings

_MARGIN = 1 / 16  # by so much of the image's smaller side the noise banks are larger than it


class Camera:
    """A camera with fixed-pattern maps of gain, offset and read noise.

    A pixel reads ``offset + gain (electrons + read noise)``, rounded and clipped to 0 and saturation;
    electrons are Poisson distributed. What a localizer is told are the means: ``gain`` ADU per
    electron, ``offset_adu``, ``read_noise`` electrons rms, ``saturation_adu``; what it is not told are the
    maps ``gain_map``, ``offset_map_adu``, ``read_noise_map`` (height, width), float32.

    Noise is exact in every frame and cheap: a sum of Poisson numbers is a Poisson number, so the
    background comes from a bank drawn once, slightly larger than the image, cropped at a random
    place, and the light of particles is drawn only where there is any. Read noise comes likewise
    from a bank of normal numbers, scaled by the map. The price: two frames share background noise
    shifted by a random vector (of 2048 x 2048 px, one pair in 16 641 unshifted; read noise has its own
    shift), and the background's smooth illumination moves along by up to 1/32 of the image.
    ``rng`` draws all noise.
    """

    def __init__(self, settings: SimulationSettings, rng: np.random.Generator) -> None:
        self.gain = settings.gain
        self.offset_adu = settings.offset_adu
        self.read_noise = settings.read_noise
        self.saturation_adu = settings.saturation_adu
        self._dtype = np.uint8 if settings.pixel_format == "mono8" else np.uint16
        shape = settings.height_px, settings.width_px
        pattern = np.random.default_rng([settings.camera_seed, 0xCA3E6A])

        def spread(sd: float) -> NDArray[np.float32]:
            return np.float32(sd) * pattern.standard_normal(shape, dtype=np.float32)

        self.gain_map = np.float32(settings.gain) * (1 + spread(settings.gain_spread))
        self.offset_map_adu = np.float32(settings.offset_adu) + spread(settings.offset_spread_adu)
        self.read_noise_map = np.float32(settings.read_noise) * np.exp(spread(settings.read_noise_spread))
        self._read_map_adu = self.read_noise_map * self.gain_map

        self._margin = round(_MARGIN * min(shape))
        bank_shape = shape[0] + self._margin, shape[1] + self._margin
        mean = settings.background * illumination_map(bank_shape, settings)
        self._background = rng.poisson(mean).astype(np.uint16)
        self._read = rng.standard_normal(bank_shape, dtype=np.float32)
        self._signal = np.zeros(shape, np.int32)
        self._rng = rng

    def expose(self, images: ParticleImages, *, covered: bool = False) -> NDArray[np.generic]:
        """One digital image (height, width), uint8 or uint16, of the rendered ``images`` on background, or on
        none where the lens is ``covered``."""
        height, width = self._signal.shape
        side = images.image.shape[-1]
        touched = []
        for (column, row), window in zip(images.corner, images.image, strict=True):
            rows = slice(max(row, 0), min(row + side, height))
            columns = slice(max(column, 0), min(column + side, width))
            if rows.start >= rows.stop or columns.start >= columns.stop:
                continue
            part = window[rows.start - row : rows.stop - row, columns.start - column : columns.stop - column]
            self._signal[rows, columns] += self._rng.poisson(part).astype(np.int32)
            touched.append((rows, columns))
        by, bx, ry, rx = self._rng.integers(0, self._margin + 1, 4)
        digital = np.empty((height, width), self._dtype)
        background = self._background[by : by + height, bx : bx + width]
        _digitize(
            np.zeros_like(self._background)[by : by + height, bx : bx + width] if covered else background,
            self._read[ry : ry + height, rx : rx + width],
            self._signal,
            self.gain_map,
            self.offset_map_adu,
            self._read_map_adu,
            self.saturation_adu,
            digital,
        )
        for rows, columns in touched:
            self._signal[rows, columns] = 0
        return digital


def illumination(
    x_px: NDArray[np.float64], y_px: NDArray[np.float64], settings: SimulationSettings
) -> NDArray[np.float64]:
    """Relative illumination at pixels from the image's centre: 1 there, a parabola to the corners."""
    corner2 = (settings.width_px**2 + settings.height_px**2) / 4
    return np.maximum(1 - settings.illumination_falloff * (x_px**2 + y_px**2) / corner2, 0)


def illumination_map(shape: tuple[int, int], settings: SimulationSettings) -> NDArray[np.float64]:
    """Illumination of a centred array of pixels of that ``shape`` (height, width)."""
    y, x = (np.arange(size, dtype=float) - (size - 1) / 2 for size in shape)
    return illumination(x[None, :], y[:, None], settings)


@numba.njit(nogil=True, cache=True)
def _digitize(background, read, signal, gain, offset, read_adu, saturation, digital):  # type: ignore[no-untyped-def]
    """digital = clip(round(offset + gain (background + signal) + read_adu read), 0, saturation)."""
    top = np.float32(saturation)
    for i in range(digital.shape[0]):
        for j in range(digital.shape[1]):
            electrons = np.float32(background[i, j]) + np.float32(signal[i, j])
            value = offset[i, j] + gain[i, j] * electrons + read_adu[i, j] * read[i, j] + np.float32(0.5)
            digital[i, j] = min(max(value, np.float32(0)), top)
