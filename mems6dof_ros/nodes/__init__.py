"""The ROS shell: thin nodes around the pure core."""

import os

# Before NumPy loads: the matrices here are small, and threads of the linear algebra only wait for each other.
for _library in ("OPENBLAS", "OMP", "MKL"):
    os.environ.setdefault(f"{_library}_NUM_THREADS", "1")
