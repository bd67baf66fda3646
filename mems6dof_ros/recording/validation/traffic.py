"""Topics of an instrument at a high rate, without its computations, and a recorder with a witness.

Run as a module: ``traffic RATE SIZE`` publishes RATE cycles per second with frames of SIZE px; ``recorder
JOURNAL RATE`` is the recorder, which notes every message that it has written in JOURNAL, and writes no faster
than RATE bytes per second (0: as it can).
"""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import Image

from mems6dof_msgs.msg import FrameInfo, Localizations, Pose6DOF
from mems6dof_ros.nodes import recorder, transport
from mems6dof_ros.nodes.common import InstrumentNode, run
from mems6dof_ros.recording import topics
from mems6dof_ros.recording.bag import BagWriter, Channel

#: In the order of a motion cycle, of which the last is the end.
CYCLE = (
    (FrameInfo, topics.FRAME_INFO),
    (Image, topics.IMAGE),
    (Localizations, topics.LOCALIZATIONS),
    (Pose6DOF, topics.POSE_6DOF),
)


class TrafficNode(InstrumentNode):
    """Publishes one message of each topic per cycle."""

    def __init__(self, rate: float, size: int) -> None:
        super().__init__("traffic", ())
        self._period, self._size = 1.0 / rate, size

    def activate(self) -> None:
        self._cycle = 0
        pixels = np.random.default_rng(1).integers(0, 4096, (self._size, self._size), np.uint16)
        image = Image(height=self._size, width=self._size, encoding="mono16", step=2 * self._size)
        image.data.frombytes(pixels.data.cast("B"))
        found = Localizations()
        for name in ("x", "y", "z"):
            getattr(found, name).extend(pixels.ravel()[:150].astype(float))
        patterns = {FrameInfo: FrameInfo(), Image: image, Localizations: found, Pose6DOF: Pose6DOF()}
        self._outgoing = [
            (
                patterns[kind],
                self.create_publisher(kind, topic, transport.FRAMES if kind is Image else transport.MESSAGES),
            )
            for kind, topic in CYCLE
        ]
        self._next = time.monotonic()
        self.create_timer(self._period / 4, self._on_time)

    def _on_time(self) -> None:
        if time.monotonic() < self._next:
            return
        self._next = max(self._next + self._period, time.monotonic() - 10 * self._period)
        stamp = self.get_clock().now().to_msg()
        for message, publisher in self._outgoing:
            message.header.stamp = stamp
            if hasattr(message, "cycle"):
                message.cycle = message.frame_counter = self._cycle
            publisher.publish(message)
        self._cycle += 1


class Journal:
    """What a recorder has written, in a file that both it and its witness map: it survives the recorder.

    Of every message the monotonic time, ns, at which it had been handed to the bag, and whether it ended
    a motion cycle.
    """

    CAPACITY = 200_000

    def __init__(self, path: Path, mode: Any = "r+") -> None:
        self._table: NDArray[np.int64] = np.memmap(path, np.int64, mode, shape=(self.CAPACITY + 1, 2))

    def note(self, ends_cycle: bool) -> None:
        number = self._table[0, 0] + 1
        self._table[number] = time.monotonic_ns(), ends_cycle
        self._table[0, 0] = number

    @property
    def written(self) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """Times and ends of cycles of all messages, in the order of the bag."""
        entries = np.array(self._table[1 : 1 + self._table[0, 0]])
        return entries[:, 0], entries[:, 1].astype(bool)


def run_witnessed_recorder(journal: Journal, rate: float, arguments: list[str]) -> int:
    """The recorder node, with a writer that tells."""

    class WitnessedWriter(BagWriter):
        def write(
            self,
            channel: Channel,
            data: bytes | memoryview,
            log_time_ns: int,
            publish_time_ns: int | None = None,
            sequence: int = 0,
        ) -> None:
            super().write(channel, data, log_time_ns, publish_time_ns, sequence)
            journal.note(channel.topic.endswith(CYCLE[-1][1]))
            if rate:
                time.sleep(len(data) / rate)

    recorder.BagWriter = WitnessedWriter  # type: ignore[misc]
    return recorder.main(arguments)


def main() -> int:
    """As the module says."""
    what, first, second, *arguments = sys.argv[1:]
    if what == "recorder":
        return run_witnessed_recorder(Journal(Path(first)), float(second), arguments)
    return run(lambda: TrafficNode(float(first), int(second)), arguments, frames=True)


if __name__ == "__main__":
    sys.exit(main())
