"""Completing MCAP files that a crash, a kill, a full disk or a bad sector left damaged.

What is whole stays where it is: the file is cut behind its last whole chunk, and gets the summary and the
footer that it lacks; a damaged chunk before that is marked as a record that readers pass over. No message
is copied, so a long recording takes no second place on the disk.
"""

from __future__ import annotations

import contextlib
import fcntl
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
from mcap.reader import make_reader
from mcap.stream_reader import get_chunk_data_stream
from mcap.summary import Summary
from mcap.writer import MCAP0_MAGIC

from mems6dof_ros.documents import from_yaml
from mems6dof_ros.errors import InputError
from mems6dof_ros.recording.metadata import PROVENANCE, Channel, FileSummary, Qos, write_metadata

_HEAD = struct.Struct("<BQ")  # of a record: opcode, length
_MESSAGE = struct.Struct("<HIQ")  # of a message: channel, sequence, log time

#: Opcodes from here on are private: every reader passes over such records.
_PRIVATE = 0x80


class Recovered(NamedTuple):
    """What became of a file: was it ``complete`` before, ``messages`` in it, ``lost`` bytes that could not be
    read: cut off behind the last whole chunk, or set aside between whole ones."""

    path: Path
    complete: bool
    messages: int
    lost: int


class Completed(NamedTuple):
    """A completed file: what became of it, what it holds, what its writer was told of the recording."""

    result: Recovered
    summary: FileSummary
    provenance: dict[str, str]


