"""Monochrome pixel formats: names as in GenICam's PFNC, bytes to arrays.

Layouts: EMVA, GenICam Pixel Format Naming Convention 2.4 (``Mono10p``, ``Mono12p``: one stream of bits,
least significant first) and AIA, GigE Vision 2.0, annex on pixel layouts (``Mono10Packed``,
``Mono12Packed``: two pixels in three bytes, the high bits of each in bytes 0 and 2).
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mems6dof_ros.errors import InputError

#: Bits that carry the value, and bits per pixel in memory; deepest first, and of equal depth the cheapest.
FORMATS = {
    "Mono16": (16, 16),
    "Mono14": (14, 16),
    "Mono12": (12, 16),
    "Mono12p": (12, 12),
    "Mono12Packed": (12, 12),
    "Mono10": (10, 16),
    "Mono10p": (10, 10),
    "Mono10Packed": (10, 12),
    "Mono8": (8, 8),
}


def full_scale(name: str) -> int:
    """Largest value of the format, ADU."""
    return (1 << FORMATS[name][0]) - 1


def encoding(name: str) -> str:
    """ROS image encoding that holds the format."""
    return "mono8" if name == "Mono8" else "mono16"


def payload_bytes(name: str, width: int, height: int) -> int:
    """Bytes of an image without padding; packed formats run on from line to line."""
    if name.endswith("Packed"):  # whole pairs of pixels
        return (width * height + 1) // 2 * 3
    return (width * height * FORMATS[name][1] + 7) // 8


def decode(data: bytes | NDArray[np.uint8], name: str, width: int, height: int) -> NDArray[np.generic]:
    """Image (height, width), uint8 or uint16 in ADU, aligned to the least significant bit.

    Unpacked formats are views of ``data``. Bytes beyond the image (chunk data) are ignored; too few
    raise InputError.
    """
    needed = payload_bytes(name, width, height)
    raw = np.frombuffer(data, np.uint8)
    if raw.size < needed:
        raise InputError("camera frame", f"{raw.size} bytes", f"{needed} for {width} x {height} {name}")
    pixels = width * height
    image: NDArray[np.generic]
    if name == "Mono8":
        image = raw[:needed]
    elif name.endswith("Packed"):
        image = _unpack_pairs(raw[:needed], pixels, FORMATS[name][0] - 8)
    elif name.endswith("p"):
        image = _unpack_bits(raw[:needed], pixels, FORMATS[name][0])
    else:
        image = raw[:needed].view("<u2").astype(np.uint16, copy=False)
    return image.reshape(height, width)


@njit(cache=True, nogil=True)
def _unpack_bits(raw: NDArray[np.uint8], pixels: int, bits: int) -> NDArray[np.uint16]:
    """Pixel k is the ``bits`` bits from bit k * bits on, which lie in two bytes."""
    image = np.empty(pixels, np.uint16)
    for k in range(pixels):
        first, shift = divmod(k * bits, 8)
        image[k] = (raw[first] | raw[first + 1] << 8) >> shift & ((1 << bits) - 1)
    return image


@njit(cache=True, nogil=True)
def _unpack_pairs(raw: NDArray[np.uint8], pixels: int, low_bits: int) -> NDArray[np.uint16]:
    """Bytes 0 and 2 hold the high bits, byte 1 the low bits of the first (right) and second (left) pixel."""
    image = np.empty(pixels, np.uint16)
    for k in range(pixels):
        low = raw[k // 2 * 3 + 1] >> (4 * (k % 2)) & ((1 << low_bits) - 1)
        image[k] = raw[k // 2 * 3 + 2 * (k % 2)] << low_bits | low
    return image
