"""Images that claim to be larger than any."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
import tifffile

from mems6dof_ros.errors import InputError
from mems6dof_ros.sources.images import ImagesSource


def chunk(kind: bytes, content: bytes) -> bytes:
    """Of a PNG."""
    body = kind + content
    return struct.pack(">I", len(content)) + body + struct.pack(">I", zlib.crc32(body))


def test_a_png_of_two_billion_columns_is_refused(tmp_path: Path) -> None:
    head = chunk(b"IHDR", struct.pack(">IIBBBBB", 2**31 - 1, 1, 8, 0, 0, 0, 0))
    path = tmp_path / "wide.png"
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + head + chunk(b"IDAT", zlib.compress(b"\0")) + chunk(b"IEND", b""))
    with pytest.raises(InputError, match="a damaged file"):
        ImagesSource(path)


def test_a_bitmap_of_two_billion_columns_is_refused(tmp_path: Path) -> None:
    head = struct.pack("<IiiHHIIiiII", 40, 2**31 - 1, 1, 1, 8, 0, 0, 0, 0, 0, 0)
    path = tmp_path / "wide.bmp"
    path.write_bytes(b"BM" + struct.pack("<IHHI", 54 + 64, 0, 0, 54) + head + bytes(64))
    with pytest.raises(InputError, match="a damaged file"):
        ImagesSource(path)


@pytest.mark.parametrize("tag", ["ImageWidth", "ImageLength"])
def test_a_tiled_tiff_that_lacks_its_tiles_is_refused(tmp_path: Path, tag: str) -> None:
    """One flipped bit of the width; tifffile alone returns a gigabyte of zeros."""
    path = tmp_path / "tiled.tif"
    tifffile.imwrite(path, np.ones((32, 48), np.uint16), compression="zlib", tile=(16, 16))
    with tifffile.TiffFile(path, mode="r+") as tiff:
        entry = tiff.pages.first.tags[tag]
        entry.overwrite(entry.value ^ 1 << 24, dtype=4)
    with pytest.raises(InputError, match=r"6 of its \d+ strips or tiles"):
        ImagesSource(path)
