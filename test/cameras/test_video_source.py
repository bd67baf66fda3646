"""Video files: written here with OpenCV, read back exactly."""

from __future__ import annotations

import logging

import cv2
import numpy as np
import pytest

from mems6dof_ros.errors import InputError
from mems6dof_ros.sources.source import frames, open_source


def write_video(path, images, codec="FFV1"):
    height, width = images[0].shape
    depth = cv2.CV_16U if images[0].dtype == np.uint16 else cv2.CV_8U
    parameters = [cv2.VIDEOWRITER_PROP_DEPTH, depth, cv2.VIDEOWRITER_PROP_IS_COLOR, 0]
    fourcc = int.from_bytes(codec.encode(), "little")
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, fourcc, 25.0, (width, height), parameters)
    assert writer.isOpened()
    for image in images:
        writer.write(image)
    writer.release()
    return path


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_grey_video_is_exact(tmp_path, dtype):
    images = np.random.default_rng(0).integers(
        0, np.iinfo(dtype).max, (5, 48, 64), dtype=dtype, endpoint=True
    )
    source = open_source("video", path=write_video(tmp_path / "grey.mkv", images), pixel_size=1e-7)
    assert (source.info.width, source.info.height, source.info.frames) == (64, 48, 5)
    assert source.info.encoding == ("mono8" if dtype == np.uint8 else "mono16")
    for _ in range(2):  # start begins again
        read = list(frames(source))
        np.testing.assert_array_equal([frame.image for frame in read], images)
    assert [frame.stamp_ns for frame in read] == [40_000_000 * k for k in range(1, 6)]
    assert [frame.frame_counter for frame in read] == list(range(5))
    assert not read[0].live


def test_other_pixels_are_converted_and_that_is_said(tmp_path, caplog):
    images = [np.full((48, 64), level, np.uint8) for level in (40, 90, 200)]
    with caplog.at_level(logging.WARNING):
        source = open_source("video", path=write_video(tmp_path / "colour.avi", images, "MJPG"))
    assert "converted to 8-bit grey" in caplog.text
    for frame, image in zip(frames(source), images, strict=True):
        np.testing.assert_allclose(frame.image, image, atol=4)  # JPEG and limited range


def test_cut_and_foreign_files(tmp_path):
    rng = np.random.default_rng(1)
    path = write_video(tmp_path / "cut.avi", list(rng.integers(0, 256, (9, 48, 64), dtype=np.uint8)))
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(InputError, match=r"cut\.avi"):
        list(frames(open_source("video", path=path)))
    (tmp_path / "text.mkv").write_text("not a video")
    with pytest.raises(InputError, match=r"text\.mkv: found no video"):
        open_source("video", path=tmp_path / "text.mkv")
    with pytest.raises(InputError, match="no such file"):
        open_source("video", path=tmp_path / "absent.mkv")
