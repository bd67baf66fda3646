"""What CameraSource makes of a device that follows a script: counts, stamps, triggers, loss and return."""

from __future__ import annotations

import contextlib
import logging
import time
from dataclasses import replace

import numpy as np
import pytest

from mems6dof_ros.errors import InputError, Mems6dofError
from mems6dof_ros.sources.cameras import camera as camera_module
from mems6dof_ros.sources.cameras.camera import CameraSource
from mems6dof_ros.sources.cameras.device import CameraLostError, DeviceState, RawFrame
from mems6dof_ros.sources.cameras.settings import CameraSettings, parse_settings

PERIOD_NS = 20_000_000


class ScriptedDevice:
    """Gives what the script holds: counters, None for silence, "incomplete" with a counter, or an exception.

    Its clock started 1000 s ago and ticks with the counter; every frame arrives 3 ms after its exposure.
    """

    def __init__(self, script, settings=None):
        self.script, self.started, self.closed, self.triggers = list(script), False, False, 0
        self.began = time.time_ns()
        self.state = DeviceState("scripted", 4, 2, "Mono16", 65535, exposure=0.002, frame_rate=50.0)

    def start(self):
        self.started = True

    def grab(self, timeout):
        entry = self.script.pop(0) if self.script else None
        if entry is None:
            time.sleep(min(timeout, 0.01))
            return None
        if isinstance(entry, Exception):
            raise entry
        complete = not isinstance(entry, tuple)
        count = entry if complete else entry[1]
        device_time = 10**12 + count * PERIOD_NS
        data = np.full(8, count, np.uint16).tobytes() if complete else None
        return RawFrame(data, count, device_time, self.began + count * PERIOD_NS + 2_000_000 + 3_000_000)

    def trigger(self):
        self.triggers += 1

    def is_alive(self):
        return True

    def close(self):
        self.closed = True


def source_of(*scripts, **options):
    """A source whose n-th opening gets the n-th script; an exception in place of a script refuses."""
    scripts, devices = list(scripts), []

    def open_device(settings):
        script = scripts.pop(0)
        if isinstance(script, Exception):
            raise script
        devices.append(ScriptedDevice(script))
        return devices[-1]

    source = CameraSource("genicam", parse_settings(options), open_device)
    source.start()
    return source, devices


def read(source, count):
    return [source.read(timeout=5.0) for _ in range(count)]


def test_gaps_incomplete_and_late_frames_are_lost_once():
    script = [65533, ("incomplete", 65534), 65535, 3, ("incomplete", 2), 4]
    source, _ = source_of(script)
    frames = read(source, 4)
    assert [frame.frames_dropped for frame in frames] == [0, 1, 2, 0]
    assert [frame.frame_counter for frame in frames] == [0, 2, 5, 6]
    assert [frame.cycle for frame in frames] == [0, 2, 5, 6]
    status = source.status
    assert (status.delivered, status.lost, status.incomplete) == (4, 3, 2)
    assert status.delivered + status.lost == frames[-1].frame_counter + 1
    assert frames[0].image.shape == (2, 4)
    assert frames[1].image[0, 0] == 65535


@pytest.mark.parametrize(("timestamp_at", "later_ns"), [("start", 2_000_000), ("end", 0)])
def test_stamp_is_mid_exposure_and_its_error_the_latency(timestamp_at, later_ns):
    """The exposure ended 3 ms before the arrival; only a measured latency can tell."""
    source, devices = source_of(range(1, 60), timestamp_at=timestamp_at)
    frames = read(source, 50)
    stamps = np.array([frame.stamp_ns for frame in frames])
    arrivals = devices[0].began + np.arange(1, 51) * PERIOD_NS + 5_000_000
    assert np.ptp(arrivals - stamps) < 100_000  # the epoch of the monotonic clock is read with some jitter
    assert np.median(arrivals - stamps) == pytest.approx(1_000_000, abs=100_000)
    # Unknown latency, uniform within the period of 20 ms.
    assert source.status.stamp_uncertainty == pytest.approx(0.02 / np.sqrt(3), rel=0.02)

    source, devices = source_of(range(1, 60), timestamp_at=timestamp_at, latency=0.003)
    frame = read(source, 50)[-1]
    assert frame.stamp_ns == pytest.approx(devices[0].began + 50 * PERIOD_NS + 1_000_000, abs=100_000)
    assert source.status.stamp_uncertainty < 1e-4


