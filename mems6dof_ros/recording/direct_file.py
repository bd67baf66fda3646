"""A file whose large records go to the disk past the file cache of the operating system.

A frame of 8 MiB through the cache takes 2000 of its pages, which on a virtual machine come one by one from
its host: 20 ms of processor time, where the frame itself, from memory that stays, takes 0.3 ms (O_DIRECT).
Nor does a recording then push everything else out of the cache. Small records are better off in it: they
need not wait for the disk.
"""

from __future__ import annotations

import contextlib
import errno
import mmap
import os
from pathlib import Path

#: Bytes from which a record is large.
LARGE = 1 << 20
#: What such writes begin at and consist of, bytes: a page, which is a multiple of every disk's blocks.
_BLOCK = mmap.PAGESIZE
#: Of which one writes at a time, bytes.
_PART = 8 << 20


class DirectFile:
    """A new file at ``path``, written from its beginning to its end; FileExistsError where there is one.

    A file system that offers no direct writes gets all of it by the cache. After ``flush`` everything is with
    the operating system. Raises OSError as files do.
    """

    def __init__(self, path: Path) -> None:
        self._cached = path.open("xb")
        self._direct: int | None = None
        with contextlib.suppress(OSError, AttributeError):  # on another system than Linux
            self._direct = os.open(path, os.O_WRONLY | os.O_DIRECT)
        self._memory = mmap.mmap(-1, _PART) if self._direct is not None else None

    def write(self, data: bytes | memoryview) -> int:
        """Append ``data``."""
        if self._memory is None or len(data) < LARGE:
            return self._cached.write(data)
        begin = self._cached.tell()
        head = -begin % _BLOCK
        end = len(data) - (begin + len(data)) % _BLOCK
        view = memoryview(data)
        self._cached.write(view[:head])
        self._cached.flush()
        while head < end and (written := self._write_direct(self._memory, view[head:end], begin + head)):
            head += written
        self._cached.seek(begin + head)
        self._cached.write(view[head:])
        return len(data)

    def _write_direct(self, memory: mmap.mmap, data: memoryview, offset: int) -> int:
        """Write the first part of whole blocks; 0 where the file system refuses, from now on."""
        part = min(len(data), _PART)
        memory[:part] = data[:part]
        assert self._direct is not None
        try:
            with memoryview(memory) as aligned:
                written = os.pwrite(self._direct, aligned[:part], offset)
        except OSError as error:
            if error.errno != errno.EINVAL:
                raise
            written = 0
        whole = written - written % _BLOCK  # of a disk that is about to be full
        if not whole:
            self._end_direct()
        return whole

    def tell(self) -> int:
        """Bytes written so far."""
        return self._cached.tell()

    def flush(self) -> None:
        """Hand everything to the operating system."""
        self._cached.flush()

    def sync(self) -> None:
        """... and to the disk."""
        self.flush()
        os.fsync(self._cached.fileno())

    def fileno(self) -> int:
        """Of the file, to lock it."""
        return self._cached.fileno()

    @property
    def closed(self) -> bool:
        return self._cached.closed

    def close(self) -> None:
        """Harmless when repeated."""
        try:
            self._cached.close()
        finally:
            self._end_direct()

    def _end_direct(self) -> None:
        self._memory = None
        if self._direct is not None:
            os.close(self._direct)
            self._direct = None
