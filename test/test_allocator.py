"""Memory for frames is kept, which shows in the pages that the system has to give anew."""

from __future__ import annotations

import platform
import subprocess
import sys

import pytest

PROGRAM = """
import resource
import numpy as np
from mems6dof_ros.allocator import keep_memory

if {keep}:
    keep_memory()

def frame():
    parts = [np.ones(8 << 20, np.uint8) for _ in range(4)]

frame()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(10):
    frame()
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


def pages(keep: bool) -> int:
    command = [sys.executable, "-c", PROGRAM.format(keep=keep)]
    return int(subprocess.run(command, capture_output=True, text=True, check=True, timeout=60).stdout)


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="another C library")
def test_memory_once_used_is_not_fetched_anew() -> None:
    assert pages(keep=True) < 100
    assert pages(keep=False) > 1000, "the C library keeps it by itself: keep_memory is of no use any more"
