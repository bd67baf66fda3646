"""Completing MCAP files that a crash, a kill or a full disk left without their end.

What is whole stays where it is: the file is cut behind its last whole chunk, and gets the summary and the
footer that it lacks. No message is copied, so a long recording takes no second place on the disk.
"""

from __future__ import annotations

import io
import os
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO, NamedTuple

import yaml
from mcap import records
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.opcode import Opcode
from mcap.stream_reader import get_chunk_data_stream
from mcap.writer import MCAP0_MAGIC

from mems6dof_ros.errors import InputError
from mems6dof_ros.recording.metadata import PROVENANCE, Channel, FileSummary, Qos, write_metadata

_HEAD = struct.Struct("<BQ")  # of a record: opcode, length
_MESSAGE = struct.Struct("<HIQ")  # of a message: channel, sequence, log time


class Recovered(NamedTuple):
    """What became of a file: was it ``complete`` before, ``messages`` in it, ``lost`` bytes cut off."""

    path: Path
    complete: bool
    messages: int
    lost: int


@dataclass
class _Contents:
    """What a scan of a file found up to ``end``, the offset behind the last whole record.

    ``index``: entries (log time, offset) by channel of the last chunk, if nothing else follows it, and
    ``indexed`` those channels of which the file has them.
    """

    end: int = 0
    complete: bool = False
    schemas: dict[int, records.Schema] = field(default_factory=dict)
    channels: dict[int, records.Channel] = field(default_factory=dict)
    chunks: list[records.ChunkIndex] = field(default_factory=list)
    attachments: list[records.AttachmentIndex] = field(default_factory=list)
    metadata: list[records.MetadataIndex] = field(default_factory=list)
    provenance: dict[str, str] = field(default_factory=dict)
    counts: dict[int, int] = field(default_factory=dict)
    start_ns: int | None = None
    end_ns: int | None = None
    index: dict[int, list[tuple[int, int]]] = field(default_factory=dict)
    indexed: set[int] = field(default_factory=set)

    def note_message(self, channel: int, log_ns: int) -> None:
        self.counts[channel] = self.counts.get(channel, 0) + 1
        self.start_ns = log_ns if self.start_ns is None else min(self.start_ns, log_ns)
        self.end_ns = log_ns if self.end_ns is None else max(self.end_ns, log_ns)


def recover(path: Path) -> list[Recovered]:
    """Complete an .mcap file, or all those of a bag, whose ``metadata.yaml`` is then written anew.

    Raises InputError where ``path`` is neither, or a file is no MCAP file at all.
    """
    if not path.is_dir():
        return [_complete(path)[0]]
    files = sorted(path.glob("*.mcap"), key=lambda file: (len(file.name), file.name))
    if not files:
        raise InputError(str(path), "no .mcap file", "a bag, or an .mcap file")
    results: list[Recovered] = []
    summaries: list[FileSummary] = []
    provenance: dict[str, str] = {}
    for file in files:
        result, contents = _complete(file)
        results.append(result)
        summaries.append(_summary(file, contents))
        provenance |= contents.provenance
    write_metadata(path, summaries, provenance)
    return results


def _complete(path: Path) -> tuple[Recovered, _Contents]:
    try:
        with path.open("r+b") as stream:
            size = path.stat().st_size
            contents = _scan(stream, size, path)
            if not contents.complete:
                stream.seek(contents.end)
                stream.truncate()
                stream.write(_ending(contents))
                stream.flush()
                os.fsync(stream.fileno())
    except OSError as error:
        raise InputError(
            str(path), error.strerror or str(error), "an .mcap file that can be changed"
        ) from None
    lost = 0 if contents.complete else size - contents.end
    return Recovered(path, contents.complete, sum(contents.counts.values()), lost), contents


def _scan(stream: BinaryIO, size: int, path: Path) -> _Contents:
    """Read record by record until the data ends, or something is not whole."""
    if stream.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
        raise InputError(str(path), "no MCAP file", "the magic number of MCAP at its beginning")
    contents = _Contents(end=stream.tell())
    for opcode, offset, length in _heads(stream, size):
        if opcode == Opcode.DATA_END:
            stream.seek(-len(MCAP0_MAGIC), os.SEEK_END)
            contents.complete = stream.read() == MCAP0_MAGIC
            break
        try:
            _note(contents, opcode, offset, length, stream)
        except Exception:  # whatever is wrong with it, this record is not whole
            break
        if opcode not in (Opcode.CHUNK, Opcode.MESSAGE_INDEX):
            contents.index, contents.indexed = {}, set()
        # An index counts when all of it is there; otherwise it will be written anew behind the chunk.
        if opcode != Opcode.MESSAGE_INDEX or contents.indexed == contents.index.keys():
            contents.end = offset + _HEAD.size + length
    return contents


def _heads(stream: BinaryIO, size: int) -> Iterator[tuple[int, int, int]]:
    """Opcode, offset and length of each record that lies in the file, with the stream at its content."""
    offset = len(MCAP0_MAGIC)
    while offset + _HEAD.size <= size:
        stream.seek(offset)
        opcode, length = _HEAD.unpack(stream.read(_HEAD.size))
        if opcode == 0 or offset + _HEAD.size + length > size:
            return
        yield opcode, offset, length
        offset += _HEAD.size + length


