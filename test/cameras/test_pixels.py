"""Pixel formats against bytes worked out by hand from the standards, and against an obvious encoder."""

from __future__ import annotations

import numpy as np
import pytest

from mems6dof_ros.errors import InputError
from mems6dof_ros.sources.cameras.pixels import FORMATS, decode, full_scale, payload_bytes

# From the layout diagrams: PFNC 2.4 (Mono10p, Mono12p), GigE Vision 2.0 (Mono10Packed, Mono12Packed).
BY_HAND = {
    "Mono8": ([0x00, 0x7F, 0xFF, 0x01], [0x00, 0x7F, 0xFF, 0x01]),
    "Mono10": ([0xFF, 0x03, 0x01, 0x02, 0x00, 0x00, 0xAA, 0x02], [0x3FF, 0x201, 0x000, 0x2AA]),
    "Mono16": ([0x34, 0x12, 0xFF, 0xFF, 0x00, 0x00, 0xCD, 0xAB], [0x1234, 0xFFFF, 0x0000, 0xABCD]),
    "Mono12p": ([0xBC, 0x3A, 0x12, 0xFF, 0x0F, 0x00], [0xABC, 0x123, 0xFFF, 0x000]),
    "Mono12Packed": ([0xAB, 0x3C, 0x12, 0xFF, 0x0F, 0x00], [0xABC, 0x123, 0xFFF, 0x000]),
    # 0x2AB = 10 1010 1011, 0x134 = 01 0011 0100, 0x3FF, 0x001
    "Mono10p": ([0xAB, 0xD2, 0xF4, 0x7F, 0x00], [0x2AB, 0x134, 0x3FF, 0x001]),
    "Mono10Packed": ([0xAA, 0x03, 0x4D, 0xFF, 0x13, 0x00], [0x2AB, 0x134, 0x3FF, 0x001]),
}


@pytest.mark.parametrize("name", BY_HAND)
def test_bytes_worked_out_by_hand(name):
    data, pixels = BY_HAND[name]
    image = decode(bytes(data), name, 2, 2)
    assert image.dtype == (np.uint8 if name == "Mono8" else np.uint16)
    np.testing.assert_array_equal(image, np.reshape(pixels, (2, 2)))


def encode(pixels: list[int], name: str) -> bytes:
    """Slow and obvious: a string of bits."""
    value_bits, stored_bits = FORMATS[name]
    if name.endswith("Packed"):
        low = value_bits - 8
        data = bytearray()
        for k in range(0, len(pixels), 2):
            first, second = pixels[k], pixels[k + 1] if k + 1 < len(pixels) else 0
            mask = (1 << low) - 1
            data += bytes((first >> low, (first & mask) | (second & mask) << 4, second >> low))
        return bytes(data)
    bits = "".join(format(pixel, f"0{stored_bits}b")[::-1] for pixel in pixels)
    bits += "0" * (-len(bits) % 8)
    return bytes(int(bits[k : k + 8][::-1], 2) for k in range(0, len(bits), 8))


@pytest.mark.parametrize(("width", "height"), [(8, 6), (7, 5), (1, 1), (5, 3)])
@pytest.mark.parametrize("name", FORMATS)
def test_random_pixels_come_back_exactly(name, width, height):
    rng = np.random.default_rng(7)
    pixels = rng.integers(0, full_scale(name) + 1, (height, width))
    pixels.flat[0] = full_scale(name)
    data = encode(pixels.ravel().tolist(), name)
    assert len(data) == payload_bytes(name, width, height)
    np.testing.assert_array_equal(decode(data, name, width, height), pixels)
    np.testing.assert_array_equal(decode(data + b"chunk", name, width, height), pixels)


def test_missing_bytes_are_refused():
    with pytest.raises(InputError, match="found 23 bytes; expected 24"):
        decode(bytes(23), "Mono12p", 4, 4)