@dataclass
class _Contents:
    """What a scan of a file found up to ``end``, the offset behind the last whole record.

    ``index``: entries (log time, offset) by channel of the last chunk, if nothing else follows it, and
    ``indexed`` those channels of which the file has them. ``damaged``: offsets and lengths of records before
    ``end`` that cannot be read, ``lost`` their bytes and those behind ``end``.
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
    damaged: list[int] = field(default_factory=list)
    lost: int = 0

    def note_message(self, channel: int, log_ns: int) -> None:
        self.counts[channel] = self.counts.get(channel, 0) + 1
        self.start_ns = log_ns if self.start_ns is None else min(self.start_ns, log_ns)
        self.end_ns = log_ns if self.end_ns is None else max(self.end_ns, log_ns)


def mcap_files(path: Path) -> list[Path]:
    """The .mcap files of a bag in their order, or ``path`` itself where it is one."""
    if path.is_dir():
        files = (file for file in path.glob("*.mcap") if file.is_file())
        return sorted(files, key=lambda file: (len(file.name), file.name))
    return [path] if path.suffix == ".mcap" else []


def interrupted(path: Path) -> bool:
    """Is there a bag that its writer could not complete? Not one that is being written."""
    incomplete = [file for file in mcap_files(path) if not file.stat().st_size or lacks_end(file)]
    return bool(incomplete) and not any(map(being_written, incomplete))


def hold(descriptor: int) -> bool:
    """Lock a file until it is closed, so that it is known to be written to; False where somebody else has.

    A file system without locks lets everybody.
    """
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return True
    return True


def being_written(file: Path) -> bool:
    """Has somebody a hold of it? False where it cannot be read."""
    with contextlib.suppress(OSError), file.open("rb") as stream:
        return not hold(stream.fileno())
    return False


def lacks_end(file: Path) -> bool:
    """Was it begun as an .mcap file, but never completed? False where it cannot be read."""
    try:
        with file.open("rb") as stream:
            begun = stream.read(len(MCAP0_MAGIC)) == MCAP0_MAGIC
            size = stream.seek(0, os.SEEK_END)
            stream.seek(max(size - len(MCAP0_MAGIC), 0))
            return begun and not (size > 2 * len(MCAP0_MAGIC) and stream.read() == MCAP0_MAGIC)
    except OSError:
        return False


def recover(path: Path) -> list[Recovered]:
    """Complete an .mcap file, or all those of a bag, whose ``metadata.yaml`` is then written anew.

    A file of a bag that was not even begun, because the disk was full, is left out of it. Raises
    InputError where ``path`` is neither, or a file is no MCAP file at all or is being written.
    """
    if not path.is_dir():
        return [complete_file(path).result]
    files = mcap_files(path)
    begun = [file for file in files if file.stat().st_size > len(MCAP0_MAGIC)]
    if not begun:
        found = (
            "empty .mcap files" if files else "an sqlite3 bag" if any(path.glob("*.db3")) else "no .mcap file"
        )
        raise InputError(str(path), found, "a bag with MCAP storage")
    completed = [complete_file(file) for file in begun]
    provenance = {name: value for one in completed for name, value in one.provenance.items()}
    try:
        write_metadata(path, [one.summary for one in completed], provenance)
    except OSError as error:
        found = error.strerror or str(error)
        raise InputError(str(path / "metadata.yaml"), found, "a file that can be written") from None
    return [one.result for one in completed]


def complete_file(path: Path) -> Completed:
    """Complete one .mcap file; InputError where it is none or being written, or cannot be read or changed."""
    try:
        with path.open("r+b") as stream:
            if not hold(stream.fileno()):
                raise InputError(str(path), "a file that is being written", "one whose writer has ended")
            size = path.stat().st_size
            if not size:
                raise InputError(str(path), "an empty file", "an .mcap file with something in it")
            contents = _scan(stream, size, path)
            if not contents.complete:
                for offset in contents.damaged:
                    stream.seek(offset)
                    stream.write(bytes([_PRIVATE]))
                stream.seek(contents.end)
                stream.truncate()
                stream.write(_ending(contents))
                stream.flush()
                os.fsync(stream.fileno())
    except OSError as error:
        reason = error.strerror or str(error)
        raise InputError(str(path), reason, "an .mcap file that can be changed") from None
    count = sum(contents.counts.values())
    result = Recovered(path, contents.complete, count, contents.lost)
    return Completed(result, _summary(path, contents), contents.provenance)


def _scan(stream: BinaryIO, size: int, path: Path) -> _Contents:
    """Read record by record until the data ends, or the records do."""
    if stream.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
        raise InputError(str(path), "no MCAP file", "the magic number of MCAP at its beginning")
    contents = _Contents(end=len(MCAP0_MAGIC))
    summary = _summary_section(stream)
    if summary:  # should the chunk that announces them be damaged
        contents.schemas, contents.channels = dict(summary.schemas), dict(summary.channels)
    damaged: list[tuple[int, int]] = []  # behind the last whole record
    orphans = ended = False  # indexes of a damaged chunk; the end of the data
    for opcode, offset, length in _heads(stream, size):
        if opcode == Opcode.DATA_END:
            ended = True
            break
        total = _HEAD.size + length
        if opcode == Opcode.MESSAGE_INDEX and orphans:
            continue
        try:
            _note(contents, opcode, offset, stream.read(length))
        except Exception:  # whatever is wrong with it, this record is not whole
            orphans = opcode == Opcode.CHUNK
            damaged.append((offset, total))
            continue
        orphans = opcode >= _PRIVATE  # that was set aside by an earlier recovery
        if opcode not in (Opcode.CHUNK, Opcode.MESSAGE_INDEX):
            contents.index, contents.indexed = {}, set()
        # An index counts when all of it is there; otherwise it will be written anew behind the chunk.
        if opcode != Opcode.MESSAGE_INDEX or contents.indexed == contents.index.keys():
            contents.end = offset + total
            contents.damaged += [start for start, _ in damaged]
            contents.lost += sum(length for _, length in damaged)
            damaged = []
    contents.complete = ended and not contents.lost and not damaged and _fits(summary, stream, contents)
    contents.lost += sum(length for _, length in damaged) if ended else size - contents.end
    return contents


def _summary_section(stream: BinaryIO) -> Summary | None:
    """What the file says of itself at its end, where it can be read."""
    try:
        stream.seek(0)
        return make_reader(stream).get_summary()
    except Exception:  # there is none, or it is not whole
        return None


def _fits(summary: Summary | None, stream: BinaryIO, contents: _Contents) -> bool:
    """Does the end of the file say what the scan found? It need not say everything."""
    stream.seek(-len(MCAP0_MAGIC), os.SEEK_END)
    if stream.read() != MCAP0_MAGIC:
        return False
    if summary is None:
        return not contents.chunks
    chunks = [(index.chunk_start_offset, index.chunk_length) for index in summary.chunk_indexes]
    found = [(index.chunk_start_offset, index.chunk_length) for index in contents.chunks]
    count = summary.statistics.message_count if summary.statistics else sum(contents.counts.values())
    return sorted(chunks) == found and count == sum(contents.counts.values())


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


def _note(contents: _Contents, opcode: int, offset: int, content: bytes) -> None:
    total = _HEAD.size + len(content)
    stream = ReadDataStream(io.BytesIO(content))
    if opcode == Opcode.CHUNK:
        _note_chunk(contents, records.Chunk.read(stream), offset, total)
    elif opcode == Opcode.MESSAGE_INDEX:
        index = records.MessageIndex.read(stream)
        if contents.index.get(index.channel_id) != index.records:
            raise ValueError("an index of other messages")
        contents.indexed.add(index.channel_id)
        chunk = contents.chunks[-1]
        chunk.message_index_offsets[index.channel_id] = offset
        chunk.message_index_length += total
    elif opcode == Opcode.ATTACHMENT:
        attachment = records.Attachment.read(stream)
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
        metadata = records.Metadata.read(stream)
        contents.metadata.append(records.MetadataIndex(offset=offset, length=total, name=metadata.name))
        if metadata.name == PROVENANCE:
            contents.provenance = dict(metadata.metadata)
    elif opcode < _PRIVATE:
        _note_content(contents, opcode, content)


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
            schema = inside.channels[channel].schema_id
            if schema and schema not in inside.schemas:
                raise ValueError("messages without their schema")
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
        known = Channel(channel.topic, typename, _qos(channel.metadata.get("offered_qos_profiles", "")))
        counts[known] = counts.get(known, 0) + contents.counts.get(number, 0)
        hashes[typename] = channel.metadata.get("topic_type_hash", "")
    return FileSummary(path.name, contents.start_ns, contents.end_ns, counts, hashes)


def _qos(text: str) -> tuple[Qos, ...]:
    """Profiles as other writers put them, too; none where they cannot be read."""
    try:
        return tuple(Qos.from_profile(profile) for profile in from_yaml(text) or ())
    except (yaml.YAMLError, TypeError, KeyError, ValueError):
        return ()
