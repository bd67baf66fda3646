"""Bags: a rosbag2 directory of MCAP files, written so that it survives, and read without ROS.

``BagWriter`` produces what ``ros2 bag``, Foxglove, PlotJuggler and ``rosbags`` open cleanly (profile
``ros2``, complete ``ros2msg`` schemas with comments, QoS and type hashes, chunks, index, statistics,
``metadata.yaml`` version 9) and what a killed process leaves readable up to the last ``flush``:
neither ``rosbags`` nor ``mcap_ros2`` offers both.
"""

from __future__ import annotations

import errno
import os
import shutil
import time
from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import IO, Any, NamedTuple, cast

from mcap.reader import McapReader, make_reader
from mcap.writer import CompressionType, Writer
from rosbags.highlevel import AnyReader

from mems6dof_ros import __version__
from mems6dof_ros.documents import from_yaml, to_yaml
from mems6dof_ros.errors import InputError
from mems6dof_ros.recording import read_ahead
from mems6dof_ros.recording.definitions import PACKAGE, definition, named_types, typestore
from mems6dof_ros.recording.direct_file import DirectFile
from mems6dof_ros.recording.messages import Message, serialize
from mems6dof_ros.recording.metadata import (
    PROVENANCE,
    Channel,
    FileSummary,
    Qos,
    metadata_text,
    write_metadata,
)
from mems6dof_ros.recording.recover import being_written, complete_file, hold, lacks_end, mcap_files

__all__ = ["BagReader", "BagWriter", "Channel", "Qos", "Recorded"]

#: Types whose fields are read here, rather than passed on.
INTERPRETED = frozenset(
    (
        "sensor_msgs/msg/Image",
        *(
            f"{PACKAGE}/msg/{name}"
            for name in (
                "FrameInfo",
                "GroundTruth",
                "Localizations",
                "Pose6DOF",
                "ActuationCommand",
                "ActuationAcknowledgement",
                "ControllerState",
            )
        ),
    )
)
COMPRESSIONS = {"none": CompressionType.NONE, "lz4": CompressionType.LZ4, "zstd": CompressionType.ZSTD}


