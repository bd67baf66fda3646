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
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple

import yaml
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from rosbags.highlevel import AnyReader

from mems6dof_ros import __version__
from mems6dof_ros.errors import InputError
from mems6dof_ros.recording.definitions import definition, typestore
from mems6dof_ros.recording.messages import Message, serialize
from mems6dof_ros.recording.metadata import (
    PROVENANCE,
    Channel,
    FileSummary,
    Qos,
    metadata_text,
    write_metadata,
)
from mems6dof_ros.recording.recover import recover

__all__ = ["BagReader", "BagWriter", "Channel", "Qos", "Recorded"]

COMPRESSIONS = {"none": CompressionType.NONE, "lz4": CompressionType.LZ4, "zstd": CompressionType.ZSTD}


class BagWriter:
    """Writes a rosbag2 directory of one or more MCAP files; use as a context manager.

    ``path`` is the directory, which must not exist or be empty. ``compression`` of chunks: ``none``
    keeps up with full-rate frames, ``zstd`` suits everything else. ``provenance`` goes into every
    file and into ``metadata.yaml``. ``flush`` after each motion cycle: what was flushed survives a kill
    of the process; what is older than ``sync_period`` s survives a loss of power. Leaving the context by
    an exception completes the files all the same. Not safe for use by several threads at once.

    With less than ``reserve`` bytes left on the disk, ``flush`` completes the bag and raises OSError
    (ENOSPC). Any other OSError also ends it, with what is whole completed as far as the disk allows.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        compression: str = "none",
        provenance: Mapping[str, str] | None = None,
        sync_period: float = 1.0,
        reserve: int = 64 << 20,
    ) -> None:
        self.path = Path(path)
        if compression not in COMPRESSIONS:
            raise InputError("compression", repr(compression), f"one of {', '.join(COMPRESSIONS)}")
        if self.path.exists() and (not self.path.is_dir() or any(self.path.iterdir())):
            raise InputError(str(self.path), "something there already", "a new or empty directory")
        self.path.mkdir(parents=True, exist_ok=True)
        self.provenance = {"mems6dof_ros": __version__, **(provenance or {})}
        self._compression = COMPRESSIONS[compression]
        self._sync_period, self._reserve = sync_period, reserve
        self._channels: list[Channel] = []
        self._attachments: list[tuple[str, bytes, str]] = []
        self._files: list[_File] = []
        self.split()

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def add_channel(self, topic: str, typename: str, qos: Iterable[Qos] = (Qos(),)) -> Channel:
        """Announce a topic of type ``package/msg/Name``; InputError where the type is unknown here."""
        channel = Channel(topic, typename, tuple(qos))
        if channel not in self._channels:
            definition(typename)  # fails here, before any file knows the channel
            self._channels.append(channel)
            self._files[-1].add_channel(channel)
        return channel

    def write(
        self,
        channel: Channel,
        data: bytes | memoryview,
        log_time_ns: int,
        publish_time_ns: int | None = None,
        sequence: int = 0,
    ) -> None:
        """Append one CDR message: received at ``log_time_ns``, sent at ``publish_time_ns``."""
        with self._saving_what_is_whole():
            self._files[-1].write(channel, data, log_time_ns, publish_time_ns or log_time_ns, sequence)

    def write_message(self, topic: str, message: Message, log_time_ns: int) -> None:
        """Append one neutral message, announcing its topic on first use (offline writing)."""
        channel = self.add_channel(topic, message.type)
        sequence = 1 + sum(file.counts.get(channel, 0) for file in self._files)
        self.write(channel, serialize(message), log_time_ns, sequence=sequence)

    def attach(self, name: str, data: bytes, media_type: str = "application/octet-stream") -> None:
        """Attach a file's content, for instance the calibration, to this and all later files."""
        self._attachments.append((name, data, media_type))
        with self._saving_what_is_whole():
            self._files[-1].attach(name, data, media_type)

    def flush(self) -> None:
        """Hand everything to the operating system, and to the disk once per ``sync_period``."""
        with self._saving_what_is_whole():
            self._files[-1].flush(self._sync_period)
        if shutil.disk_usage(self.path).free < self._reserve:
            self.close()
            raise OSError(errno.ENOSPC, "the disk is almost full; the bag is complete so far", str(self.path))

    def split(self) -> None:
        """Complete the current file and go on in a new one that is readable by itself."""
        if self._files:
            with self._saving_what_is_whole():
                self._files[-1].close()
        path = self.path / f"{self.path.name}_{len(self._files)}.mcap"
        self._files.append(_File(path, self._compression, self.provenance))
        for channel in self._channels:
            self._files[-1].add_channel(channel)
        for attachment in self._attachments:
            self._files[-1].attach(*attachment)
        self._write_metadata()

    def close(self) -> None:
        """Complete the files and the metadata; harmless when repeated."""
        if self._files[-1].closed:
            return
        with self._saving_what_is_whole():
            self._files[-1].close()
            self._write_metadata()

    @contextmanager
    def _saving_what_is_whole(self) -> Iterator[None]:
        try:
            yield
        except OSError:
            self._files[-1].abandon()
            with suppress(OSError, InputError):
                recover(self.path)
            raise

    @property
    def size(self) -> int:
        """Bytes flushed to the current file."""
        return self._files[-1].size

    @property
    def message_count(self) -> int:
        """Messages written to all files."""
        return sum(file.message_count for file in self._files)

    def _write_metadata(self) -> None:
        write_metadata(self.path, [file.summary() for file in self._files], self.provenance)


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
        self._stream = path.open("xb")
        # The library also writes offsets to groups of the summary that are empty, which validators refuse.
        self._writer = Writer(self._stream, compression=compression, use_summary_offsets=False)
        self._writer.start(profile="ros2", library=f"mems6dof_ros {__version__}")
        self._writer.add_metadata(PROVENANCE, dict(provenance))
        self._writer.flush()

    @property
    def message_count(self) -> int:
        return sum(self.counts.values())

    @property
    def size(self) -> int:
        return self._stream.tell() if not self._stream.closed else self.path.stat().st_size

    def summary(self) -> FileSummary:
        hashes = {channel.type: definition(channel.type).type_hash for channel in self.counts}
        return FileSummary(self.path.name, self.start_ns, self.end_ns, dict(self.counts), hashes)

    def add_channel(self, channel: Channel) -> None:
        described = definition(channel.type)
        if channel.type not in self._schemas:
            schema = described.schema.encode()
            self._schemas[channel.type] = self._writer.register_schema(channel.type, "ros2msg", schema)
        profiles = yaml.safe_dump([qos.profile() for qos in channel.qos], sort_keys=False)
        metadata = {"offered_qos_profiles": profiles, "topic_type_hash": described.type_hash}
        schema_id = self._schemas[channel.type]
        self._ids[channel] = self._writer.register_channel(channel.topic, "cdr", schema_id, metadata)
        self.counts[channel] = 0

    def write(
        self, channel: Channel, data: bytes | memoryview, log_ns: int, publish_ns: int, sequence: int
    ) -> None:
        self._writer.add_message(self._ids[channel], log_ns, bytes(data), publish_ns, sequence)
        self.counts[channel] += 1
        self.start_ns = log_ns if self.start_ns is None else min(self.start_ns, log_ns)
        self.end_ns = log_ns if self.end_ns is None else max(self.end_ns, log_ns)

    def attach(self, name: str, data: bytes, media_type: str) -> None:
        now = time.time_ns()
        self._writer.add_attachment(now, now, name, media_type, data)

    def flush(self, sync_period: float) -> None:
        self._writer.flush()
        if time.monotonic() - self._synced >= sync_period:
            os.fsync(self._stream.fileno())
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
        self._stream.flush()
        os.fsync(self._stream.fileno())
        self._stream.close()


