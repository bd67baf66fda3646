"""Aravis' emulated GigE Vision camera through the real driver and real packets on the loopback interface.

Skipped where the driver (gi, Aravis) or the emulator (aravis-tools) is not installed.
"""

from __future__ import annotations

import logging
import threading
import time

import numpy as np
import pytest

from mems6dof_ros.errors import InputError, Mems6dofError
from mems6dof_ros.sources.cameras import aravis
from mems6dof_ros.sources.cameras.device import DriverMissingError
from mems6dof_ros.sources.cameras.emulation import GigeEmulator, WireCounter
from mems6dof_ros.sources.source import open_source

RATE = 40.0


@pytest.fixture(scope="module", autouse=True)
def _driver():
    try:
        aravis.list_cameras()
        GigeEmulator()
    except Mems6dofError as missing:
        pytest.skip(str(missing))


@pytest.fixture
def wire():
    try:
        counter = WireCounter()
    except PermissionError:
        pytest.skip("counting packets on the wire needs a raw socket (root)")
    with counter:
        yield counter


def open_camera(emulator, **options):
    settings = {
        "device": emulator.device,
        "region": (0, 0, 256, 200),
        "frame_rate": RATE,
        "exposure": 0.01,
        "timestamp_at": "end",
        "packet_size": 9000,
    }
    return open_source("genicam", **{**settings, **options})


def read_for(source, seconds):
    """Frames of so many seconds, then those that still wait after the camera has stopped to expose."""
    frames, end = [], time.monotonic() + seconds
    while time.monotonic() < end:
        frames.append(source.read(timeout=5.0))
    source._device._camera.stop_acquisition()
    while True:
        try:
            frames.append(source.read(timeout=0.4))
        except TimeoutError:
            return frames


def assert_pattern(image):
    """The emulator's ramp depends on x + y + frame id: a stretch of another frame would break it."""
    step = 256 if image.dtype == np.uint16 else 1
    np.testing.assert_array_equal(image[1:, :-1], image[:-1, 1:])
    assert np.mean(np.diff(image[0].astype(int)) == step) > 0.9  # it wraps once or twice


@pytest.mark.parametrize("pixel_format", ["Mono8", "Mono16"])
def test_delivered_and_lost_make_what_was_sent(wire, pixel_format):
    with GigeEmulator() as emulator:
        source = open_camera(emulator, pixel_format=pixel_format)
        assert (source.info.width, source.info.height) == (256, 200)
        source.start()
        frames = read_for(source, 4.0)  # beyond the wrap of the 16-bit ids, 135 frames after the start
        status = source.status
        source.stop()
    assert status.delivered == len(frames) > 135
    assert status.delivered + status.lost == wire.produced
    assert frames[-1].frame_counter == wire.produced - 1
    for frame in frames:
        assert_pattern(frame.image)
    stamps = np.array([frame.stamp_ns for frame in frames])
    assert (np.diff(stamps) > 0).all()
    # The emulator's clock is the host's: 5 ms (half the exposure) before its stamp is the true stamp.
    errors = (stamps - np.array([frame.device_time_ns - 5_000_000 for frame in frames])) * 1e-9
    assert 0 <= np.median(errors) < 2 * status.stamp_uncertainty
    assert status.stamp_uncertainty == pytest.approx(1 / RATE / np.sqrt(3), rel=0.1)


def test_lost_packets_are_lost_frames_not_garbage(wire):
    with GigeEmulator(lost_per_thousand=20) as emulator:
        source = open_camera(emulator, pixel_format="Mono16")
        source.start()
        frames = read_for(source, 3.0)
        status = source.status
        source.stop()
    # 13 packets per frame, so 0.98 ** 13 = 77 % arrive whole; 5 sigma.
    whole = status.delivered / (status.delivered + status.lost)
    assert whole == pytest.approx(0.98**13, abs=5 * np.sqrt(0.77 * 0.23 / wire.produced))
    assert status.incomplete > 0
    assert sum(frame.frames_dropped for frame in frames) == status.lost
    # Lost before the first and after the last complete frame: no counter tells (a few in 4 at 5 sigma).
    assert 0 <= wire.produced - status.delivered - status.lost <= 6
    for frame in frames:
        assert_pattern(frame.image)


