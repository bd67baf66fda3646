"""The errors that reach a user, as one line each."""

from __future__ import annotations

#: Characters of what was found that are shown.
LONGEST = 300


class Mems6dofError(Exception):
    """Base of all errors meant for the user: one line that says what is wrong and where."""


class InputError(Mems6dofError):
    """Input that cannot be used: names the file or field, what was found and what was expected."""

    def __init__(self, where: str, found: str, expected: str) -> None:
        short = found if len(found) <= LONGEST else f"{found[:LONGEST]}..."
        super().__init__(f"{where}: found {short}; expected {expected}")
        self.where = where
        self.found = found
        self.expected = expected
