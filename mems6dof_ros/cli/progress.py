"""Progress of long work, on stderr: one line that renews itself, or now and then a line in a log."""

from __future__ import annotations

import sys
import time
from typing import TextIO


class Progress:
    """Called as ``progress(done, total, text)``; ``total`` 0: unknown. Use as a context manager."""

    def __init__(self, label: str, stream: TextIO | None = None) -> None:
        self._label, self._stream = label, stream or sys.stderr
        self._terminal = self._stream.isatty()
        self._interval = 0.1 if self._terminal else 10.0
        self._start = self._shown = time.monotonic()
        self._last = ""

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, *_: object) -> None:
        if self._last and self._terminal:
            self._stream.write("\n")

    def __call__(self, done: int, total: int = 0, text: str = "") -> None:
        now = time.monotonic()
        if done != total and now - self._shown < self._interval:
            return
        self._shown = now
        rate = done / max(now - self._start, 1e-9)
        line = f"{self._label}: {done}"
        if total:
            line += f" of {total}, {done / total:.0%}"
        line += f", {rate:.1f}/s"
        if total and 0 < done < total:
            line += f", {(total - done) / rate:.0f} s left"
        if text:
            line += f"  {text}"
        self._stream.write(f"\r{line.ljust(len(self._last))}" if self._terminal else f"{line}\n")
        self._stream.flush()
        self._last = line
