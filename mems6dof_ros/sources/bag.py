"""Frames from a recorded bag, ours or anybody's."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from mems6dof_ros.errors import InputError
from mems6dof_ros.frame import Frame
from mems6dof_ros.recording import messages, topics
from mems6dof_ros.recording.bag import BagReader
from mems6dof_ros.recording.frames import CAMERA, camera_from_json
from mems6dof_ros.sources.source import SourceInfo

IMAGE = "sensor_msgs/msg/Image"

#: A frame is complete when this many younger stamps have been seen: its parts travel on topics of
#: their own, and a recorder may note them in any order.
_LOOK_AHEAD = 3


class BagSource:
    """Frames of a rosbag2 directory (MCAP or sqlite3) or a single .mcap file, with their original stamps.

    ``topic``: the sensor_msgs/Image to read; empty: the only one, or the only one named image_raw.
    ``frame_info`` and ``truth`` are taken from beside it; without frame_info, as in other
    people's bags, frames and motion cycles are counted from 0, one cycle per frame. ``threads`` read and
    decompress ahead, from the next ``start`` on.
    """

    threads = 1

    def __init__(self, path: str | Path, *, topic: str = "") -> None:
        self._path = Path(path)
        with contextlib.ExitStack() as opened:
            bag = opened.enter_context(BagReader(self._path))
            self._topic = topic or _only_image_topic(bag)
            if bag.topics.get(self._topic) != IMAGE:
                raise InputError(str(path), f"no images on topic '{self._topic}'", _choices(bag))
            self._count = bag.counts[self._topic]
            stated = bag.provenance().get(CAMERA)
            namespace = self._topic.rsplit("/", 1)[0]
            self._info_topic, self._truth_topic = (
                f"{namespace}/{topics.FRAME_INFO}",
                f"{namespace}/{topics.TRUTH}",
            )
            self._iterator, self._read = self._parts(bag), 0
            first = self.read()
            self.stop()
            if first is None:
                raise InputError(str(path), f"no message on '{self._topic}'", "at least one image")
            opened.pop_all()
        self._bag: BagReader | None = bag  # open, for the next who reads: to open one takes 0.1 s
        height, width = first.image.shape
        camera = camera_from_json(stated) if stated else None
        self._info = SourceInfo("bag", width, height, first.encoding, first.pixel_size, self._count, camera)

    @property
    def info(self) -> SourceInfo:
        return self._info

    def start(self) -> None:
        self._iterator, self._read = self._opened(), 0

    def read(self, timeout: float | None = None) -> Frame | None:
        parts = next((parts for parts in self._iterator if "image" in parts), None)
        if parts is None:
            return None
        counter, self._read = self._read, self._read + 1
        truth = tuple(messages.to_ground_truth(message) for message in parts.get("truth", ()))
        frame = messages.to_frame(parts["image"], parts.get("info"), truth)
        if "info" not in parts:
            frame = replace(frame, frame_counter=counter, cycle=counter)
        return replace(frame, source="bag", live=False)

    def stop(self) -> None:
        self._iterator = iter(())

    def _opened(self) -> Iterator[dict[str, Any]]:
        bag, self._bag = self._bag, None
        with bag or BagReader(self._path) as bag:
            yield from self._parts(bag)

    def _parts(self, bag: BagReader) -> Iterator[dict[str, Any]]:
        """Messages of one stamp belong together."""
        pending: dict[int, dict[str, Any]] = {}
        wanted = self._topic, self._info_topic, self._truth_topic
        for recorded in bag.messages(wanted, self.threads):
            stamp = messages.nanoseconds(recorded.message.header.stamp)
            if recorded.topic == self._topic and "image" in pending.get(stamp, {}):
                yield pending.pop(stamp)  # a stamp that repeats (unset?) tells nothing apart
            parts = pending.setdefault(stamp, {})
            if recorded.topic == self._topic:
                parts["image"] = recorded.message
            elif recorded.topic == self._info_topic:
                parts["info"] = recorded.message
            else:
                parts.setdefault("truth", []).append(recorded.message)
            if len(pending) > _LOOK_AHEAD:
                yield pending.pop(next(iter(pending)))
        yield from pending.values()


def _only_image_topic(bag: BagReader) -> str:
    images = [topic for topic, kind in bag.topics.items() if kind == IMAGE]
    raw = [topic for topic in images if topic.endswith("/image_raw")]
    for candidates in (images, raw):
        if len(candidates) == 1:
            return candidates[0]
    found = f"{len(images)} topics with images" if images else "no images"
    raise InputError(str(bag.path), found, _choices(bag) if images else "a sensor_msgs/Image topic")


def _choices(bag: BagReader) -> str:
    images = [topic for topic, kind in bag.topics.items() if kind == IMAGE]
    return f"topic to be one of {', '.join(sorted(images))}" if images else "a sensor_msgs/Image topic"
