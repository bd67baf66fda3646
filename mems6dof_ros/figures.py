"""The row of every validation table, `mems6dof validate ...`: what was measured against what is required."""

from __future__ import annotations

import math
from typing import TypedDict


class Figure(TypedDict):
    """One row. ``quantity``: what it is, with its unit; ``measured``: NaN in a remark; ``required``: text;
    ``passed``: None where the row is for information."""

    quantity: str
    measured: float
    required: str
    passed: bool | None


def figure(quantity: str, measured: float, required: str, passed: bool | None) -> Figure:
    """A row whose requirement has words of its own; takes numbers and verdicts of NumPy too."""
    verdict = None if passed is None else bool(passed)
    return {"quantity": quantity, "measured": float(measured), "required": required, "passed": verdict}


def exactly(quantity: str, measured: float, wanted: float) -> Figure:
    """A figure that must be ``wanted``."""
    return figure(quantity, measured, f"{wanted:g}", measured == wanted)


def at_most(quantity: str, measured: float, limit: float | None) -> Figure:
    """A figure that must not exceed ``limit``; None: for information."""
    if limit is None:
        return information(quantity, measured)
    return figure(quantity, measured, f"<= {limit:g}", measured <= limit)


def at_least(quantity: str, measured: float, limit: float) -> Figure:
    """A figure that must reach ``limit``."""
    return figure(quantity, measured, f">= {limit:g}", measured >= limit)


def between(quantity: str, measured: float, low: float, high: float) -> Figure:
    """A figure that must lie in the closed interval from ``low`` to ``high``."""
    return figure(quantity, measured, f"{low:g} to {high:g}", low <= measured <= high)


def information(quantity: str, measured: float) -> Figure:
    """A figure that nothing is required of."""
    return figure(quantity, measured, "", None)


def remark(text: str) -> Figure:
    """A row that measures nothing: why something could not be measured."""
    return information(text, math.nan)