def test_killed_and_restarted_camera_resumes(caplog):
    with GigeEmulator() as emulator:
        source = open_camera(emulator)
        source.start()
        before = [source.read(timeout=5.0) for _ in range(20)]

        def replug():
            emulator.kill()
            time.sleep(0.7)
            emulator.start()

        thread = threading.Thread(target=replug)
        thread.start()
        with caplog.at_level(logging.WARNING):
            while (frame := source.read(timeout=15.0)).frames_dropped == 0:
                before.append(frame)
        thread.join()
        after = [frame]
        after += [source.read(timeout=5.0) for _ in range(20)]
        status = source.status
        source.stop()
    frames = before + after
    assert status.reconnects == 1
    assert "lost" in caplog.text
    assert "is back" in caplog.text
    assert status.delivered + status.lost == frames[-1].frame_counter + 1
    # The emulator's clock is the host's and so runs on while it is dead.
    outage = (after[0].device_time_ns - before[-1].device_time_ns) * 1e-9
    assert after[0].frames_dropped == pytest.approx(outage * RATE - 1, abs=2)
    assert (np.diff([frame.stamp_ns for frame in frames]) > 0).all()


def test_software_triggers_are_answered_one_to_one(wire):
    with GigeEmulator() as emulator:
        source = open_camera(emulator, trigger="software", frame_rate=10.0)
        source.start()
        frames = [source.read(timeout=5.0) for _ in range(30)]
        status = source.status
        source.stop()
    assert [frame.cycle for frame in frames] == list(range(30))
    assert status.lost == 0
    assert 30 <= wire.produced <= 33  # the last triggers may not have been answered yet
    # The emulator looks for triggers 25 times a second.
    assert frames[-1].device_time_ns - frames[0].device_time_ns == pytest.approx(29 * 0.1e9, abs=0.1e9)


def test_settings_reach_the_camera_or_are_refused():
    with GigeEmulator() as emulator:
        source = open_camera(
            emulator, exposure=0.0042, gain=3.0, region=(8, 16, 320, 240), features=["TestRegister=7"]
        )
        source.start()
        frame = source.read(timeout=5.0)
        features = source._device._device
        assert frame.exposure_s == pytest.approx(0.0042, abs=1e-6)
        assert frame.image.shape == (240, 320)
        assert [
            features.get_integer_feature_value(n) for n in ("OffsetX", "OffsetY", "GainRaw", "TestRegister")
        ] == [8, 16, 3, 7]
        source.adjust(exposure=0.0021, gain=5.0)
        assert source.read(timeout=5.0).exposure_s == pytest.approx(0.0021, abs=1e-6)
        assert (features.get_float_feature_value("ExposureTimeAbs"), source.status.gain) == (2100, 5)
        with pytest.raises(InputError, match=r"exposure: found 100; expected 1e-05 to 10"):
            source.adjust(exposure=100.0)
        source.stop()
        for options, complaint in (
            ({"exposure": 100.0}, r"exposure: found 100; expected 1e-05 to 10"),
            ({"region": (0, 0, 4096, 8)}, "region: found Width 4096; expected 1 to 2048 px"),
            ({"pixel_format": "Mono12p"}, "pixel_format: found 'Mono12p'; expected one of the camera's"),
            ({"trigger": "Line7"}, "trigger: found 'Line7'; expected one of the camera's Line0, Software"),
            ({"features": ["Shutter=1"]}, "features: found Shutter"),
            ({"device": "nobody"}, "device: found Aravis-Fake-EMULATED; expected 'nobody'"),
        ):
            with pytest.raises(InputError, match=complaint):
                open_camera(emulator, **options)


def test_no_camera_is_an_error_of_one_line():
    with pytest.raises(Mems6dofError) as failure:
        open_source("genicam", device="nobody")
    assert "\n" not in str(failure.value)
    assert not isinstance(failure.value, DriverMissingError)
