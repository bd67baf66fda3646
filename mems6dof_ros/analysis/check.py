"""Is a recording whole? Every message decoded, every frame accounted for, every stamp in order."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mems6dof_ros.recording import messages
from mems6dof_ros.recording.bag import BagReader

_FRAME_INFO = "mems6dof_msgs/msg/FrameInfo"
#: What a frame gives rise to: each of these should be there once for each frame (poses: once for each body).
_OF_A_FRAME = ("sensor_msgs/msg/Image", "mems6dof_msgs/msg/Localizations", "mems6dof_msgs/msg/Pose6DOF")


@dataclass
class Check:
    """``topics``: type and number of messages decoded; ``problems``: what is not as it should be."""

    topics: dict[str, tuple[str, int]] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)


@dataclass
class _Topic:
    """What is remembered of the messages of one topic."""

    kind: str
    count: int = 0
    stamps: Counter[int] = field(default_factory=Counter)
    last: int = 0
    backwards: int = 0
    infos: list[tuple[int, int]] = field(default_factory=list)  # frame counter, frames dropped

    def note(self, message: Any) -> None:
        self.count += 1
        time = getattr(getattr(message, "header", None), "stamp", None)
        if not hasattr(time, "sec") or not hasattr(time, "nanosec"):
            return
        stamp = messages.nanoseconds(time)
        self.stamps[stamp] += 1
        self.backwards += stamp < self.last
        self.last = stamp
        if self.kind == _FRAME_INFO:
            self.infos.append((int(message.frame_counter), int(message.frames_dropped)))


def check_bag(path: str | Path) -> Check:
    """Read a bag to its end and say what is wrong with it; InputError where it cannot be read at all."""
    seen: dict[str, _Topic] = {}
    result = Check()
    with BagReader(path) as bag:
        announced = bag.counts
        for recorded in bag.messages():
            seen.setdefault(recorded.topic, _Topic(recorded.type)).note(recorded.message)
        for topic, kind in bag.topics.items():
            count = seen[topic].count if topic in seen else 0
            result.topics[topic] = (kind, count)
            if count != announced[topic]:
                result.problems.append(f"{topic}: {announced[topic]} messages announced, {count} found")
        for file in bag.unlisted:
            result.problems.append(f"{file}: not in metadata.yaml; 'mems6dof recover' writes it anew")
    if not seen:
        result.problems.append("no messages")
    for name, found in seen.items():
        if found.backwards and found.kind in (_FRAME_INFO, *_OF_A_FRAME):
            result.problems.append(f"{name}: {found.backwards} stamps earlier than the one before")
        if found.kind == _FRAME_INFO:
            result.problems += _frame_problems(name, found, seen)
    return result


def _frame_problems(name: str, frames: _Topic, seen: dict[str, _Topic]) -> list[str]:
    """Frames that are neither recorded nor reported lost, and frames without what should come of them."""
    problems = []
    unaccounted = 0
    for (before, _), (counter, dropped) in zip(frames.infos, frames.infos[1:], strict=False):
        unaccounted += abs(counter - before - 1 - dropped)
    if unaccounted:
        problems.append(f"{name}: {unaccounted} frames neither recorded nor reported lost")
    if repeated := sum(count - 1 for count in frames.stamps.values()):
        problems.append(f"{name}: {repeated} frames with the stamp of another")
    for other, topic in seen.items():
        if topic.kind in _OF_A_FRAME and _frame_info_of(other, seen) == name:
            missing = len(frames.stamps.keys() - topic.stamps.keys())
            foreign = len(topic.stamps.keys() - frames.stamps.keys())
            if missing:
                problems.append(f"{other}: missing for {missing} of {len(frames.stamps)} frames")
            if foreign:
                problems.append(f"{other}: {foreign} messages of frames that {name} does not know")
    return problems


def _frame_info_of(topic: str, seen: dict[str, _Topic]) -> str | None:
    """The FrameInfo nearest above ``topic``: in its namespace or, of a further body, in the one around it."""
    infos = {name.rsplit("/", 1)[0]: name for name, found in seen.items() if found.kind == _FRAME_INFO}
    namespace = topic
    while "/" in namespace:
        namespace = namespace.rsplit("/", 1)[0]
        if namespace in infos:
            return infos[namespace]
    return None
