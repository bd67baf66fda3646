"""Chunks of MCAP files, read and decompressed by several threads ahead of who takes their messages.

To decompress a full frame takes longer than to localize it, and neither needs the interpreter.
"""

from __future__ import annotations

import struct
import zlib
from collections import deque
from collections.abc import Callable, Collection, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import lz4.frame
import zstandard
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import ChunkIndex

# https://mcap.dev/spec: kind and length of a record; a chunk's times, size, check and length of the name of
# its compression; a message's channel, sequence, times.
_RECORD, _CHUNK, _MESSAGE = struct.Struct("<BQ"), struct.Struct("<QQQII"), struct.Struct("<HIQQ")
_DECOMPRESS: dict[str, Callable[[memoryview, int], bytes | memoryview]] = {
    "": lambda data, _: data,
    "lz4": lambda data, _: lz4.frame.decompress(data),
    "zstd": lambda data, size: zstandard.decompress(data, max_output_size=size),
}


class Serialized(NamedTuple):
    """A message as recorded."""

    topic: str
    log_time_ns: int
    data: memoryview


class _Place(NamedTuple):
    path: Path
    chunk: ChunkIndex
    topics: dict[int, str]


def ordered_chunks(paths: Sequence[Path], topics: Collection[str]) -> list[_Place] | None:
    """The chunks with messages on ``topics``; None where they are no index or overlap in time, so that their
    messages would have to be merged."""
    places = []
    for path in paths:
        with path.open("rb") as stream:
            summary = make_reader(stream).get_summary()
        if summary is None or not summary.chunk_indexes:
            return None
        wanted = {number: c.topic for number, c in summary.channels.items() if c.topic in topics}
        for index in sorted(summary.chunk_indexes, key=lambda index: index.chunk_start_offset):
            if wanted.keys() & index.message_index_offsets.keys():
                places.append(_Place(path, index, wanted))
    overlap = any(a.chunk.message_end_time > b.chunk.message_start_time for a, b in pairwise(places))
    return None if overlap else places


def messages(places: Sequence[_Place], threads: int) -> Iterator[Serialized]:
    """Their messages in the order of time, ``threads`` chunks ahead."""
    pending: deque[Future[list[Serialized]]] = deque()
    with ThreadPoolExecutor(threads, "chunks") as pool:
        try:
            for place in places:
                pending.append(pool.submit(_messages_of, place))
                if len(pending) > threads:
                    yield from pending.popleft().result()
            while pending:
                yield from pending.popleft().result()
        finally:
            for future in pending:
                future.cancel()


def _messages_of(place: _Place) -> list[Serialized]:
    chunk = place.chunk
    with place.path.open("rb") as stream:
        stream.seek(chunk.chunk_start_offset + _RECORD.size)
        record = memoryview(stream.read(chunk.chunk_length - _RECORD.size))
    _, _, size, check, name_length = _CHUNK.unpack_from(record)
    compressed = record[_CHUNK.size + name_length + 8 :]
    if chunk.compression not in _DECOMPRESS:
        raise ValueError(f"unknown compression '{chunk.compression}'")
    records = memoryview(_DECOMPRESS[chunk.compression](compressed, size))
    if len(records) != size or (check and zlib.crc32(records) != check):
        raise ValueError("a chunk that is damaged")
    found, position = [], 0
    while position < size:
        kind, length = _RECORD.unpack_from(records, position)
        body = records[position + _RECORD.size : position + _RECORD.size + length]
        position += _RECORD.size + length
        if kind == Opcode.MESSAGE:
            channel, _, log_time_ns, _ = _MESSAGE.unpack_from(body)
            if channel in place.topics:
                found.append(Serialized(place.topics[channel], log_time_ns, body[_MESSAGE.size :]))
    return sorted(found, key=lambda each: each.log_time_ns)
