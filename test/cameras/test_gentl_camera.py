"""The GenTL producer of the genicam wheel through harvesters; skipped where they are not installed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mems6dof_ros.errors import InputError
from mems6dof_ros.sources.cameras import gentl
from mems6dof_ros.sources.source import open_source

pytest.importorskip("harvesters", reason="harvesters is not installed")
genicam = pytest.importorskip("genicam", reason="genicam is not installed")

PRODUCER = Path(genicam.__file__).with_name("viky.cti")


def test_cameras_are_listed(monkeypatch):
    assert [camera.device for camera in gentl.list_cameras(PRODUCER)] == [
        "VikyTL_DEV_red",
        "VikyTL_DEV_green",
        "VikyTL_DEV_blue",
    ]
    monkeypatch.setenv("GENICAM_GENTL64_PATH", str(PRODUCER.parent))
    assert gentl.find_producers() == [PRODUCER]


def test_frames_arrive_counted_and_in_order():
    source = open_source(
        "genicam", producer=str(PRODUCER), device="VikyTL_DEV_red", region=(0, 0, 400, 300), frame_rate=25.0
    )
    assert (source.info.width, source.info.height, source.info.encoding) == (400, 300, "mono8")
    source.start()
    frames = [source.read(timeout=5.0) for _ in range(25)]
    source.stop()
    assert all(frame.image.shape == (300, 400) for frame in frames)
    assert source.status.delivered + source.status.lost == frames[-1].frame_counter + 1
    stamps = [frame.stamp_ns for frame in frames]
    assert (np.diff(stamps) > 0).all()
    assert np.median(np.diff(stamps)) == pytest.approx(40_000_000, rel=0.1)


def test_wrong_producer_or_device():
    with pytest.raises(InputError, match=r"producer: found no file nowhere\.cti"):
        open_source("genicam", producer="nowhere.cti")
    with pytest.raises(InputError, match="device: found 3 cameras"):
        open_source("genicam", producer=str(PRODUCER))
