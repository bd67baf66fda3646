"""The live page as its users and its enemies find it: loaded, steered, left open, attacked.

What a browser shows is read from a real one, see ``browser``; without it there is nothing to measure here
but the attacks and the Foxglove protocol.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping

from mems6dof_ros.figures import Figure
from mems6dof_ros.monitor.validation import attacked, beside, endurance, foxglove, page

#: Part of the table to what measures it: ``measure(work, tell, quick=..., seconds=...)`` yields figures;
#: ``work`` is a directory for files, ``tell`` hears of progress.
PARTS: Mapping[str, Callable[..., Iterator[Figure]]] = {
    "page": page.measure,
    "beside": beside.measure,
    "endurance": endurance.measure,
    "foxglove": foxglove.measure,
    "attacks": attacked.measure,
}
