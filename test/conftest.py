"""What holds for every test."""

from __future__ import annotations

import os

# As the command line and the nodes do, before numpy is imported: sums in several threads are slower here, and
# differ in the last digit from those of a process with another number of threads.
for library in ("OPENBLAS", "OMP", "MKL"):
    os.environ.setdefault(f"{library}_NUM_THREADS", "1")
