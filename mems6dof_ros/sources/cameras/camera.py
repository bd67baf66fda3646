"""The frame source over any camera driver: stamps, counts, triggers, and coming back after a loss."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from statistics import median

from mems6dof_ros.errors import InputError, Mems6dofError
from mems6dof_ros.frame import NAN, Frame
from mems6dof_ros.sources.cameras.clock import DeviceClock
from mems6dof_ros.sources.cameras.counter import FrameCounter
from mems6dof_ros.sources.cameras.device import CameraDevice, CameraLostError, DeviceState, RawFrame
from mems6dof_ros.sources.cameras.pixels import decode, encoding
from mems6dof_ros.sources.cameras.settings import CameraSettings
from mems6dof_ros.sources.source import SourceInfo

logger = logging.getLogger(__name__)

#: s; silence after which a camera is asked whether it is there, and pause between attempts to reopen it.
_PATIENCE, _RETRY = 1.0, 0.5

#: Software triggers that may wait for their frames: exposure and transfer overlap.
_TRIGGERS_AHEAD = 3


@dataclass(frozen=True)
class CameraStatus:
    """Health of a live camera, for diagnostics; may be asked for from any thread.

    ``delivered``, ``lost``: frames since start; every frame that the device is known to have produced is in
    one of them, or among the ``pending``: noticed as missing but not yet reported with a frame.
    ``incomplete``: frames of which packets were missing (they count as lost). ``reconnects``: times that the
    camera came back. ``clock_drift``: host's clock against the device's, minus 1. ``stamp_uncertainty`` s,
    standard uncertainty of Frame.stamp_ns, NaN: not known yet. ``exposure`` s and ``gain`` as the camera has
    them, NaN: it does not tell.
    """

    name: str
    connected: bool
    delivered: int
    lost: int
    pending: int
    incomplete: int
    reconnects: int
    clock_drift: float
    stamp_uncertainty: float
    exposure: float
    gain: float


class CameraSource:
    """FrameSource of a live camera behind ``open_device``.

    Each frame is one motion cycle. A frame that is lost on the way advances ``frame_counter`` and ``cycle``
    and is counted in ``frames_dropped`` of the next. The camera is opened at once; where it is lost later it
    is reopened for as long as ``read`` is called, and frames missed meanwhile are counted by the time
    between the stamps, for nobody else knows them.
    """

    def __init__(
        self, kind: str, settings: CameraSettings, open_device: Callable[[CameraSettings], CameraDevice]
    ) -> None:
        self._kind, self._settings, self._open = kind, settings, open_device
        self._control = threading.RLock()  # of what is asked of the device and of what it owes
        self._device: CameraDevice | None = open_device(settings)
        self._state = self._device.state
        self._running = False
        self._reset()

    @property
    def info(self) -> SourceInfo:
        state = self._state
        return SourceInfo(
            self._kind, state.width, state.height, encoding(state.pixel_format), self._settings.pixel_size
        )

    @property
    def status(self) -> CameraStatus:
        return CameraStatus(
            name=self._state.name,
            connected=self._device is not None,
            delivered=self._delivered,
            lost=self._lost,
            pending=self._written_off + self._incomplete_since,
            incomplete=self._incomplete,
            reconnects=self._reconnects,
            clock_drift=self._clock.drift,
            stamp_uncertainty=self._stamp_uncertainty(),
            exposure=self._state.exposure,
            gain=self._state.gain,
        )

    def start(self) -> None:
        self.stop()
        self._device = self._device or self._open(self._settings)
        self._reset()
        self._device.start()
        self._running = True

    def stop(self) -> None:
        with self._control:
            if self._running and self._device is not None:
                self._device.close()
                self._device = None
            self._running = False

    def trigger(self) -> None:
        """Expose one frame now (trigger: software); from any thread. CameraLostError while it is away."""
        if self._settings.trigger != "software":
            raise InputError("trigger()", f"trigger: {self._settings.trigger}", "trigger: software")
        with self._control:
            self._here().trigger()
            self._unanswered += 1

    def adjust(self, *, exposure: float = NAN, gain: float = NAN) -> None:
        """Change the exposure, s, or the gain while it runs; from any thread. Frames state the new exposure
        from now on, though a few may have been exposed before. InputError where the camera refuses,
        CameraLostError while it is away."""
        changes = {name: value for name, value in (("exposure", exposure), ("gain", gain)) if value == value}
        with self._control:
            settings: CameraSettings = replace(self._settings, **changes)  # type: ignore[arg-type]
            device = self._here()
            device.adjust(exposure, gain)
            self._settings, self._state = settings, device.state

    def _here(self) -> CameraDevice:
        if self._device is None:
            raise CameraLostError(f"camera {self._state.name} is not there")
        return self._device

    def read(self, timeout: float | None = None) -> Frame | None:
        deadline = math.inf if timeout is None else time.monotonic() + timeout
        while self._running:
            try:
                if (device := self._device) is None:
                    self._reopen(deadline)
                else:
                    raw = device.grab(self._fire_and_wait(deadline))
                    with self._control:
                        if raw is None:
                            self._check_silence()
                        elif (frame := self._accept(raw)) is not None:
                            return frame
            except CameraLostError as error:
                self._lose(error)
            if time.monotonic() >= deadline:
                raise TimeoutError(f"camera {self._state.name}: no frame within {timeout:g} s")
        return None

    def _reset(self) -> None:
        self._delivered = self._lost = self._incomplete = self._reconnects = 0
        self._count, self._last_stamp_ns = -1, 0
        self._lost_at: float | None = None
        self._recent: deque[tuple[int, int]] = deque(maxlen=32)  # count and time, ns
        self._expect_new_device()

    def _expect_new_device(self) -> None:
        """Its counter and clock begin anew, and what was asked of the old one is void."""
        self._counter, self._clock, self._has_clock = FrameCounter(), DeviceClock(), False
        self._unanswered = self._written_off = self._incomplete_since = 0
        self._answers = False
        self._next_trigger = 0.0
        self._quiet_since: float | None = None
        self._check_at = 0.0

    # Triggers

    def _fire_and_wait(self, deadline: float) -> float:
        """Fire the software trigger that is due; how long to wait for a frame, s."""
        now = time.monotonic()
        wait = min(max(deadline - now, 0.0), _PATIENCE)
        period = 1 / self._settings.frame_rate
        if self._settings.trigger == "software" and period > 0:
            # One at a time at first, so that it is known which trigger the first frame answers.
            if self._unanswered < (_TRIGGERS_AHEAD if self._answers else 1) and now >= self._next_trigger:
                self.trigger()
                on_time = now - self._next_trigger < period
                self._next_trigger = (self._next_trigger if on_time else now) + period
            wait = min(wait, max(self._next_trigger - now, 1e-3))
        return wait

    # Frames

    def _accept(self, raw: RawFrame) -> Frame | None:
        """The frame of ``raw``; None where it is incomplete or late: the next gap of the counter tells."""
        self._quiet_since = None
        if raw.data is None:
            self._incomplete += 1
            self._incomplete_since += 1
            return None
        state = self._state
        image = decode(raw.data, state.pixel_format, state.width, state.height)
        advance = 1 if raw.counter is None else self._counter.advance(raw.counter)
        if advance == 0:
            return None
        stamp_ns = max(self._stamp(raw), self._last_stamp_ns + 1)
        if self._lost_at is not None:
            advance = self._come_back(stamp_ns)
        elif self._settings.trigger == "software":
            advance = max(advance, 1 + self._written_off)
        self._unanswered = max(self._unanswered + self._written_off - advance, 0)
        self._written_off, self._incomplete_since, self._answers = 0, 0, True
        self._delivered += 1
        self._lost += advance - 1
        self._count += advance
        self._last_stamp_ns = stamp_ns
        self._recent.append((self._count, raw.device_time_ns or stamp_ns))
        return Frame(
            image=image,
            stamp_ns=stamp_ns,
            frame_counter=self._count,
            cycle=self._count,
            frames_dropped=advance - 1,
            device_time_ns=raw.device_time_ns,
            exposure_s=state.exposure,
            pixel_size=self._settings.pixel_size,
            saturation_adu=state.saturation_adu,
            source=self._kind,
            live=True,
        )

    def _stamp(self, raw: RawFrame) -> int:
        """Middle of the exposure, ns since the Unix epoch.

        The clock is fitted to the ends of exposures, before which no frame arrives, on the host's monotonic
        clock: the system's may be set meanwhile.
        """
        exposure = _nanoseconds(self._state.exposure)
        epoch = time.time_ns() - time.monotonic_ns()
        end = raw.arrival_ns - epoch - _nanoseconds(self._settings.latency)
        self._has_clock = raw.device_time_ns != 0
        if self._has_clock:
            device_end = raw.device_time_ns + (exposure if self._settings.timestamp_at == "start" else 0)
            self._clock.add(device_end, end)
            end = self._clock.to_host(device_end)
        return end + epoch - exposure // 2

    def _stamp_uncertainty(self) -> float:
        """Scatter of the clock's line, and the delay that all share: below a period, unless measured."""
        scatter = self._clock.uncertainty if self._has_clock else 0.0
        if not math.isnan(self._settings.latency):
            return scatter if self._has_clock else NAN
        return math.hypot(scatter, self._period() / math.sqrt(3))

    def _period(self) -> float:
        """Of the last frames, s; as set where there are none."""
        if len(self._recent) < 2:
            return 1 / self._state.frame_rate
        return 1e-9 * median((t1 - t0) / (n1 - n0) for (n0, t0), (n1, t1) in pairwise(tuple(self._recent)))

    # Losing the camera and coming back

    def _check_silence(self) -> None:
        """Called when no frame waits: after a while, find out whether any can be expected."""
        now = time.monotonic()
        if self._quiet_since is None:
            self._quiet_since = self._check_at = now
        quiet = now - self._quiet_since
        usual = (1 / self._state.frame_rate, self._state.exposure)
        patience = max(_PATIENCE, *(5 * t for t in usual if t > 0))
        if now - self._check_at < patience:
            return
        self._check_at = now
        self._written_off += self._unanswered
        self._unanswered = 0
        if not self._here().is_alive():
            raise CameraLostError("it does not answer")
        if not self._settings.triggered and quiet > 5 * patience:
            raise CameraLostError(f"no frame for {quiet:.0f} s")

    def _lose(self, error: CameraLostError) -> None:
        logger.warning("camera %s lost: %s; trying to reopen it", self._state.name, error)
        with self._control:
            if self._device is not None:
                self._device.close()
                self._device = None
            self._lost_at = self._lost_at or time.monotonic()
            self._expect_new_device()

    def _reopen(self, deadline: float) -> None:
        try:
            device = self._open(replace(self._settings, device=self._state.name))
        except Mems6dofError as error:
            logger.debug("camera %s: %s", self._state.name, error)
            time.sleep(min(max(deadline - time.monotonic(), 0.0), _RETRY))
            return
        with self._control:
            self._device, before, now = device, self._state, device.state
            if _kind_of_image(now) != _kind_of_image(before):
                raise CameraLostError(f"reopened with {now.width} x {now.height} px of {now.pixel_format}")
            self._state = now
            device.start()

    def _come_back(self, stamp_ns: int) -> int:
        """Frames that the time since the last one would have held, this one included."""
        outage, self._lost_at = time.monotonic() - (self._lost_at or 0.0), None
        gap = (stamp_ns - self._last_stamp_ns) * 1e-9 / self._period()
        advance = max(round(gap), 1) if self._delivered and not math.isnan(gap) else 1
        self._reconnects += 1
        self._recent.clear()
        logger.warning(
            "camera %s is back after %.1f s; %d frames missed, by the time between the stamps",
            self._state.name,
            outage,
            advance - 1,
        )
        return advance


def _kind_of_image(state: DeviceState) -> tuple[int, int, str]:
    return state.width, state.height, state.pixel_format


def _nanoseconds(seconds: float) -> int:
    return 0 if math.isnan(seconds) else round(seconds * 1e9)