class BagWriter:
    """Writes a rosbag2 directory of one or more MCAP files; use as a context manager.

    ``path`` is the directory, which must not exist or be empty. ``compression`` of chunks: ``none``
    keeps up with full-rate frames, ``zstd`` suits everything else. ``provenance`` goes into every
    file and into ``metadata.yaml``. ``flush`` after each motion cycle: what was flushed survives a kill
    of the process; what is older than ``sync_period`` s survives a loss of power. Leaving the context by
    an exception completes the files all the same. Not safe for use by several threads at once.

    The first ``flush`` after which a file has ``split_size`` bytes, or spans ``split_duration`` s, completes
    it (0: never); the next message opens another. Every file is readable by itself: it begins with the
    attachments and with the last messages of each transient-local channel, as many as its depth.

    With less than ``minimum_free`` bytes left on the disk, ``flush`` completes the bag and raises OSError
    (ENOSPC). Any other OSError also ends it, with what is whole completed as far as the disk allows.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        compression: str = "none",
        provenance: Mapping[str, str] | None = None,
        sync_period: float = 1.0,
        split_size: int = 0,
        split_duration: float = 0.0,
        minimum_free: int = 64 << 20,
    ) -> None:
        self.path = Path(path)
        if compression not in COMPRESSIONS:
            raise InputError("compression", repr(compression), f"one of {', '.join(COMPRESSIONS)}")
        if self.path.exists() and (not self.path.is_dir() or any(self.path.iterdir())):
            raise InputError(str(self.path), "something there already", "a new or empty directory")
        self.path.mkdir(parents=True, exist_ok=True)
        self.provenance = {"mems6dof_ros": __version__, **(provenance or {})}
        self._compression = COMPRESSIONS[compression]
        self._sync_period, self._minimum_free = sync_period, minimum_free
        self._split_size, self._split_ns = split_size, round(split_duration * 1e9)
        self._latched: dict[Channel, deque[_Message]] = {}
        self._written: dict[Channel, int] = {}
        self._attachments: dict[str, tuple[bytes, str]] = {}
        #: Of the files before the last: a writer holds the index of all that it has written.
        self._completed: list[FileSummary] = []
        self._ended = False
        self._file = self._new_file(0)
        self._write_metadata()

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def add_channel(self, topic: str, typename: str, qos: Iterable[Qos] = (Qos(),)) -> Channel:
        """Announce a topic of type ``package/msg/Name``; InputError where the type is unknown here."""
        channel = Channel(topic, typename, tuple(qos))
        if channel not in self._written:
            definition(typename)  # fails here, before any file knows the channel
            self._written[channel] = 0
            if depths := [q.depth for q in channel.qos if q.durability == "transient_local"]:
                self._latched[channel] = deque(maxlen=max(depths))
            if not self._file.closed:
                self._file.add_channel(channel)
        return channel

    def write(
        self,
        channel: Channel,
        data: bytes | memoryview,
        log_time_ns: int,
        publish_time_ns: int | None = None,
        sequence: int = 0,
    ) -> None:
        """Append one CDR message: received at ``log_time_ns``, sent at ``publish_time_ns``.

        ``data`` must not change any more."""
        message = _Message(data, log_time_ns, publish_time_ns or log_time_ns, sequence)
        with self._saving_what_is_whole():
            if self._file.closed:
                self._begin_next_file(log_time_ns)
            self._file.write(channel, message)
        self._written[channel] += 1
        if channel in self._latched:
            self._latched[channel].append(message)

    def write_message(self, topic: str, message: Message, log_time_ns: int) -> None:
        """Append one neutral message, announcing its topic on first use (offline writing)."""
        channel = self.add_channel(topic, message.type)
        self.write(channel, serialize(message), log_time_ns, sequence=1 + self._written[channel])

    def attach(self, name: str, data: bytes, media_type: str = "application/octet-stream") -> None:
        """Attach a file's content, for instance the calibration, to this and all later files; another of
        the same ``name`` replaces it in those."""
        self._attachments[name] = data, media_type
        if not self._file.closed:
            with self._saving_what_is_whole():
                self._file.attach(name, data, media_type)

    def flush(self) -> None:
        """Hand everything to the operating system, and to the disk once per ``sync_period``."""
        file = self._file
        if file.closed:
            return
        with self._saving_what_is_whole():
            file.flush(self._sync_period)
        if (free := shutil.disk_usage(self.path).free) < self._minimum_free:
            self.close()
            reason = f"the disk is almost full, {free >> 20} MiB left; the bag is complete so far"
            raise OSError(errno.ENOSPC, reason, str(self.path))
        if (self._split_size and file.size >= self._split_size) or (
            self._split_ns and file.duration_ns >= self._split_ns
        ):
            self.split()

    def split(self) -> None:
        """Complete the current file; the next message opens another. Nothing where it holds no message."""
        if self._file.message_count and not self._file.closed:
            with self._saving_what_is_whole():
                self._file.close()
                self._write_metadata()

    def close(self) -> None:
        """Complete the files and the metadata; harmless when repeated."""
        self._ended = True
        if not self._file.closed:
            with self._saving_what_is_whole():
                self._file.close()
                self._write_metadata()

    @property
    def message_count(self) -> int:
        """Messages written, without those repeated at the beginning of files."""
        return sum(self._written.values())

    @property
    def file(self) -> Path:
        """The last file."""
        return self._file.path

    def _new_file(self, number: int) -> _File:
        return _File(self.path / f"{self.path.name}_{number}.mcap", self._compression, self.provenance)

    def _begin_next_file(self, log_time_ns: int) -> None:
        if self._ended:
            raise ValueError(f"{self.path} is closed")
        file = self._new_file(len(self._completed) + 1)
        self._completed.append(self._file.summary())
        self._file = file
        for channel in self._written:
            file.add_channel(channel)
        for name, (data, media_type) in self._attachments.items():
            file.attach(name, data, media_type)
        for channel, messages in self._latched.items():
            for message in messages:  # received anew, as it were: files follow each other in time
                file.write(channel, message._replace(log_ns=log_time_ns))
        self._write_metadata()  # lists a file that is not complete: readers complain rather than read less

    @contextmanager
    def _saving_what_is_whole(self) -> Iterator[None]:
        try:
            yield
        except OSError:
            self._ended = True
            self._file.abandon()
            # The others are complete; reading them again would take as long as they are large.
            with suppress(OSError, InputError):
                self._write_metadata(complete_file(self._file.path).summary)
            raise

    def _write_metadata(self, last: FileSummary | None = None) -> None:
        write_metadata(self.path, [*self._completed, last or self._file.summary()], self.provenance)


class _Message(NamedTuple):
    data: bytes | memoryview
    log_ns: int
    publish_ns: int
    sequence: int


class _File:
    """One MCAP file of a bag."""

    def __init__(self, path: Path, compression: CompressionType, provenance: Mapping[str, str]) -> None:
        self.path = path
        self.counts: dict[Channel, int] = {}
        self.start_ns: int | None = None
        self.end_ns: int | None = None
        self._ids: dict[Channel, int] = {}
        self._schemas: dict[str, int] = {}
        self._provenance = provenance
        self._synced = time.monotonic()
        self._stream = DirectFile(path)
        hold(self._stream.fileno())
        # The library also writes offsets to groups of the summary that are empty, which validators refuse.
        self._writer = Writer(
            cast("IO[bytes]", self._stream), compression=compression, use_summary_offsets=False
        )
        try:
            self._writer.start(profile="ros2", library=f"mems6dof_ros {__version__}")
            self._writer.add_metadata(PROVENANCE, dict(provenance))
            self._writer.flush()
        except OSError:
            self.abandon()
            path.unlink()
            raise

    @property
    def message_count(self) -> int:
        return sum(self.counts.values())

    @property
    def size(self) -> int:
        """Bytes written so far; while it is open."""
        return self._stream.tell()

    @property
    def duration_ns(self) -> int:
        """From the first message to the last."""
        return (self.end_ns or 0) - (self.start_ns or 0)

    def summary(self) -> FileSummary:
        hashes = {channel.type: definition(channel.type).type_hash for channel in self.counts}
        return FileSummary(self.path.name, self.start_ns, self.end_ns, dict(self.counts), hashes)

    def add_channel(self, channel: Channel) -> None:
        described = definition(channel.type)
        if channel.type not in self._schemas:
            schema = described.schema.encode()
            self._schemas[channel.type] = self._writer.register_schema(channel.type, "ros2msg", schema)
        profiles = to_yaml([qos.profile() for qos in channel.qos])
        metadata = {"offered_qos_profiles": profiles, "topic_type_hash": described.type_hash}
        schema_id = self._schemas[channel.type]
        self._ids[channel] = self._writer.register_channel(channel.topic, "cdr", schema_id, metadata)
        self.counts[channel] = 0

    def write(self, channel: Channel, message: _Message) -> None:
        data, log_ns, publish_ns, sequence = message
        self._writer.add_message(self._ids[channel], log_ns, cast(bytes, data), publish_ns, sequence)
        self.counts[channel] += 1
        self.start_ns = log_ns if self.start_ns is None else min(self.start_ns, log_ns)
        self.end_ns = log_ns if self.end_ns is None else max(self.end_ns, log_ns)

    def attach(self, name: str, data: bytes, media_type: str) -> None:
        now = time.time_ns()
        self._writer.add_attachment(now, now, name, media_type, data)

    def flush(self, sync_period: float) -> None:
        self._writer.flush()
        if time.monotonic() - self._synced >= sync_period:
            self._stream.sync()
            self._synced = time.monotonic()

    def abandon(self) -> None:
        """Close without an end."""
        with suppress(OSError):
            self._stream.close()

    @property
    def closed(self) -> bool:
        return self._stream.closed

    def close(self) -> None:
        text = metadata_text([self.summary()], self._provenance)
        self._writer.add_metadata("rosbag2", {"serialized_metadata": text})
        self._writer.finish()
        self._stream.sync()
        self._stream.close()


class Recorded(NamedTuple):
    """One message of a bag; ``message`` is a ``rosbags`` message, read by attribute."""

    topic: str
    type: str
    log_time_ns: int
    message: Any


class BagReader:
    """Reads a rosbag2 directory (MCAP or sqlite3) or a single file of one; a context manager.

    Anybody's bag: types come from the definitions in the bag, else from ROS 2 Jazzy's. Of types that are
    INTERPRETED here, all fields that we know must be there.
    Raises InputError where the bag cannot be read, also while iterating.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        if not self.path.exists():
            raise InputError(str(self.path), "nothing there", "a rosbag2 directory, .mcap or .db3 file")
        if self.path.is_dir() and not (self.path / "metadata.yaml").is_file():
            raise InputError(str(self.path), "a directory without metadata.yaml", _instead_of(self.path))
        with _readable(self.path):
            self._reader = AnyReader([self.path], default_typestore=typestore())
            self._reader.open()
            for connection in self._reader.connections:
                found = connection.topic, connection.msgtype, connection.msgcount
                if tuple(map(type, found)) != (str, str, int):
                    raise TypeError(f"topic, type and count {found}")

    def __enter__(self) -> BagReader:
        return self

    def __exit__(self, *_: object) -> None:
        with suppress(AttributeError):  # rosbags forgets what metadata.yaml said, of whatever type it was
            self._reader.close()

    @property
    def topics(self) -> dict[str, str]:
        """Type of each topic."""
        return {connection.topic: connection.msgtype for connection in self._reader.connections}

    @property
    def counts(self) -> dict[str, int]:
        """Number of messages on each topic."""
        counts: dict[str, int] = {}
        for connection in self._reader.connections:
            counts[connection.topic] = counts.get(connection.topic, 0) + connection.msgcount
        return counts

    @property
    def unlisted(self) -> list[str]:
        """Names of .mcap files in the directory that the bag's metadata.yaml does not know."""
        if not self.path.is_dir():
            return []
        text = (self.path / "metadata.yaml").read_text(encoding="utf-8")
        listed = from_yaml(text)["rosbag2_bagfile_information"]["relative_file_paths"]
        return [file.name for file in mcap_files(self.path) if file.name not in map(os.path.basename, listed)]

    def messages(self, topics: Iterable[str] | None = None, threads: int = 1) -> Iterator[Recorded]:
        """Messages of ``topics`` (all by default) in the order in which they were received.

        ``threads`` read and decompress, where there are chunks that need not be merged."""
        wanted = None if topics is None else set(topics)
        chosen = [c for c in self._reader.connections if wanted is None or c.topic in wanted]
        if not chosen:
            return
        with _readable(self.path):
            for typename in {connection.msgtype for connection in chosen} & INTERPRETED:
                self._compare_definition(typename)
            types = {connection.topic: connection.msgtype for connection in chosen}
            places = None
            if threads > 1 and len(types) == len(chosen) and (files := self._files()):
                places = read_ahead.ordered_chunks(files, types)
            found: Iterable[tuple[str, int, bytes | memoryview]] = (
                ((c.topic, log_time_ns, data) for c, log_time_ns, data in self._reader.messages(chosen))
                if places is None
                else read_ahead.messages(places, threads)
            )
            for topic, log_time_ns, data in found:
                message = self._reader.deserialize(data, types[topic])  # type: ignore[arg-type]
                yield Recorded(topic, types[topic], log_time_ns, message)

    def _files(self) -> list[Path]:
        """The .mcap files in the order of the recording, none where it is of another kind."""
        if self.path.suffix == ".mcap":
            return [self.path]
        if not self.path.is_dir():
            return []
        text = (self.path / "metadata.yaml").read_text(encoding="utf-8")
        listed = from_yaml(text)["rosbag2_bagfile_information"]["relative_file_paths"]
        files = [self.path / name for name in listed]
        return files if all(file.suffix == ".mcap" for file in files) else []

    def _compare_definition(self, typename: str) -> None:
        """Raise InputError where the bag's definition lacks a field of ours, or has it of another type."""
        pending, seen = [typename], set()
        while pending:
            name = pending.pop()
            seen.add(name)
            theirs = dict(self._reader.typestore.fielddefs[name][1])
            for field, node in typestore().fielddefs[name][1]:
                if theirs.get(field) != node:
                    found = f"{name} without '{field}' as we know it"
                    raise InputError(str(self.path), found, f"{typename} as of this version")
                pending += [used for used in map(str, named_types(node)) if used not in seen]

    def attachments(self) -> dict[str, bytes]:
        """Attachments by name; of several with one name, the last."""
        found: dict[str, bytes] = {}
        with _readable(self.path):
            for reader in self._mcap_readers():
                found |= {a.name: a.data for a in reader.iter_attachments()}
        return found

    def provenance(self) -> dict[str, str]:
        """What BagWriter was told of the recording; empty for other people's bags."""
        with _readable(self.path):
            for reader in self._mcap_readers():
                for record in reader.iter_metadata():
                    if record.name == PROVENANCE:
                        return dict(record.metadata)
        return {}

    def _mcap_readers(self) -> Iterator[McapReader]:
        for path in mcap_files(self.path):
            with path.open("rb") as stream:
                yield make_reader(stream)


def _instead_of(path: Path) -> str:
    """What a directory without metadata.yaml offers instead."""
    if mcap_files(path):
        return "a rosbag2 directory; 'mems6dof recover' writes it anew"
    databases = sorted(path.glob("*.db3"))
    return f"a rosbag2 directory; or read {databases[0]} itself" if databases else "a rosbag2 directory"


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    """One error for whatever foreign parsers raise on foreign bytes."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        found = " ".join(str(error).split()).rstrip(".") or type(error).__name__
        raise InputError(str(path), found, f"a readable bag{_advice(path)}") from error


def _advice(path: Path) -> str:
    """What to do about a bag that cannot be read."""
    cut_off = [file for file in mcap_files(path) if lacks_end(file)] if path.exists() else []
    if any(map(being_written, cut_off)):
        return "; this one is being written"
    return "; 'mems6dof recover' completes one that was cut off" if cut_off else ""
