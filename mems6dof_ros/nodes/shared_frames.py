"""Frames in memory that processes of one host share, beside the topic of images.

By a topic, a 2048 x 2048 frame is copied several times between source and reader (a localizer, a recorder)
and costs both together 6 ms; into a ring in /dev/shm it is copied once. The ``frame_info`` of a frame says
that it is there. The ring is named after this topic, so source and reader find each other without being told;
where they do not, on another host, without room in /dev/shm or for another user, the topic of images serves
as ever.

A file is a header, then slots of a header and the pixels each. The writer goes round and waits for nobody: a
reader uses a frame where it lies and asks afterwards whether it was ``intact`` until then.
"""

from __future__ import annotations

import contextlib
import fcntl
import mmap
import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mems6dof_ros.frame import Frame
from mems6dof_ros.nodes.shared_memory import FOLDER, RING_PREFIX

#: Frames that a ring holds: the queue of a localizer, those in flight, and some.
SLOTS = 24
#: Largest ring, and what it leaves free in /dev/shm, bytes.
_MOST, _LEAVE = 512 << 20, 64 << 20
#: Seconds after which a reader that did not ask any more is gone.
_ATTENTION = 2.0

_PAGE = 4096
_MAGIC = int.from_bytes(b"mems6dF2", "little")
_HEAD = np.dtype(
    [
        ("magic", "<u8"),
        ("slots", "<u8"),
        ("slot_size", "<u8"),
        ("waits_for_readers", "<u8"),
        ("attention", "<f8"),
    ]
)
#: ``serial`` 0: being written.
_SLOT = np.dtype(
    [("serial", "<u8"), ("stamp_ns", "<i8"), ("height", "<u4"), ("width", "<u4"), ("itemsize", "<u4")]
)
_ENCODINGS = {1: "mono8", 2: "mono16"}


def ring_path(topic: str, domain: int, folder: Path = FOLDER) -> Path:
    """The file for the frames that are told of on ``topic`` (fully resolved)."""
    return folder / f"{RING_PREFIX}{domain}{topic.replace('/', '.')}"


class _Ring:
    def __init__(self, memory: mmap.mmap) -> None:
        self._bytes = np.frombuffer(memory, np.uint8)
        self.head = self._bytes[: _HEAD.itemsize].view(_HEAD)[0]
        self._slot_size = int(self.head["slot_size"])

    def slots(self) -> NDArray[np.void]:
        """Headers (n,)."""
        rows = self._bytes[_PAGE:].reshape(int(self.head["slots"]), self._slot_size)
        return np.ndarray(len(rows), _SLOT, rows, strides=(self._slot_size,))

    def pixels(self, slot: int, size: int) -> NDArray[np.uint8]:
        """(size,) bytes of a slot."""
        begin = _PAGE + slot * self._slot_size + _PAGE
        return self._bytes[begin : begin + size]

    @property
    def capacity(self) -> int:
        """Bytes of pixels in a slot."""
        return self._slot_size - _PAGE


class FrameRing:
    """The writer's side; ``close`` removes the file. Raises OSError where there is no room for it.

    ``frame_size``: bytes of pixels. Another ring at ``path``, of a source that is gone, is replaced.
    ``waits_for_readers``: what it says of its source, of whom a reader of memory gets no such consideration.
    """

    def __init__(self, path: Path, frame_size: int, waits_for_readers: bool = False) -> None:
        slot_size = _PAGE + -(-frame_size // _PAGE) * _PAGE
        size = _PAGE + SLOTS * slot_size
        free = os.statvfs(path.parent).f_bavail * os.statvfs(path.parent).f_frsize
        if size > min(_MOST, free - _LEAVE):
            raise OSError(f"{size >> 20} MiB for shared frames, {free >> 20} MiB free in {path.parent}")
        path.unlink(missing_ok=True)
        self._path = path
        self._file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o600)
        fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)  # says that its owner lives, see shared_memory
        os.posix_fallocate(self._file, 0, size)  # rather an error now than SIGBUS with a frame
        self._inode = os.fstat(self._file).st_ino
        memory = mmap.mmap(self._file, size)
        np.frombuffer(memory, _HEAD, 1)[0] = (_MAGIC, SLOTS, slot_size, waits_for_readers, -1e9)
        self._ring = _Ring(memory)
        self._headers = self._ring.slots()
        self._serial = 0

    @property
    def wanted(self) -> bool:
        """Somebody reads."""
        return bool(time.monotonic() - self._ring.head["attention"] < _ATTENTION)

    def write(self, frame: Frame) -> None:
        """Copy the pixels of ``frame`` in place of the oldest; a greater one than was said stays out."""
        pixels = np.ascontiguousarray(frame.image).reshape(-1).view(np.uint8)
        if pixels.size > self._ring.capacity:
            return
        slot = self._serial % SLOTS
        self._serial += 1
        header = self._headers[slot]
        header["serial"] = 0
        np.copyto(self._ring.pixels(slot, pixels.size), pixels)
        header["stamp_ns"] = frame.stamp_ns
        header["height"], header["width"] = frame.image.shape
        header["itemsize"] = frame.image.itemsize
        header["serial"] = self._serial

    def close(self) -> None:
        """Remove the file, unless it is another's by now; readers keep what they have."""
        with contextlib.suppress(OSError):
            if self._path.stat().st_ino == self._inode:
                self._path.unlink()
        os.close(self._file)


