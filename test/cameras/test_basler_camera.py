"""Basler's own camera emulator through pylon; skipped where pypylon is not installed."""

from __future__ import annotations

import logging

import numpy as np
import pytest

from mems6dof_ros.errors import InputError
from mems6dof_ros.sources.cameras.basler import list_cameras
from mems6dof_ros.sources.cameras.emulation import basler_emulator
from mems6dof_ros.sources.source import open_source

pytest.importorskip("pypylon", reason="pypylon is not installed")

IMAGES = np.random.default_rng(3).integers(0, 65536, (7, 48, 64), dtype=np.uint16)


@pytest.fixture
def options(tmp_path):
    with basler_emulator(tmp_path, IMAGES) as options:
        yield options


def read(source, count):
    return [source.read(timeout=5.0) for _ in range(count)]


def test_our_images_come_through_bit_for_bit(options):
    source = open_source("basler", **options, frame_rate=100.0, exposure=0.003)
    source.start()
    frames = read(source, 20)
    source.stop()
    first = next(k for k in range(7) if np.array_equal(IMAGES[k], frames[0].image))
    for frame in frames:
        np.testing.assert_array_equal(frame.image, IMAGES[(first + frame.frame_counter) % 7])
    assert source.status.delivered + source.status.lost == frames[-1].frame_counter + 1
    stamps = [frame.stamp_ns for frame in frames]
    assert (np.diff(stamps) > 0).all()
    assert frames[0].exposure_s == pytest.approx(0.003)
    assert frames[0].saturation_adu == 65535


def test_failed_buffers_are_lost_frames(options):
    source = open_source("basler", **options, frame_rate=100.0)
    source.start()
    before = read(source, 3)
    nodes = source._device._camera.GetNodeMap()
    nodes.GetNode("ForceFailedBufferCount").SetValue(4)
    nodes.GetNode("ForceFailedBuffer").Execute()
    frames = before + read(source, 20)
    status = source.status
    source.stop()
    assert sum(frame.frames_dropped for frame in frames) == status.lost == status.incomplete == 4
    first = next(k for k in range(7) if np.array_equal(IMAGES[k], frames[0].image))
    for frame in frames:
        np.testing.assert_array_equal(frame.image, IMAGES[(first + frame.frame_counter) % 7])


def test_one_frame_per_software_trigger(options):
    source = open_source("basler", **options, trigger="software")
    source.start()
    with pytest.raises(TimeoutError):
        source.read(timeout=0.3)
    for k in range(10):
        source.trigger()
        frame = source.read(timeout=5.0)
        assert (frame.frame_counter, frame.cycle, frame.frames_dropped) == (k, k, 0)
    with pytest.raises(TimeoutError):
        source.read(timeout=0.3)
    source.stop()


def test_exposure_and_gain_change_while_frames_come(options):
    source = open_source("basler", **options, frame_rate=100.0, exposure=0.001)
    source.start()
    assert read(source, 5)[-1].exposure_s == pytest.approx(0.001)
    source.adjust(exposure=0.002, gain=12.0)
    assert read(source, 5)[0].exposure_s == pytest.approx(0.002)
    assert source.status.gain == pytest.approx(12.0, abs=1e-3)
    with pytest.raises(InputError, match="exposure: found 40; expected 1e-06 to 10"):
        source.adjust(exposure=40.0)
    assert read(source, 5)[-1].exposure_s == pytest.approx(0.002)
    source.stop()
    assert source.status.lost == 0


def test_triggers_at_a_rate(options):
    source = open_source("basler", **options, trigger="software", frame_rate=50.0)
    source.start()
    frames = read(source, 50)
    source.stop()
    assert source.status.lost == 0
    assert frames[-1].stamp_ns - frames[0].stamp_ns == pytest.approx(49 * 20_000_000, rel=0.1)


def test_an_unplugged_camera_is_reopened(options, caplog):
    source = open_source("basler", **options, frame_rate=100.0)
    source.start()
    before = read(source, 20)
    source._device._camera.GetNodeMap().GetNode("FirePnPCallback").Execute()  # pylon: device removed
    with caplog.at_level(logging.WARNING):
        while (frame := source.read(timeout=10.0)).frames_dropped == 0:
            before.append(frame)
    source.stop()
    assert source.status.reconnects == 1
    assert "it was unplugged" in caplog.text
    missed = (frame.stamp_ns - before[-1].stamp_ns) / 10_000_000 - 1
    assert frame.frames_dropped == pytest.approx(missed, abs=2, rel=0.1)
    assert frame.frame_counter == before[-1].frame_counter + frame.frames_dropped + 1


def test_is_listed_and_refuses_what_it_cannot(options):
    assert [camera.device for camera in list_cameras()] == ["0815-0000"]
    for wrong, complaint in (
        ({"exposure": 40.0}, "exposure: found 40; expected 1e-06 to 10"),
        ({"trigger": "Line9"}, "trigger: found 'Line9'"),
        ({"pixel_format": "Mono12p"}, "pixel_format: found 'Mono12p'"),
        ({"region": (0, 0, 9000, 8)}, "region: found Width 9000"),
        ({"features": ("ReverseX=perhaps",)}, "features: found ReverseX=perhaps; expected true or false"),
    ):
        with pytest.raises(InputError, match=complaint):
            open_source("basler", **{**options, **wrong})
