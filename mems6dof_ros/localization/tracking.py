"""Localization without detection: windows where the body's motion will have carried its particles.

Everything localized is remembered in the frame of the body, flagged or not: a disturbed neighbour must stay
known, and a particle that leaves the field comes back. The motion of the last cycles, continued, tells
where to fit. A Gaussian fit follows its particle, so that the result does not depend on the start. Whole
frames are searched now and then for newcomers, after their result is out, and whenever too few particles
are found.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mems6dof_ros.errors import InputError
from mems6dof_ros.frame import Frame
from mems6dof_ros.localization.detection import detect
from mems6dof_ros.localization.localizations import Flag, Localizations
from mems6dof_ros.localization.localizer import Localizer
from mems6dof_ros.localization.neighbours import nearest

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: Localizations this close in the frame of the body are one particle, m.
_SAME = 0.5e-6
#: A particle this close to the edge of the field may be cut off, m.
_EDGE = 3e-6
#: Times in a row that a particle may be missing where it should be seen.
_MISSES = 2
#: Farthest that a motion is continued, cycles, and what it may then turn: its error grows with both.
_MOST_CYCLES, _MOST_TURN = 4, math.radians(30)


@dataclass(frozen=True)
class TrackingSettings:
    """``detection_period``: every so many frames the whole frame is searched. ``least_found``: fraction of
    the expected good fits below which a frame is searched at once."""

    detection_period: int = 16
    least_found: float = 0.8

    def __post_init__(self) -> None:
        if not self.detection_period >= 1:
            raise InputError("tracking.detection_period", f"{self.detection_period}", "1 frame or more")
        if not 0 < self.least_found <= 1:
            raise InputError("tracking.least_found", f"{self.least_found}", "more than 0, at most 1")


class _Motion(NamedTuple):
    """Body to microscope frame after a cycle: ``transform`` (4, 4) homogeneous, m."""

    cycle: int
    transform: Array


class TrackingLocalizer:
    """A Localizer that is told the poses and needs no detection in most frames; for one body.

    ``localize`` each frame, and ``observe`` the pose of every cycle as it becomes known, in time for the
    next frame or a few later. Without poses every frame is searched. ``search``, when the result of a frame
    is out, looks for newcomers if it is time; otherwise the next ``localize`` begins with it.
    ``detections`` counts searched frames. Not safe for several threads.
    """

    def __init__(self, localizer: Localizer, settings: TrackingSettings | None = None) -> None:
        self.localizer = localizer
        self.settings = settings or TrackingSettings()
        self.detections = 0
        self._found: deque[tuple[Localizations, Array]] = deque(maxlen=2 * _MOST_CYCLES)
        self._since_detection = 0
        self._to_search: Frame | None = None
        self._forget(-1)

    def _forget(self, version: int) -> None:
        self._version = version
        self._motions: deque[_Motion] = deque(maxlen=2)
        self._places, self._misses = np.empty((0, 3)), np.empty(0, np.int64)
        self._trusted = np.empty(0, bool)  # good when last seen
        self._newcomers = -1, np.empty((0, 2))  # cycle, and where they were in the microscope frame, m

    def localize(self, frame: Frame) -> Localizations:
        """As Localizer.localize, errors included."""
        self.search()
        pixel_size = self.localizer.check(frame)
        half_field = np.array(frame.image.shape[::-1]) * pixel_size / 2
        found = self._track(frame, pixel_size, half_field)
        self._since_detection += 1
        if found is None:
            found = self.localizer.localize(frame)
            self.detections += 1
            self._since_detection = 0
        elif self._since_detection >= self.settings.detection_period:
            self._to_search = frame
        self._found.append((found, half_field))
        return found

    def search(self) -> None:
        """Look for newcomers in the last frame, where it is time; they are fitted from the next frame on."""
        frame, self._to_search = self._to_search, None
        if frame is None:
            return
        self.detections += 1
        self._since_detection = 0
        found, half_field = self._found[-1]
        pixel_size = self.localizer.check(frame)
        place = (detect(frame.image, self.localizer.settings.detection) + 0.5) * pixel_size - half_field
        known = found.position[np.isfinite(found.position[:, :2]).all(axis=1), :2]
        place = place[nearest(place, known)[0] > _SAME]
        self._newcomers = frame.cycle, place
        for motion in self._motions:
            self._welcome(motion)

    def _track(self, frame: Frame, pixel_size: float, half_field: Array) -> Localizations | None:
        """Localizations from where known particles should be; None: the frame must be searched."""
        place, trusted = self._expected(frame.cycle, half_field)
        if not trusted.any():
            return None
        found = self.localizer.localize(frame, (place + half_field) / pixel_size - 0.5)
        return found if _good(found).sum() >= self.settings.least_found * trusted.sum() else None

    def observe(self, cycle: int, rotation: Array, translation: Array, version: int = 0) -> None:
        """The body's pose in ``cycle``: ``rotation`` (3, 3), ``translation`` (3,) m, body to microscope
        frame; another ``version`` says that the body frame has been redefined."""
        if version != self._version or (self._motions and cycle <= self._motions[-1].cycle):
            self._forget(version)
        transform = np.eye(4)
        transform[:3, :3], transform[:3, 3] = rotation, translation
        self._motions.append(_Motion(cycle, transform))
        for found, half_field in self._found:
            if found.cycle == cycle:
                self._remember(found, half_field, transform)
        self._welcome(self._motions[-1])

    def _remember(self, found: Localizations, half_field: Array, transform: Array) -> None:
        fitted = (found.flags & np.uint32(Flag.FIT_FAILED)) == 0
        position, good = found.position[fitted], _good(found)[fitted]
        position = np.where(np.isnan(position), transform[2, 3], position)  # z unknown: that of the body
        place = (position - transform[:3, 3]) @ transform[:3, :3]
        seen, fresh = np.empty(0, np.int64), np.ones(len(place), bool)
        if len(self._places) and len(place):
            distance, which = nearest(place, self._places)
            fresh = distance > _SAME
            seen = which[~fresh]
            self._places[seen], self._trusted[seen] = place[~fresh], good[~fresh]
        inside = (np.abs(_moved(self._places, transform)) < half_field).all(axis=1)
        self._misses[inside] += 1
        self._misses[seen] = 0
        stay = self._misses <= _MISSES
        self._places = np.concatenate([self._places[stay], place[fresh]])
        self._trusted = np.concatenate([self._trusted[stay], good[fresh]])
        self._misses = np.concatenate([self._misses[stay], np.zeros(int(fresh.sum()), np.int64)])

    def _welcome(self, motion: _Motion) -> None:
        """Expect the newcomers of the cycle of ``motion`` from now on, at the height of the body."""
        cycle, place = self._newcomers
        if cycle != motion.cycle:
            return
        transform = motion.transform
        position = np.column_stack([place, np.full(len(place), transform[2, 3])])
        self._places = np.concatenate([self._places, (position - transform[:3, 3]) @ transform[:3, :3]])
        self._trusted = np.concatenate([self._trusted, np.zeros(len(place), bool)])
        self._misses = np.concatenate([self._misses, np.zeros(len(place), np.int64)])
        self._newcomers = -1, np.empty((0, 2))

    def _expected(self, cycle: int, half_field: Array) -> tuple[Array, Mask]:
        """Where particles should be in ``cycle``, (n, 2) m, and which should give good fits, (n,); none where
        the motion cannot be continued."""
        nothing = np.empty((0, 2)), np.empty(0, bool)
        if len(self._motions) < 2:
            return nothing
        before, last = self._motions
        steps, rest = divmod(cycle - last.cycle, last.cycle - before.cycle)
        step = last.transform @ np.linalg.inv(before.transform)
        turn = abs(math.atan2(step[1, 0], step[0, 0])) * steps
        if rest or not 1 <= steps <= _MOST_CYCLES or turn > _MOST_TURN:
            return nothing
        place = _moved(self._places, np.linalg.matrix_power(step, steps) @ last.transform)
        inside = (np.abs(place) < half_field).all(axis=1)
        uncut = (np.abs(place) < half_field - _EDGE).all(axis=1)
        return place[inside], (self._trusted & uncut)[inside]


def _good(found: Localizations) -> Mask:
    return np.asarray((found.flags & np.uint32(Flag.FIT_FAILED | Flag.POOR_FIT)) == 0)


def _moved(place: Array, transform: Array) -> Array:
    """x and y (n, 2) m in the microscope frame of ``place`` (n, 3) m in that of the body."""
    return np.asarray(place @ transform[:2, :3].T + transform[:2, 3])
