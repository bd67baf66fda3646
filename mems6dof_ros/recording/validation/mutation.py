"""Files as they must not be: damaged bytes, and well-formed text with the wrong content."""

from __future__ import annotations

import copy
import json
import math
import random
from collections.abc import Callable
from typing import Any

import yaml

#: By name: what happens to the bytes of a file.
BYTE_FAULTS: dict[str, Callable[[random.Random, bytearray], None]] = {
    "one bit": lambda rng, data: _flip(rng, data, 1),
    "some bits": lambda rng, data: _flip(rng, data, rng.choice((2, 5, 30))),
    "bits of the head": lambda rng, data: _flip(rng, data, 3, 256),
    "truncated": lambda rng, data: data.__delitem__(slice(rng.randrange(len(data)), None)),
    "a piece removed": lambda rng, data: data.__delitem__(_piece(rng, data)),
    "a piece doubled": lambda rng, data: _insert(rng, data, bytes(data[_piece(rng, data)])),
    "a piece of noise": lambda rng, data: _insert(rng, data, rng.randbytes(rng.randrange(1, 2000))),
    "zeros": lambda rng, data: _overwrite(data, (piece := _piece(rng, data)).start, bytes(_length(piece))),
    "a huge count": lambda rng, data: _overwrite(data, rng.randrange(len(data)), _huge(rng)),
    "a huge count in the head": lambda rng, data: _overwrite(
        data, rng.randrange(min(512, len(data))), _huge(rng)
    ),
    "a huge count in the tail": lambda rng, data: _overwrite(
        data, max(len(data) - 1 - rng.randrange(2048), 0), _huge(rng)
    ),
    "noise only": lambda rng, data: data.__setitem__(slice(None), rng.randbytes(rng.randrange(5000))),
}

#: By name: what stands in the place of a value.
WRONG_VALUES: dict[str, Callable[[random.Random, Any], Any]] = {
    "nothing": lambda rng, value: None,
    "text": lambda rng, value: "text",
    "empty text": lambda rng, value: "",
    "a list": lambda rng, value: [value],
    "an empty list": lambda rng, value: [],
    "a mapping": lambda rng, value: {"key": value},
    "a number": lambda rng, value: rng.choice((-1, 0, 3, 0.5, -1e-300, 1e300)),
    "true": lambda rng, value: True,
    "no number": lambda rng, value: rng.choice((math.nan, math.inf, -math.inf)),
    "a huge number": lambda rng, value: rng.choice((2**63, -(2**64), 10**400)),
    "a long list": lambda rng, value: [value] * rng.choice((7, 1000)),
    "a long text": lambda rng, value: "9" * rng.choice((100, 100_000)),
    "nested": lambda rng, value: _nested(value, rng.choice((3, 30))),
}


def damaged(rng: random.Random, data: bytes) -> bytes:
    """``data`` with a fault or two."""
    result = bytearray(data)
    for _ in range(rng.choice((1, 1, 2))):
        if result:
            rng.choice(list(BYTE_FAULTS.values()))(rng, result)
    return bytes(result)


def contradicted(rng: random.Random, text: str, dump: Callable[[Any], str]) -> bytes:
    """YAML or JSON ``text`` with some of its values of another kind, or gone, or nested beyond reason."""
    if rng.random() < 0.03:
        depth = rng.choice((500, 20_000))
        return ("[" * depth + "]" * depth).encode()
    if rng.random() < 0.03:  # nine levels of nine references each: small in the file only
        levels = ["a0: &a0 [1, 1, 1, 1, 1, 1, 1, 1, 1]"]
        levels += [f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9)}]" for k in range(1, 9)]
        return ("\n".join(levels) + "\n" + text.replace("[", "*a8 #[", 1)).encode()
    document = copy.deepcopy(yaml.safe_load(text))
    for _ in range(rng.choice((1, 1, 2, 5))):
        places = _places(document)
        if not places:
            break
        parent, key = rng.choice(places)
        if rng.random() < 0.2:
            del parent[key]
        else:
            parent[key] = rng.choice(list(WRONG_VALUES.values()))(rng, parent[key])
    return dump(document).encode("utf-8", "surrogatepass")


def to_yaml(document: Any) -> str:
    """As YAML."""
    return str(yaml.safe_dump(document, sort_keys=False))


def to_json(document: Any) -> str:
    """As JSON, with NaN and Infinity as Python writes and reads them."""
    return json.dumps(document)


def _places(document: Any) -> list[tuple[Any, Any]]:
    """Every container with every key, of long lists the first few."""
    places, pending = [], [document]
    while pending:
        node = pending.pop()
        keys = (
            list(node)
            if isinstance(node, dict)
            else range(min(len(node), 4))
            if isinstance(node, list)
            else ()
        )
        places += [(node, key) for key in keys]
        pending += [node[key] for key in keys]
    return places


def _nested(value: Any, depth: int) -> Any:
    for _ in range(depth):
        value = [value]
    return value


def _flip(rng: random.Random, data: bytearray, count: int, within: int = 2**62) -> None:
    for _ in range(count):
        data[rng.randrange(min(len(data), within))] ^= 1 << rng.randrange(8)


def _piece(rng: random.Random, data: bytearray) -> slice:
    start = rng.randrange(len(data))
    return slice(start, min(start + rng.randrange(1, 3000), len(data)))


def _length(piece: slice) -> int:
    return int(piece.stop - piece.start)


def _insert(rng: random.Random, data: bytearray, piece: bytes) -> None:
    place = rng.randrange(len(data))
    data[place:place] = piece


def _overwrite(data: bytearray, start: int, piece: bytes) -> None:
    data[start : start + len(piece)] = piece


def _huge(rng: random.Random) -> bytes:
    size = rng.choice((2, 4, 8))
    value = rng.choice(
        (2 ** (8 * size) - 1, 2 ** (8 * size - 1) - 1, 2 ** (8 * size - 1), 2 ** (8 * size - 4))
    )
    return value.to_bytes(size, rng.choice(("little", "big")))
