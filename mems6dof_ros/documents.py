"""Text files of plain values, YAML or JSON: whatever is wrong with one is one error."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import yaml

from mems6dof_ros.errors import InputError

_LOADER: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_PARSERS: Mapping[str, Callable[[str], Any]] = {
    "YAML": lambda text: yaml.load(text, Loader=_LOADER),
    "JSON": json.loads,
}


def read_document(path: str | Path, language: str, expected: str) -> Any:
    """The content of a file in ``language`` YAML or JSON.

    Raises InputError, which names what is ``expected``, where the file cannot be read, is no text, is not in
    that language, or would be much larger in memory than on the disk: YAML's references can multiply.
    """
    where = str(path)
    try:
        text = Path(path).read_text(encoding="utf-8")
    except OSError as error:
        raise InputError(where, error.strerror or "an unreadable file", expected) from None
    except UnicodeDecodeError:
        raise InputError(where, "no text", expected) from None
    try:
        content = _PARSERS[language](text)
    except RecursionError:
        raise InputError(where, "values nested too deeply", expected) from None
    except (yaml.YAMLError, ValueError) as error:
        reason = str(error).partition("\n")[0]
        raise InputError(where, f"no valid {language} ({reason})", expected) from None
    if not _fits(content, 1 + len(text)):
        raise InputError(where, "references that multiply beyond the file", expected)
    return content


def _fits(content: Any, limit: int) -> bool:
    """Has it no more values than the file has characters?"""
    pending = [content]
    while pending:
        limit -= 1
        if limit < 0:
            return False
        node = pending.pop()
        if isinstance(node, dict):
            pending += node.values()
        elif isinstance(node, list):
            pending += node
    return True