@dataclass(frozen=True)
class SharedImage:
    """As a sensor_msgs/Image, with ``data`` (n,) uint8 where the writer put it."""

    header: Any
    height: int
    width: int
    encoding: str
    step: int
    data: NDArray[np.uint8]
    is_bigendian: int
    _slots: NDArray[np.void]
    _number: int
    _serial: int

    def intact(self) -> bool:
        """Not yet overwritten."""
        return int(self._slots["serial"][self._number]) == self._serial

    def written_since(self) -> int:
        """Frames that were written after it: upon SLOTS it is overwritten."""
        return int(self._slots["serial"].max()) - self._serial


class SharedFrames:
    """The reader's side, of whatever ring there is at ``path``, also a later one."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._inode = 0
        self._ring: _Ring | None = None

    @property
    def waits_for_readers(self) -> bool:
        """The source waits until who reads its topics has every frame."""
        return bool(self._ring and self._ring.head["waits_for_readers"])

    def attend(self, wanted: bool = True) -> None:
        """Look whether there is a ring, and ask that frames are written; to be called now and then."""
        try:
            inode = self._path.stat().st_ino
        except OSError:
            self._ring, self._inode = None, 0
            return
        if inode != self._inode:
            self._ring = _opened(self._path)
            self._inode = inode if self._ring else 0  # one that is just being made, look again
        if self._ring and wanted:
            self._ring.head["attention"] = time.monotonic()

    def find(self, header: Any, stamp_ns: int) -> SharedImage | None:
        """The frame of that stamp with ``header``; None where there is none."""
        if self._ring is None or stamp_ns == 0:
            return None
        slots = self._ring.slots()
        with_stamp = np.flatnonzero((slots["stamp_ns"] == stamp_ns) & (slots["serial"] > 0))
        if not len(with_stamp):
            return None
        number = int(with_stamp[np.argmax(slots["serial"][with_stamp])])  # stamps of a recording come again
        slot = slots[number]
        serial, height, width, itemsize = (int(slot[k]) for k in ("serial", "height", "width", "itemsize"))
        data = self._ring.pixels(number, height * width * itemsize).view()
        data.flags.writeable = False
        if slot["stamp_ns"] != stamp_ns or slot["serial"] != serial or serial == 0:
            return None  # overwritten while it was read
        return SharedImage(
            header,
            height,
            width,
            _ENCODINGS[itemsize],
            width * itemsize,
            data,
            _BIG_ENDIAN,
            slots,
            number,
            serial,
        )

    def overtaken(self, stamp_ns: int) -> bool:
        """There is a ring, and in it are but later frames than that."""
        if self._ring is None:
            return False
        slots = self._ring.slots()
        written = slots["stamp_ns"][slots["serial"] > 0]
        return len(written) > 1 and bool((written > stamp_ns).all())


_BIG_ENDIAN = int(np.dtype(np.uint16) == np.dtype(">u2"))


def _opened(path: Path) -> _Ring | None:
    with contextlib.suppress(OSError, ValueError), path.open("r+b") as file:
        memory = mmap.mmap(file.fileno(), 0)
        if len(memory) > _PAGE and int(np.frombuffer(memory, _HEAD, 1)[0]["magic"]) == _MAGIC:
            return _Ring(memory)
    return None
