"""Rows of the table of `mems6dof validate`."""

from __future__ import annotations

from typing import Any

#: One row: quantity, measured, required (text), passed (None: for information).
Figure = dict[str, Any]


def exactly(quantity: str, measured: float, wanted: float) -> Figure:
    return _row(quantity, measured, f"{wanted:g}", measured == wanted)


def at_most(quantity: str, measured: float, limit: float) -> Figure:
    return _row(quantity, measured, f"<= {limit:g}", measured <= limit)


def at_least(quantity: str, measured: float, limit: float) -> Figure:
    return _row(quantity, measured, f">= {limit:g}", measured >= limit)


def information(quantity: str, measured: float) -> Figure:
    return _row(quantity, measured, "", None)


def _row(quantity: str, measured: float, required: str, passed: bool | None) -> Figure:
    verdict = passed if passed is None else bool(passed)
    return {"quantity": quantity, "measured": float(measured), "required": required, "passed": verdict}
