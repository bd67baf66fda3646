"""What the camera adds to the light: offset, gain, read noise, saturation."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mems6dof_ros.errors import InputError


@dataclass(frozen=True)
class CameraNoise:
    """Noise model of a camera: ``adu = offset + gain * electrons``, each a number or a pixel map.

    ``offset_adu``: pixel value without light, ADU. ``gain_adu_per_electron``: ADU per
    photoelectron, positive. ``read_noise_electrons``: standard deviation of everything in a pixel
    that is not photon noise, electrons. ``saturation_adu``: pixel value from which a pixel counts
    as saturated, ADU. A map has the shape (height, width) of the images. Kept as C-ordered float64
    arrays, (height, width) or (1, 1). Raises InputError for values that no camera has.
    """

    offset_adu: ArrayLike
    gain_adu_per_electron: ArrayLike
    read_noise_electrons: ArrayLike
    saturation_adu: float

    def __post_init__(self) -> None:
        for name in _MAPS:
            object.__setattr__(self, name, _number_or_map(name, getattr(self, name)))
        shapes = {getattr(self, name).shape for name in _MAPS} - {(1, 1)}
        if len(shapes) > 1:
            raise InputError("camera", f"maps of shapes {sorted(shapes)}", "one shape")
        if np.min(self.gain_adu_per_electron) <= 0:
            raise InputError("camera.gain_adu_per_electron", "0 or less", "positive ADU per electron")
        if np.min(self.read_noise_electrons) < 0:
            raise InputError("camera.read_noise_electrons", "a negative value", "0 or more electrons")
        if not 0 < self.saturation_adu < float("inf"):
            raise InputError("camera.saturation_adu", f"{self.saturation_adu}", "a positive number of ADU")

    @property
    def maps(self) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Offset, gain and read-noise variance (electrons^2), each (height, width) or (1, 1)."""
        read_noise = np.asarray(self.read_noise_electrons)
        return np.asarray(self.offset_adu), np.asarray(self.gain_adu_per_electron), read_noise * read_noise

    def check_shape(self, shape: tuple[int, ...]) -> None:
        """Raise InputError where a map does not have the ``shape`` (height, width) of the image."""
        for name in _MAPS:
            found = getattr(self, name).shape
            if found not in ((1, 1), shape):
                raise InputError(f"camera.{name}", f"a map of shape {found}", f"the image's {shape}")


_MAPS = tuple(f.name for f in fields(CameraNoise) if f.name != "saturation_adu")


def _number_or_map(name: str, value: ArrayLike) -> NDArray[np.float64]:
    try:
        array = np.ascontiguousarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(f"camera.{name}", repr(value)[:40], "a number or a map (height, width)") from None
    if array.size == 1:
        array = array.reshape(1, 1)
    if array.ndim != 2 or array.size == 0:
        raise InputError(f"camera.{name}", f"shape {array.shape}", "a number or a map (height, width)")
    if not np.isfinite(array).all():
        raise InputError(f"camera.{name}", "NaN or infinity", "finite numbers")
    array = array.copy()
    array.flags.writeable = False
    return array
