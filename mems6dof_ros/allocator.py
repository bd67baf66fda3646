"""Memory for frames: kept by the process instead of fetched anew from the system for each.

A frame of 8 MiB is beyond what the C library keeps of its own accord. It returns such a block at once, and
the next one comes as 2000 pages that the system clears one by one. To record a frame into memory takes
6 ms instead of 12 where they are kept.
"""

from __future__ import annotations

import ctypes

# From malloc.h of the GNU C library.
_TRIM_THRESHOLD, _MMAP_THRESHOLD, _MOST_ARENAS = -1, -3, -8
#: The greatest that the library accepts, bytes.
_LARGEST_BLOCK = 32 << 20
#: Free memory that is kept, bytes.
_KEPT = 512 << 20


def keep_memory() -> None:
    """From now on, keep freed memory for what comes next; does nothing with another C library."""
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError, TypeError):
        return
    mallopt(_MMAP_THRESHOLD, _LARGEST_BLOCK)
    mallopt(_TRIM_THRESHOLD, _KEPT)
    mallopt(_MOST_ARENAS, 1)  # those of other threads than the first return memory all the same
