"""What killed processes leave in shared memory.

Fast DDS keeps a segment per process in /dev/shm, with a file beside it, ``_el``, that its owner holds locked
(flock) and the kernel unlocks when the owner dies. A killed process leaves both, 128 MiB where it published
frames, and with /dev/shm full no ROS 2 process starts any more. A ring of frames (``shared_frames``) is
itself locked.
"""

from __future__ import annotations

import contextlib
import fcntl
import re
import time
from pathlib import Path

FOLDER = Path("/dev/shm")
#: Of the names of rings of frames.
RING_PREFIX = "mems6dof_frames_"

#: Of a segment and not of a port: ports have no owner, and Fast DDS revives them itself.
_LOCK_NAME = re.compile(r"fastrtps_[0-9a-f]{16}_el")
_NEWBORN = 5.0  # s; a segment this young may not be locked yet


def remove_abandoned(folder: Path = FOLDER) -> int:
    """Remove segments and rings of frames whose owners are dead; returns the bytes set free.

    Whoever has such a segment open keeps its own view of it. Never raises: what is not ours stays.
    """
    freed = 0
    for lock in folder.glob("fastrtps_*_el"):
        with contextlib.suppress(OSError):  # somebody else's; or gone, or still locked
            if not _LOCK_NAME.fullmatch(lock.name) or time.time() - lock.stat().st_mtime < _NEWBORN:
                continue
            segment = lock.with_name(lock.name.removesuffix("_el"))
            with lock.open("rb") as file:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                with contextlib.suppress(FileNotFoundError):
                    size = segment.stat().st_size
                    segment.unlink()
                    freed += size
                lock.unlink()
    for ring in folder.glob(f"{RING_PREFIX}*"):
        with contextlib.suppress(OSError):
            if time.time() - ring.stat().st_mtime < _NEWBORN:
                continue
            with ring.open("rb") as file:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                freed += ring.stat().st_size
                ring.unlink()
    return freed
