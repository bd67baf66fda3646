"""Reads files as the commands do, one after another, in a process that may die of it.

Run as a module with the kind of the files as argument: a path per line on the standard input, an ``Answer``
per line on the standard output.
"""

from __future__ import annotations

import gc
import json
import resource
import sys
import time
import traceback
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple

from mems6dof_ros.errors import Mems6dofError

#: Address space, bytes, that reading may take beyond what the process has: that a file claims to need more
#: must not take the machine down.
ADDRESS_SPACE = 4 << 30


class Answer(NamedTuple):
    """What came of a file: ``read`` to its end; ``refused`` by one line, ``reason``; ``part``: some of it was
    read, the rest refused; ``defect``: anything else. ``memory`` MiB: the most that reading took beyond what
    the process had before, and ``resident`` what it has after."""

    outcome: str
    reason: str
    seconds: float
    memory: float
    resident: float


#: Tells that something has been read.
Note = Callable[[], None]


def read_bag(path: Path, note: Note) -> None:
    """As check and frame_source do; where they refuse, check again after recover."""
    from mems6dof_ros.analysis.check import check_bag
    from mems6dof_ros.recording.bag import BagReader
    from mems6dof_ros.recording.recover import recover
    from mems6dof_ros.sources.bag import BagSource
    from mems6dof_ros.sources.source import frames

    try:
        check_bag(path)
        for _ in frames(BagSource(path)):
            note()
        with BagReader(path) as bag:
            bag.attachments(), bag.provenance()
    except Mems6dofError as refused:
        recover(path)
        if any(count for _, count in check_bag(path).topics.values()):
            note()
        raise refused


def read_images(path: Path, note: Note) -> None:
    """As calibrate and analyze do."""
    from mems6dof_ros.sources.source import frames, open_source

    for _ in frames(open_source("images", path=path)):
        note()


def read_calibration(path: Path, note: Note) -> None:
    from mems6dof_ros.calibration.file import load_calibration

    load_calibration(path)


def read_constellation(path: Path, note: Note) -> None:
    from mems6dof_ros.pose.constellation_file import ReferenceConstellation

    ReferenceConstellation.load(path)


def read_bodies(path: Path, note: Note) -> None:
    from mems6dof_ros.pose.bodies_file import load_bodies

    load_bodies(path)


def read_parameters(path: Path, note: Note) -> None:
    """As a node does at its start: by the middleware's parser, then by our tables."""
    import rclpy
    from rclpy.context import Context
    from rclpy.node import Node
    from rclpy.signals import SignalHandlerOptions

    from mems6dof_ros.nodes.parameters import AUTOSTART, declare
    from mems6dof_ros.nodes.recorder import PARAMETERS

    context = Context()
    arguments = ["--ros-args", "--params-file", str(path)]
    try:
        rclpy.init(args=arguments, context=context, signal_handler_options=SignalHandlerOptions.NO)
        node = Node("recorder", context=context, start_parameter_services=False, enable_rosout=False)
        try:
            declare(node, (AUTOSTART, *PARAMETERS))
        finally:
            node.destroy_node()
    except RuntimeError as error:  # as nodes.common.run takes them
        if type(error).__module__.partition(".")[0] not in ("rclpy", "_rclpy_pybind11"):
            raise
        raise Mems6dofError(" ".join(str(error).split())) from error
    finally:
        rclpy.try_shutdown(context=context)


#: Kind of file to how it is read.
READERS: Mapping[str, Callable[[Path, Note], None]] = {
    "bag": read_bag,
    "images": read_images,
    "calibration": read_calibration,
    "constellation": read_constellation,
    "bodies": read_bodies,
    "parameters": read_parameters,
}


def answer(kind: str, path: Path) -> Answer:
    """Read one file."""
    count = 0

    def note() -> None:
        nonlocal count
        count += 1

    gc.collect()
    before = _memory("VmRSS")
    Path("/proc/self/clear_refs").write_text("5", encoding="ascii")  # the peak begins here
    begin = time.monotonic()
    outcome, reason = "read", ""
    try:
        READERS[kind](path, note)
    except Mems6dofError as error:
        outcome, reason = ("part" if count else "refused"), str(error)
        if "\n" in reason:
            outcome = "defect"
    except BaseException:
        outcome, reason = "defect", traceback.format_exc()
    seconds = time.monotonic() - begin
    peak = _memory("VmHWM") - before
    gc.collect()
    return Answer(outcome, reason, seconds, peak, _memory("VmRSS"))


def _memory(what: str) -> float:
    """MiB, of /proc/self/status."""
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(f"{what}:")) / 1024


def main() -> int:
    """Answer until the standard input ends."""
    kind = sys.argv[1]
    limit = round(_memory("VmSize") * 2**20) + ADDRESS_SPACE
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    for line in sys.stdin:
        print(json.dumps(answer(kind, Path(line.rstrip("\n")))), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