class Recorded(NamedTuple):
    """One message of a bag; ``message`` is a ``rosbags`` message, read by attribute."""

    topic: str
    type: str
    log_time_ns: int
    message: Any


class BagReader:
    """Reads a rosbag2 directory (MCAP or sqlite3) or a single file of one; a context manager.

    Anybody's bag: types come from the definitions in the bag, else from ROS 2 Jazzy's.
    Raises InputError where the bag cannot be read, also while iterating.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        if not self.path.exists():
            raise InputError(str(self.path), "nothing there", "a rosbag2 directory, .mcap or .db3 file")
        with _readable(self.path):
            self._reader = AnyReader([self.path], default_typestore=typestore())
            self._reader.open()

    def __enter__(self) -> BagReader:
        return self

    def __exit__(self, *_: object) -> None:
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

    def messages(self, topics: Iterable[str] | None = None) -> Iterator[Recorded]:
        """Messages of ``topics`` (all by default) in the order in which they were received."""
        wanted = None if topics is None else set(topics)
        chosen = [c for c in self._reader.connections if wanted is None or c.topic in wanted]
        if not chosen:
            return
        with _readable(self.path):
            for connection, log_time_ns, data in self._reader.messages(chosen):
                message = self._reader.deserialize(data, connection.msgtype)
                yield Recorded(connection.topic, connection.msgtype, log_time_ns, message)

    def attachments(self) -> dict[str, bytes]:
        """Attachments by name, of the first MCAP file that has them."""
        with _readable(self.path):
            for path in self._mcap_files():
                with path.open("rb") as stream:
                    found = {a.name: a.data for a in make_reader(stream).iter_attachments()}
                if found:
                    return found
        return {}

    def provenance(self) -> dict[str, str]:
        """What BagWriter was told of the recording; empty for other people's bags."""
        with _readable(self.path):
            for path in self._mcap_files():
                with path.open("rb") as stream:
                    for record in make_reader(stream).iter_metadata():
                        if record.name == PROVENANCE:
                            return dict(record.metadata)
        return {}

    def _mcap_files(self) -> list[Path]:
        paths = sorted(self.path.glob("*.mcap")) if self.path.is_dir() else [self.path]
        return [path for path in paths if path.suffix == ".mcap"]


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    """One error for whatever foreign parsers raise on foreign bytes."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        found = " ".join(str(error).split()) or type(error).__name__
        mcap = path.suffix == ".mcap" or any(path.glob("*.mcap"))
        advice = "; 'mems6dof recover' completes one that was cut off" if mcap else ""
        raise InputError(str(path), found, f"a readable bag{advice}") from error
