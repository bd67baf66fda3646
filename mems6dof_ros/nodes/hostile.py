"""What broken messages do to the nodes, as figures of `mems6dof validate lab`."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

#: One row of the table: quantity, measured, required (text), passed (None: for information).
Figure = dict[str, Any]


def figures(work: Path, seed: int, tell: Callable[[str], None]) -> Iterator[Figure]:
    """All figures."""
    yield from ()