def test_stamps_ascend_when_the_clock_is_corrected_backwards():
    class LateStart(ScriptedDevice):
        def grab(self, timeout):
            raw = super().grab(timeout)
            return raw and replace(raw, arrival_ns=raw.arrival_ns + (90_000_000 if raw.counter == 1 else 0))

    source = CameraSource("genicam", CameraSettings(), lambda settings: LateStart(range(1, 20)))
    source.start()
    stamps = [frame.stamp_ns for frame in read(source, 19)]
    assert np.all(np.diff(stamps) > 0)


def test_comes_back_and_counts_the_outage(caplog):
    """The camera begins its counter and clock anew and comes back at the third attempt."""
    source, devices = source_of(
        [*range(1, 11), CameraLostError("cable")],
        Mems6dofError("not there"),
        Mems6dofError("not there"),
        range(1, 5),
    )
    before = read(source, 10)
    with caplog.at_level(logging.WARNING):
        frame = source.read(timeout=5.0)
    gap = (frame.stamp_ns - before[-1].stamp_ns) / PERIOD_NS
    assert frame.frames_dropped == round(gap) - 1 > 0
    assert frame.frame_counter == before[-1].frame_counter + frame.frames_dropped + 1
    assert frame.stamp_ns > before[-1].stamp_ns
    assert source.read().frames_dropped == 0
    assert devices[0].closed
    assert source.status.reconnects == 1
    assert "lost: cable" in caplog.text
    assert "is back" in caplog.text
    assert f"{frame.frames_dropped} frames missed" in caplog.text


def test_a_silent_camera_times_out_and_is_reopened(monkeypatch):
    monkeypatch.setattr(camera_module, "_PATIENCE", 0.05)
    source, devices = source_of([1, 2], [1])
    read(source, 2)
    with pytest.raises(TimeoutError, match=r"no frame within 0\.1 s"):
        source.read(timeout=0.1)
    assert source.read(timeout=5.0).frame_counter > 1
    assert len(devices) == 2


def test_another_camera_in_its_place_is_refused():
    class Smaller(ScriptedDevice):
        def __init__(self, script):
            super().__init__(script)
            self.state = replace(self.state, width=2)

    devices = iter([ScriptedDevice([1, CameraLostError("cable")]), Smaller([1]), ScriptedDevice([1])])
    source = CameraSource("genicam", CameraSettings(), lambda settings: next(devices))
    source.start()
    frames = read(source, 2)
    assert frames[1].image.shape == (2, 4)


class TriggeredDevice(ScriptedDevice):
    """Answers every trigger but those that it ignores."""

    def __init__(self, ignored):
        super().__init__([])
        self.ignored, self.exposed = ignored, 0

    def trigger(self):
        self.triggers += 1
        if self.triggers not in self.ignored:
            self.exposed += 1
            self.script.append(self.exposed)


def test_every_software_trigger_is_answered_or_lost(monkeypatch):
    """Of 40 triggers the camera ignores seven: one early, one in a row of five, one more."""
    monkeypatch.setattr(camera_module, "_PATIENCE", 0.05)
    device = TriggeredDevice({1, 10, 11, 12, 13, 14, 30})
    source = CameraSource(
        "genicam", parse_settings({"trigger": "software", "frame_rate": 200.0}), lambda _: device
    )
    source.start()
    frames = []
    while device.triggers < 40:
        frames.append(source.read(timeout=5.0))
    source._settings = replace(source._settings, frame_rate=float("nan"))  # no further triggers
    with contextlib.suppress(TimeoutError):
        while True:
            frames.append(source.read(timeout=0.5))
    status = source.status
    assert status.delivered == len(frames) == 33
    assert status.delivered + status.lost + status.pending == 40
    assert frames[0].frames_dropped == 1
    assert frames[-1].frame_counter == status.delivered + status.lost - 1


