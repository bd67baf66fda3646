"""What other processes use of this machine, as Linux tells in /proc."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import NamedTuple

_KINDS = ("RssAnon", "RssShmem")


class Memory(NamedTuple):
    """Resident memory of a process, MiB: its ``own``, and what it has touched of ``shared`` segments of fixed
    size."""

    own: float
    shared: float


def memory_of(pid: int) -> Memory:
    """Of a process."""
    text = Path(f"/proc/{pid}/status").read_text(encoding="utf-8")
    own, shared = (int(re.findall(rf"^{name}:\s+(\d+) kB", text, re.MULTILINE)[0]) / 1024 for name in _KINDS)
    return Memory(own, shared)


def processor_seconds(pid: int) -> float:
    """That a process has used so far."""
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
