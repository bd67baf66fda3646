"""TIFF stacks and folders: what is read, and what is refused."""

from __future__ import annotations

import math
import os
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile

from mems6dof_ros.errors import InputError
from mems6dof_ros.sources.source import frames, open_source

RNG = np.random.default_rng(3)


def stack(dtype=np.uint16, count=6, height=24, width=32):
    return RNG.integers(0, np.iinfo(dtype).max, (count, height, width), endpoint=True).astype(dtype)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize(
    "options", [{}, {"compression": "zlib"}, {"ome": True}, {"imagej": True}, {"bigtiff": True}]
)
def test_tiff_stacks(tmp_path, dtype, options):
    images = stack(dtype)
    tifffile.imwrite(tmp_path / "s.tif", images, **options)
    source = open_source(
        "images", path=tmp_path / "s.tif", pixel_size=1.2e-7, step=2e-7, start=-5e-7, period=0.02
    )
    assert (source.info.width, source.info.height, source.info.frames) == (32, 24, 6)
    assert source.info.encoding == ("mono8" if dtype == np.uint8 else "mono16")
    read = list(frames(source))
    assert np.array_equal([f.image for f in read], images)
    assert [f.frame_counter for f in read] == [f.cycle for f in read] == list(range(6))
    assert [f.stamp_ns for f in read] == [20_000_000 * (k + 1) for k in range(6)]
    np.testing.assert_allclose([f.stage_z for f in read], -5e-7 + 2e-7 * np.arange(6), atol=1e-15)
    assert {f.pixel_size for f in read} == {1.2e-7}
    assert len(list(frames(source))) == 6  # starts over


def test_big_endian_pixels_come_out_native(tmp_path):
    images = stack()
    tifffile.imwrite(tmp_path / "s.tif", images, byteorder=">")
    first = next(frames(open_source("images", path=tmp_path / "s.tif")))
    assert first.image.dtype.isnative
    assert np.array_equal(first.image, images[0])


def test_scale_comes_from_ome_metadata_unless_given(tmp_path):
    metadata = {"axes": "ZYX", "PhysicalSizeX": 127.34, "PhysicalSizeXUnit": "nm", "PhysicalSizeZ": 0.3}
    tifffile.imwrite(tmp_path / "s.ome.tif", stack(), metadata=metadata)
    read = list(frames(open_source("images", path=tmp_path / "s.ome.tif")))
    assert math.isclose(read[0].pixel_size, 127.34e-9)
    assert math.isclose(read[2].stage_z, 0.6e-6)
    given = open_source("images", path=tmp_path / "s.ome.tif", pixel_size=1e-7)
    assert given.info.pixel_size == 1e-7


def test_without_a_step_the_stage_is_unknown(tmp_path):
    tifffile.imwrite(tmp_path / "s.tif", stack())
    assert math.isnan(next(frames(open_source("images", path=tmp_path / "s.tif"))).stage_z)


@pytest.mark.parametrize("suffix", ["png", "tif"])
def test_folders_in_natural_order(tmp_path, suffix):
    images = stack(count=11)
    for k, image in enumerate(images):
        cv2.imwrite(str(tmp_path / f"z{k}.{suffix}"), image)
    (tmp_path / "notes.txt").write_text("not an image")
    assert np.array_equal([f.image for f in frames(open_source("images", path=tmp_path))], images)


def refused(path: Path, **options) -> str:
    """The complaint about ``path``, one line that names it."""
    with pytest.raises(InputError) as caught:
        list(frames(open_source("images", path=path, **options)))
    text = str(caught.value)
    assert "\n" not in text
    assert str(path) in text
    return text


@pytest.mark.parametrize("options", [{}, {"compression": "zlib"}, {"ome": True}, {"imagej": True}])
@pytest.mark.parametrize("share", [0.0, 0.04, 0.4, 0.7, 0.95])
def test_a_truncated_tiff_is_never_read_as_a_shorter_one(tmp_path, options, share):
    tifffile.imwrite(tmp_path / "s.tif", stack(), **options)
    os.truncate(tmp_path / "s.tif", int(share * (tmp_path / "s.tif").stat().st_size))
    assert "TIFF" in refused(tmp_path / "s.tif")


@pytest.mark.parametrize("suffix", ["png", "pgm", "bmp", "tif"])
def test_a_truncated_member_of_a_folder(tmp_path, suffix):
    for k, image in enumerate(stack(np.uint8, count=3)):
        cv2.imwrite(str(tmp_path / f"{k}.{suffix}"), image)
    os.truncate(tmp_path / f"1.{suffix}", (tmp_path / f"1.{suffix}").stat().st_size // 2)
    assert f"1.{suffix}" in refused(tmp_path)


def test_pixels_that_cannot_be_measured(tmp_path):
    tifffile.imwrite(tmp_path / "rgb.tif", np.zeros((4, 24, 32, 3), np.uint8), photometric="rgb")
    assert "colour" in refused(tmp_path / "rgb.tif")
    tifffile.imwrite(tmp_path / "float.tif", np.zeros((4, 24, 32), np.float32), photometric="minisblack")
    assert "float32" in refused(tmp_path / "float.tif")
    cv2.imwrite(str(tmp_path / "rgb.png"), np.zeros((24, 32, 3), np.uint8))
    assert "(24, 32, 3)" in refused(tmp_path / "rgb.png")


def test_members_of_another_size(tmp_path):
    for k, shape in enumerate([(24, 32), (24, 32), (24, 33)]):
        cv2.imwrite(str(tmp_path / f"{k}.png"), np.zeros(shape, np.uint8))
    assert "33 x 24 px" in refused(tmp_path)


def test_reading_goes_on_behind_a_bad_member(tmp_path):
    for k in range(4):
        cv2.imwrite(str(tmp_path / f"{k}.png"), np.full((24, 32 + (k == 1)), k, np.uint8))
    source = open_source("images", path=tmp_path)
    source.start()
    values = []
    for _ in range(4):
        try:
            values.append(int(source.read().image[0, 0]))
        except InputError:
            values.append(-1)
    assert values == [0, -1, 2, 3]
    assert source.read() is None


def test_nothing_there(tmp_path):
    assert "nothing there" in refused(tmp_path / "absent.tif")
    (tmp_path / "empty").mkdir()
    assert "no images" in refused(tmp_path / "empty")
    (tmp_path / "text.png").write_text("hello")
    refused(tmp_path / "text.png")
    shutil.copy(tmp_path / "text.png", tmp_path / "text.tif")
    refused(tmp_path / "text.tif")


def test_real_micrographs():
    folder = Path(os.environ.get("MEMS6DOF_REAL_DATA", Path(__file__).parents[3] / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip("no real micrographs here (MEMS6DOF_REAL_DATA)")
    expected = {
        "bead_stack_astigmatic_air085.tif": (80, 593, 593, "mono8"),
        "bead_stack_plain_na095.tif": (34, 512, 512, "mono8"),
        "bead_intrinsic_air085.tif": (25, 256, 256, "mono16"),
    }
    for name, (count, height, width, encoding) in expected.items():
        info = open_source("images", path=folder / name).info
        assert (info.frames, info.height, info.width, info.encoding) == (count, height, width, encoding)
