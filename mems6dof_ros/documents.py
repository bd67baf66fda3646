"""Text files: plain values read from YAML or JSON, whole files written; whatever is wrong is one error."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import yaml

from mems6dof_ros.errors import InputError

# libyaml's where PyYAML has it: ten times faster.
_LOADER: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_DUMPER: Any = getattr(yaml, "CSafeDumper", yaml.SafeDumper)
_DEEPEST = 100  # levels


def from_yaml(text: str) -> Any:
    """Plain values of ``text``; yaml.YAMLError where it is no YAML."""
    return yaml.load(text, Loader=_LOADER)


def to_yaml(content: Any) -> str:
    """Plain values as text, in their order."""
    return str(yaml.dump(content, Dumper=_DUMPER, sort_keys=False))


_PARSERS: Mapping[str, Callable[[str], Any]] = {"YAML": from_yaml, "JSON": json.loads}


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
    _check_size(content, 1 + len(text), where, expected)
    return content


def write_whole(path: str | Path, text: str) -> None:
    """Write ``text`` to ``path``: completed under another name first, so never half-written.

    Raises InputError where that cannot be.
    """
    path = Path(path)
    unfinished = Path(f"{path}.part")
    try:
        if path.exists() and not path.is_file():  # a device, as /dev/null, must not be replaced
            path.write_text(text, encoding="utf-8")
            return
        unfinished.write_text(text, encoding="utf-8")
        unfinished.replace(path)
    except OSError as error:
        raise InputError(str(path), error.strerror or str(error), "a file that can be written") from None
    finally:
        with contextlib.suppress(OSError):  # where nothing can be written, nothing can be removed
            unfinished.unlink(missing_ok=True)


def _check_size(content: Any, limit: int, where: str, expected: str) -> None:
    """Refuse more values than the file has characters, and more levels than anybody writes."""
    pending = [(content, 0)]
    while pending:
        node, depth = pending.pop()
        limit -= 1
        if limit < 0:
            raise InputError(where, "references that multiply beyond the file", expected)
        if depth > _DEEPEST:
            raise InputError(where, "values nested too deeply", expected)
        inside = node.values() if isinstance(node, dict) else node if isinstance(node, list) else ()
        pending += [(value, depth + 1) for value in inside]