def test_trigger_by_hand():
    source, devices = source_of([1], trigger="software")
    source.trigger()
    assert source.read(timeout=1.0).frames_dropped == 0
    assert devices[0].triggers == 1
    source, _ = source_of([1])
    with pytest.raises(InputError, match="expected trigger: software"):
        source.trigger()


def test_start_begins_again_and_stop_ends():
    source, devices = source_of([5, 6], [5, 6])
    assert [frame.frame_counter for frame in read(source, 2)] == [0, 1]
    source.start()
    assert devices[0].closed
    assert [frame.frame_counter for frame in read(source, 2)] == [0, 1]
    source.stop()
    source.stop()
    assert source.read() is None


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        ({"exposure": -1.0}, "exposure: found -1"),
        ({"exposure": "long"}, "exposure: found 'long'"),
        ({"exposure": True}, "exposure: found True"),
        ({"frame_rate": 0}, "frame_rate: found 0"),
        ({"region": [0, 0, 10]}, "region: found .*expected x, y, width, height"),
        ({"region": [0, 0, 10.5, 3]}, "region"),
        ({"pixel_format": "BayerRG8"}, "pixel_format: found 'BayerRG8'"),
        ({"timestamp_at": "middle"}, "timestamp_at"),
        ({"buffers": 1}, "buffers"),
        ({"features": ["BlackLevel"]}, "features: found 'BlackLevel'; expected Name=value"),
        ({"shutter": 1}, "option 'shutter'"),
    ],
)
def test_settings_are_refused_with_their_reason(options, complaint):
    with pytest.raises(InputError, match=complaint):
        parse_settings(options)


def test_a_frame_of_the_wrong_size_is_refused_and_lost():
    source, _ = source_of([1, 2, 3])
    device = source._device
    grab = device.grab

    def cut_the_second(timeout):
        raw = grab(timeout)
        return replace(raw, data=raw.data[:-1]) if raw and raw.counter == 2 else raw

    device.grab = cut_the_second
    assert source.read().frame_counter == 0
    with pytest.raises(InputError, match="camera frame: found 15 bytes; expected 16 for 4 x 2 Mono16"):
        source.read()
    frame = source.read()
    assert (frame.frame_counter, frame.frames_dropped) == (2, 1)


class AdjustableDevice(ScriptedDevice):
    def adjust(self, exposure, gain):
        if exposure > 0.01:
            raise InputError("exposure", f"{exposure:g}", "0.0001 to 0.01")
        known = {name: value for name, value in (("exposure", exposure), ("gain", gain)) if value == value}
        self.state = replace(self.state, **known)


def test_exposure_and_gain_change_while_it_runs_and_outlive_an_outage():
    opened = []

    def open_device(settings):
        opened.append(settings)
        return AdjustableDevice([1, 2, CameraLostError("cable")] if len(opened) == 1 else range(1, 9))

    source = CameraSource("genicam", parse_settings({"gain": 3.0}), open_device)
    source.start()
    assert source.read().exposure_s == 0.002
    source.adjust(exposure=0.005)
    frame = source.read()
    assert frame.exposure_s == source.status.exposure == 0.005
    with pytest.raises(InputError, match=r"exposure: found 0\.05; expected 0\.0001 to 0\.01"):
        source.adjust(exposure=0.05)
    with pytest.raises(InputError, match="exposure: found -1"):
        source.adjust(exposure=-1.0)
    source.adjust(gain=6.0)
    assert source.status.gain == 6.0
    source.read(timeout=5.0)  # of the second opening
    assert (opened[1].exposure, opened[1].gain, opened[1].device) == (0.005, 6.0, "scripted")


def test_nothing_is_asked_of_a_camera_that_is_away():
    source, _ = source_of([CameraLostError("cable")], Mems6dofError("gone"), trigger="software")
    with pytest.raises(TimeoutError):
        source.read(timeout=0.01)
    assert not source.status.connected
    with pytest.raises(CameraLostError, match="camera scripted is not there"):
        source.trigger()
    with pytest.raises(CameraLostError, match="camera scripted is not there"):
        source.adjust(gain=1.0)
