"""Real micrographs, where they are at hand."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import tifffile


@pytest.fixture
def real_stack() -> Callable[[str], np.ndarray]:
    """Load a real focus stack by its file name; skips where the data are absent."""
    beside = Path(__file__).parents[2].parent / "shared" / "data"
    folder = Path(os.environ.get("MEMS6DOF_REAL_DATA", beside))

    def load(name: str) -> np.ndarray:
        if not (folder / name).is_file():
            pytest.skip(f"{name} is not in {folder} (set MEMS6DOF_REAL_DATA)")
        return tifffile.imread(folder / name)

    return load