def _note(contents: _Contents, opcode: int, offset: int, length: int, stream: BinaryIO) -> None:
    total = _HEAD.size + length
    if opcode == Opcode.CHUNK:
        _note_chunk(contents, records.Chunk.read(ReadDataStream(stream)), offset, total)
    elif opcode == Opcode.MESSAGE_INDEX:
        index = records.MessageIndex.read(ReadDataStream(stream))
        contents.indexed.add(index.channel_id)
        chunk = contents.chunks[-1]
        chunk.message_index_offsets[index.channel_id] = offset
        chunk.message_index_length += total
    elif opcode == Opcode.ATTACHMENT:
        attachment = records.Attachment.read(ReadDataStream(stream))
        contents.attachments.append(
            records.AttachmentIndex(
                offset=offset,
                length=total,
                create_time=attachment.create_time,
                log_time=attachment.log_time,
                data_size=len(attachment.data),
                name=attachment.name,
                media_type=attachment.media_type,
            )
        )
    elif opcode == Opcode.METADATA:
        metadata = records.Metadata.read(ReadDataStream(stream))
        contents.metadata.append(records.MetadataIndex(offset=offset, length=total, name=metadata.name))
        if metadata.name == PROVENANCE:
            contents.provenance = dict(metadata.metadata)
    else:
        _note_content(contents, opcode, stream.read(length))


def _note_chunk(contents: _Contents, chunk: records.Chunk, offset: int, total: int) -> None:
    data, size = get_chunk_data_stream(chunk, validate_crc=True)
    index: dict[int, list[tuple[int, int]]] = {}
    inside = _Contents(schemas=dict(contents.schemas), channels=dict(contents.channels))
    while (position := data.count) < size:
        opcode, length = data.read1(), data.read8()
        content = data.read(length)
        _note_content(inside, opcode, content)
        if opcode == Opcode.MESSAGE:
            channel, _, log_ns = _MESSAGE.unpack_from(content)
            index.setdefault(channel, []).append((log_ns, position))
    contents.schemas, contents.channels = inside.schemas, inside.channels
    contents.index, contents.indexed = index, set()
    for channel, entries in index.items():
        for log_ns, _ in entries:
            contents.note_message(channel, log_ns)
    contents.chunks.append(
        records.ChunkIndex(
            message_start_time=chunk.message_start_time,
            message_end_time=chunk.message_end_time,
            chunk_start_offset=offset,
            chunk_length=total,
            message_index_offsets={},
            message_index_length=0,
            compression=chunk.compression,
            compressed_size=len(chunk.data),
            uncompressed_size=chunk.uncompressed_size,
        )
    )


def _note_content(contents: _Contents, opcode: int, content: bytes) -> None:
    if opcode == Opcode.SCHEMA:
        schema = records.Schema.read(ReadDataStream(io.BytesIO(content)))
        contents.schemas[schema.id] = schema
    elif opcode == Opcode.CHANNEL:
        channel = records.Channel.read(ReadDataStream(io.BytesIO(content)))
        contents.channels[channel.id] = channel
    elif opcode == Opcode.MESSAGE:
        channel_id, _, log_ns = _MESSAGE.unpack_from(content)
        contents.note_message(channel_id, log_ns)


def _ending(contents: _Contents) -> bytes:
    """What follows the last whole record: the index of a chunk that has none, data end, summary, footer."""
    ending = RecordBuilder()
    if contents.indexed != contents.index.keys():
        last = contents.chunks[-1]
        last.message_index_offsets.clear()
        for channel, entries in contents.index.items():
            last.message_index_offsets[channel] = contents.end + ending.count
            records.MessageIndex(channel_id=channel, records=entries).write(ending)
        last.message_index_length = ending.count
    records.DataEnd(0).write(ending)
    summary_start = contents.end + ending.count
    for group in (contents.schemas.values(), contents.channels.values()):
        for record in group:
            record.write(ending)
    records.Statistics(
        attachment_count=len(contents.attachments),
        channel_count=len(contents.channels),
        channel_message_counts=contents.counts,
        chunk_count=len(contents.chunks),
        message_count=sum(contents.counts.values()),
        metadata_count=len(contents.metadata),
        message_start_time=contents.start_ns or 0,
        message_end_time=contents.end_ns or 0,
        schema_count=len(contents.schemas),
    ).write(ending)
    for indexes in (contents.chunks, contents.attachments, contents.metadata):
        for index in indexes:
            index.write(ending)
    records.Footer(summary_start=summary_start, summary_offset_start=0, summary_crc=0).write(ending)
    return ending.end() + MCAP0_MAGIC


def _summary(path: Path, contents: _Contents) -> FileSummary:
    counts: dict[Channel, int] = {}
    hashes = {}
    for number, channel in contents.channels.items():
        schema = contents.schemas.get(channel.schema_id)
        typename = schema.name if schema else ""
        profiles = yaml.safe_load(channel.metadata.get("offered_qos_profiles", "")) or []
        qos = tuple(Qos.from_profile(profile) for profile in profiles)
        counts[Channel(channel.topic, typename, qos)] = contents.counts.get(number, 0)
        hashes[typename] = channel.metadata.get("topic_type_hash", "")
    return FileSummary(path.name, contents.start_ns, contents.end_ns, counts, hashes)
