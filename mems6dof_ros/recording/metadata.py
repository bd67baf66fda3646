"""What rosbag2 wants to know of a bag: topics with their quality of service, and `metadata.yaml`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from mems6dof_ros.documents import from_yaml, to_yaml

VERSION = 9  # of rosbag2 in Jazzy; Humble reads up to 8 but takes the MCAP file alone
#: Name of the MCAP metadata record with our provenance.
PROVENANCE = "mems6dof"

INFINITE_NS = 2**63 - 1  # rmw's "unspecified" duration, as rosbag2 writes it

_DURATIONS = ("deadline", "lifespan", "liveliness_lease_duration")


@dataclass(frozen=True)
class Qos:
    """Quality of service offered by a publisher, in rosbag2's words; durations in ns."""

    history: str = "keep_last"
    depth: int = 10
    reliability: str = "reliable"
    durability: str = "volatile"
    deadline: int = INFINITE_NS
    lifespan: int = INFINITE_NS
    liveliness: str = "automatic"
    liveliness_lease_duration: int = INFINITE_NS
    avoid_ros_namespace_conventions: bool = False

    def profile(self) -> dict[str, Any]:
        """As plain data for YAML."""
        plain = asdict(self)
        for name in _DURATIONS:
            seconds, nanoseconds = divmod(plain[name], 10**9)
            plain[name] = {"sec": seconds, "nsec": nanoseconds}
        return plain

    @classmethod
    def from_profile(cls, plain: Mapping[str, Any]) -> Qos:
        """The inverse of ``profile``; TypeError, KeyError or ValueError for anything else."""
        values = {field.name: plain[field.name] for field in fields(cls) if field.name in plain}
        for name in _DURATIONS:
            if name in values:
                values[name] = int(values[name]["sec"]) * 10**9 + int(values[name]["nsec"])
        return cls(**values)


class Channel(NamedTuple):
    """A topic of a bag."""

    topic: str
    type: str
    qos: tuple[Qos, ...]


class FileSummary(NamedTuple):
    """One file of a bag: times of its first and last message (None: it has none), messages by channel, and
    the RIHS01 hashes of their types."""

    name: str
    start_ns: int | None
    end_ns: int | None
    counts: Mapping[Channel, int]
    type_hashes: Mapping[str, str]


def write_metadata(folder: Path, files: Sequence[FileSummary], custom: Mapping[str, str]) -> None:
    """Write ``metadata.yaml``: completed under another name first, so never half-written."""
    unfinished = folder / "metadata.yaml.part"
    unfinished.write_text(metadata_text(files, custom), encoding="utf-8")
    unfinished.replace(folder / "metadata.yaml")


def read_custom(folder: Path) -> dict[str, str]:
    """The ``custom`` data of ``metadata.yaml``; empty where there is none that can be read."""
    try:
        text = (folder / "metadata.yaml").read_text(encoding="utf-8")
        return dict(from_yaml(text)["rosbag2_bagfile_information"]["custom_data"])
    except (OSError, UnicodeDecodeError, yaml.YAMLError, TypeError, KeyError, ValueError):
        return {}


def metadata_text(files: Sequence[FileSummary], custom: Mapping[str, str]) -> str:
    """The text of rosbag2's metadata.yaml."""
    channels = list(dict.fromkeys(channel for file in files for channel in file.counts))
    hashes = {name: value for file in files for name, value in file.type_hashes.items()}
    topics = [
        {
            "topic_metadata": {
                "name": channel.topic,
                "type": channel.type,
                "serialization_format": "cdr",
                "offered_qos_profiles": [qos.profile() for qos in channel.qos],
                "type_description_hash": hashes.get(channel.type, ""),
            },
            "message_count": sum(file.counts.get(channel, 0) for file in files),
        }
        for channel in channels
    ]
    information = {
        "version": VERSION,
        "storage_identifier": "mcap",
        **_span(files),
        "message_count": sum(sum(file.counts.values()) for file in files),
        "topics_with_message_count": topics,
        "compression_format": "",
        "compression_mode": "",
        "relative_file_paths": [file.name for file in files],
        "files": [
            {"path": file.name, **_span([file]), "message_count": sum(file.counts.values())} for file in files
        ],
        "custom_data": dict(custom),
        "ros_distro": "jazzy",
    }
    return to_yaml({"rosbag2_bagfile_information": information})


def _span(files: Sequence[FileSummary]) -> dict[str, Any]:
    start = min((file.start_ns for file in files if file.start_ns is not None), default=0)
    end = max((file.end_ns for file in files if file.end_ns is not None), default=0)
    return {
        "duration": {"nanoseconds": end - start},
        "starting_time": {"nanoseconds_since_epoch": start},
    }
