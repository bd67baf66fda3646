"""Which source reads what, by its path alone."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
import pytest

from mems6dof_ros.errors import InputError
from mems6dof_ros.sources.source import kind_of, open_recording


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("a.mcap", "bag"),
        ("a.db3", "bag"),
        ("bag/metadata.yaml", "bag"),
        ("killed/bag_0.mcap", "bag"),  # whose reader tells how to recover it
        ("stack.ome.tif", "images"),
        ("folder/0.png", "images"),
        ("A.MKV", "video"),
    ],
)
def test_the_path_tells_the_source(tmp_path: Path, name: str, kind: str) -> None:
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).touch()
    assert kind_of(tmp_path / Path(name).parts[0]) == kind


def test_options_that_are_not_told_disturb_no_source(tmp_path: Path) -> None:
    codec = int.from_bytes(b"FFV1", "little")
    grey = [cv2.VIDEOWRITER_PROP_IS_COLOR, 0]
    path = tmp_path / "a.mkv"
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, codec, 25.0, (64, 48), grey)
    writer.write(np.zeros((48, 64), np.uint8))
    writer.release()
    assert open_recording(path, pixel_size=1e-7, step=math.nan).info.pixel_size == 1e-7
    with pytest.raises(InputError, match="option 'step'"):
        open_recording(path, step=1e-6)
