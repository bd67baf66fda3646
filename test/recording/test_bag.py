"""Bags as other people's readers see them, and as a crash leaves them."""

from __future__ import annotations

import gc
import os
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
import yaml
from mcap.reader import make_reader
from mcap.records import ChunkIndex
from mcap.records import Message as McapMessage
from mcap.stream_reader import StreamReader
from mcap.writer import Writer
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from rosbags.interfaces import QosDurability, QosReliability

from mems6dof_ros.errors import InputError
from mems6dof_ros.frame import Frame
from mems6dof_ros.recording import messages
from mems6dof_ros.recording.bag import BagReader, BagWriter, Qos
from mems6dof_ros.recording.definitions import definition
from mems6dof_ros.recording.recover import recover

T0 = 1_700_000_000_000_000_000
INFO = "mems6dof_msgs/msg/FrameInfo"


def frame(k: int) -> Frame:
    image = np.full((32, 48), k % 251, np.uint8)
    return Frame(image=image, stamp_ns=T0 + k * 10**7, frame_counter=k, cycle=k, source="test")


def write_bag(path: Path, count: int = 10, **options) -> None:
    with BagWriter(path, provenance={"seed": "7"}, **options) as bag:
        bag.attach("calibration.json", b"{}", "application/json")
        info = bag.add_channel("/frame_info", INFO, (Qos(durability="transient_local", depth=3),))
        for k in range(count):
            data = messages.serialize(messages.frame_info(frame(k)))
            bag.write(info, data, T0 + k * 10**7 + 500, T0 + k * 10**7 + 100, sequence=k)
            bag.write_message("/image_raw", messages.image(frame(k)), T0 + k * 10**7 + 600)
            bag.flush()


@pytest.mark.parametrize("compression", ["none", "lz4", "zstd"])
def test_rosbags_reads_it_back(tmp_path, compression):
    write_bag(tmp_path / "bag", compression=compression)
    with AnyReader([tmp_path / "bag"]) as reader:
        connections = {c.topic: c for c in reader.connections}
        assert reader.message_count == 20
        assert connections["/frame_info"].msgcount == 10
        qos = connections["/frame_info"].ext.offered_qos_profiles[0]
        assert (qos.depth, qos.durability) == (3, QosDurability.TRANSIENT_LOCAL)
        assert qos.reliability == QosReliability.RELIABLE
        assert connections["/frame_info"].digest == definition(INFO).type_hash
        read = [
            reader.deserialize(data, c.msgtype)
            for c, _, data in reader.messages([connections["/frame_info"]])
        ]
    assert [m.frame_counter for m in read] == list(range(10))


def test_mcap_ros2_reads_it_back_with_everything_beside_the_messages(tmp_path):
    write_bag(tmp_path / "bag", compression="zstd")
    with (tmp_path / "bag" / "bag_0.mcap").open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        assert reader.get_header().profile == "ros2"
        summary = reader.get_summary()
        decoded = list(reader.iter_decoded_messages(topics=["/frame_info"]))
        every = list(reader.iter_messages())
        attachments = {a.name: a.data for a in reader.iter_attachments()}
        metadata = {m.name: m.metadata for m in reader.iter_metadata()}
    assert summary.statistics.message_count == 20
    assert summary.statistics.chunk_count == len(summary.chunk_indexes) == 10
    for schema in summary.schemas.values():
        assert schema.encoding == "ros2msg"
        text = schema.data.decode()
        assert "MSG: std_msgs/Header" in text
        assert "MSG: builtin_interfaces/Time" in text
        assert text == definition(schema.name).schema
    info = next(s for s in summary.schemas.values() if s.name == INFO).data.decode()
    assert "# m, image pixel size in object space" in info
    for channel in summary.channels.values():
        assert channel.message_encoding == "cdr"
        assert channel.metadata["topic_type_hash"].startswith("RIHS01_")
        assert yaml.safe_load(channel.metadata["offered_qos_profiles"])[0]["reliability"] == "reliable"
    sequences = [m.sequence for _, c, m in every if c.topic == "/image_raw"]
    assert sequences == list(range(1, 11))
    _, _, message, ros = decoded[3]
    assert (message.log_time, message.publish_time, message.sequence) == (T0 + 30000500, T0 + 30000100, 3)
    assert (ros.frame_counter, ros.header.frame_id, ros.source) == (3, "microscope", "test")
    assert attachments == {"calibration.json": b"{}"}
    assert metadata["mems6dof"]["seed"] == "7"
    inner = yaml.safe_load(metadata["rosbag2"]["serialized_metadata"])
    assert inner["rosbag2_bagfile_information"]["message_count"] == 20


def test_metadata_file(tmp_path):
    write_bag(tmp_path / "bag")
    information = yaml.safe_load((tmp_path / "bag" / "metadata.yaml").read_text())[
        "rosbag2_bagfile_information"
    ]
    assert information["version"] == 9
    assert information["storage_identifier"] == "mcap"
    assert information["starting_time"]["nanoseconds_since_epoch"] == T0 + 500
    assert information["duration"]["nanoseconds"] == 90_000_100
    topics = {t["topic_metadata"]["name"]: t for t in information["topics_with_message_count"]}
    assert topics["/image_raw"]["message_count"] == 10
    assert (
        topics["/image_raw"]["topic_metadata"]["type_description_hash"]
        == definition("sensor_msgs/msg/Image").type_hash
    )
    assert information["files"][0]["path"] == "bag_0.mcap"
    assert information["relative_file_paths"] == ["bag_0.mcap"]
    assert information["custom_data"]["seed"] == "7"
    assert not list((tmp_path / "bag").glob("*.part"))


def test_every_file_of_a_split_bag_stands_alone(tmp_path):
    with BagWriter(tmp_path / "bag") as bag:
        bag.attach("calibration.json", b"{}")
        for k in range(6):
            if k in (2, 4):
                bag.split()
            bag.write_message("/frame_info", messages.frame_info(frame(k)), T0 + k)
    with BagReader(tmp_path / "bag") as whole:
        assert [m.message.frame_counter for m in whole.messages()] == list(range(6))
        assert whole.counts == {"/frame_info": 6}
    for part in range(3):
        with BagReader(tmp_path / "bag" / f"bag_{part}.mcap") as single:
            assert [m.message.frame_counter for m in single.messages()] == [2 * part, 2 * part + 1]
            assert single.attachments() == {"calibration.json": b"{}"}


def test_files_are_split_between_cycles_and_read_as_one(tmp_path):
    """By size, by time and by request; latched messages and attachments stand in each file."""
    latched = Qos(durability="transient_local", depth=2)
    notes = [messages.Message("std_msgs/msg/String", {"data": text}) for text in "abc"]
    options = {"size": {"split_size": 20_000}, "time": {"split_duration": 0.1}, "request": {}}
    for name, option in options.items():
        with BagWriter(tmp_path / name, **option) as bag:
            channel = bag.add_channel("/notes", "std_msgs/msg/String", (latched,))
            for k, note in enumerate(notes):
                bag.write(channel, messages.serialize(note), T0 + k, T0 + k, sequence=k)
            for k in range(31):
                bag.write_message("/frame_info", messages.frame_info(frame(k)), T0 + k * 10**7)
                bag.write_message("/image_raw", messages.image(frame(k)), T0 + k * 10**7 + 5)
                bag.flush()
                if k == 3:
                    bag.attach("parameters.yaml", b"{}")
                if name == "request" and k in (9, 20, 30):
                    bag.split()
                    bag.split()  # nothing to complete
        files = sorted((tmp_path / name).glob("*.mcap"), key=lambda file: int(file.stem.rpartition("_")[2]))
        assert len(files) == {"size": 5, "time": 3, "request": 3}[name], name
        with AnyReader([tmp_path / name]) as reader:
            times = [time for _, time, _ in reader.messages()]
            repeated = 2 * (len(files) - 1)
            assert times == sorted(times)
            assert len(times) == reader.message_count == 65 + repeated
            assert {c.topic: c.msgcount for c in reader.connections}["/notes"] == 3 + repeated
        metadata = yaml.safe_load((tmp_path / name / "metadata.yaml").read_text())
        information = metadata["rosbag2_bagfile_information"]
        assert information["relative_file_paths"] == [file.name for file in files]
        counters = []
        for file, listed in zip(files, information["files"], strict=True):
            with file.open("rb") as stream:
                reader = make_reader(stream, decoder_factories=[DecoderFactory()])
                found = list(reader.iter_decoded_messages())
                assert listed["message_count"] == len(found) == reader.get_summary().statistics.message_count
                assert [a.name for a in reader.iter_attachments()] == ["parameters.yaml"]
            assert [m.data for _, c, _, m in found if c.topic == "/notes"][-2:] == ["b", "c"]
            first = found[0][2]
            assert listed["starting_time"]["nanoseconds_since_epoch"] == first.log_time
            assert file == files[0] or (first.sequence, first.publish_time) == (1, T0 + 1)
            infos = [m.frame_counter for _, c, _, m in found if c.topic == "/frame_info"]
            images = [m.header.stamp for _, c, _, m in found if c.topic == "/image_raw"]
            assert len(infos) == len(images)  # no cycle is torn apart
            if name == "size":
                assert file == files[-1] or 20_000 <= file.stat().st_size < 32_000
            counters += infos
        assert counters == list(range(31))


def test_a_completed_file_leaves_no_index_in_memory(tmp_path):
    """An index is a kilobyte per cycle: without end in a night."""

    def indexes() -> int:
        gc.collect()
        return sum(isinstance(thing, ChunkIndex) for thing in gc.get_objects())

    before = indexes()
    with BagWriter(tmp_path / "bag") as bag:
        for k in range(40):
            bag.write_message("/frame_info", messages.frame_info(frame(k)), k)
            bag.flush()
            if k % 10 == 9:
                bag.split()
        assert indexes() - before == 10  # of the last file


def test_an_exception_while_writing_loses_nothing(tmp_path):
    with suppress(RuntimeError), BagWriter(tmp_path / "bag") as bag:
        for k in range(500):
            bag.write_message("/frame_info", messages.frame_info(frame(k)), T0 + k)
        raise RuntimeError
    with BagReader(tmp_path / "bag") as bag:
        assert sum(1 for _ in bag.messages()) == 500


KILLED = """
import os, signal, sys
sys.path[:0] = {path!r}
from test_bag import *
bag = BagWriter(sys.argv[1], compression="zstd")
for k in range(1000):
    bag.write_message("/frame_info", messages.frame_info(frame(k)), T0 + k)
    if k % 7 == 6:
        bag.flush()
    if k == 800:
        os.kill(os.getpid(), signal.SIGKILL)
"""


def test_a_killed_writer_leaves_everything_flushed(tmp_path):
    path = [str(Path(__file__).parent), str(Path(__file__).parents[2])]
    script = KILLED.format(path=path)
    killed = subprocess.run([sys.executable, "-c", script, str(tmp_path / "bag")], check=False, timeout=120)
    assert killed.returncode == -signal.SIGKILL
    count = 0
    with (tmp_path / "bag" / "bag_0.mcap").open("rb") as stream, suppress(Exception):  # the cut itself
        for record in StreamReader(stream).records:
            count += isinstance(record, McapMessage)
    assert count == 798  # 114 flushes of 7
    assert (tmp_path / "bag" / "metadata.yaml").exists()


def test_refusals(tmp_path):
    write_bag(tmp_path / "bag", 1)
    with pytest.raises(InputError, match="something there already"):
        BagWriter(tmp_path / "bag")
    with pytest.raises(InputError, match="'gzip'"):
        BagWriter(tmp_path / "other", compression="gzip")
    with BagWriter(tmp_path / "third") as bag, pytest.raises(InputError, match="unknown message type"):
        bag.add_channel("/x", "nobody_msgs/msg/Nothing")
    with pytest.raises(InputError, match="nothing there"):
        BagReader(tmp_path / "absent")


def test_a_truncated_bag_is_one_clear_error(tmp_path):
    write_bag(tmp_path / "bag")
    file = tmp_path / "bag" / "bag_0.mcap"
    os.truncate(file, file.stat().st_size // 2)
    with pytest.raises(InputError, match="expected a readable bag"), BagReader(tmp_path / "bag") as bag:
        list(bag.messages())


def test_sqlite_bags_of_rosbags_are_read(tmp_path):
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as RosbagsWriter

    from mems6dof_ros.recording.definitions import typestore

    with RosbagsWriter(tmp_path / "bag", version=8, storage_plugin=StoragePlugin.SQLITE3) as writer:
        connection = writer.add_connection("/image_raw", "sensor_msgs/msg/Image", typestore=typestore())
        for k in range(3):
            writer.write(connection, T0 + k, messages.serialize(messages.image(frame(k))))
    with BagReader(tmp_path / "bag") as bag:
        assert [m.message.data[0] for m in bag.messages(["/image_raw"])] == [0, 1, 2]


def test_messages_of_another_version_are_refused(tmp_path):
    """A definition that lacks a field of ours or has it of another type, itself or in what it is made of."""
    ours = definition("sensor_msgs/msg/Image").schema
    for k, (old, new) in enumerate([("uint32 step", "uint16 step"), ("uint32 nanosec", "uint32 rest")]):
        assert old in ours
        with (tmp_path / f"{k}.mcap").open("wb") as stream:
            writer = Writer(stream)
            writer.start(profile="ros2")
            schema = writer.register_schema(
                "sensor_msgs/msg/Image", "ros2msg", ours.replace(old, new).encode()
            )
            channel = writer.register_channel("/image_raw", "cdr", schema)
            writer.add_message(channel, T0, bytes(messages.serialize(messages.image(frame(0)))), T0)
            writer.finish()
        reason = ("'step' as we know it", "builtin_interfaces/msg/Time")[k]
        with pytest.raises(InputError, match=reason), BagReader(tmp_path / f"{k}.mcap") as bag:
            list(bag.messages())


def test_an_almost_full_disk_ends_with_a_complete_bag(tmp_path, monkeypatch):
    from mems6dof_ros.recording import bag as module

    class Usage:
        free = 10**12

    monkeypatch.setattr(module.shutil, "disk_usage", lambda path: Usage)
    bag = BagWriter(tmp_path / "bag")
    for k in range(7):
        bag.write_message("/frame_info", messages.frame_info(frame(k)), T0 + k)
        Usage.free = 10**6 if k == 6 else 10**12
        if k < 6:
            bag.flush()
    with pytest.raises(OSError, match="almost full"):
        bag.flush()
    with BagReader(tmp_path / "bag") as bag:
        assert [m.message.frame_counter for m in bag.messages()] == list(range(7))


LIMITED = """
import resource, sys
sys.path[:0] = {path!r}
from test_bag import *
resource.setrlimit(resource.RLIMIT_FSIZE, ({limit}, {limit}))
bag = BagWriter(sys.argv[1])
written = flushed = 0
try:
    for k in range(100000):
        bag.write_message("/frame_info", messages.frame_info(frame(k)), T0 + k)
        written += 1
        bag.write_message("/image_raw", messages.image(frame(k)), T0 + k)
        if k % 5 == 4:
            bag.flush()
            flushed = written
except OSError as error:
    print(flushed, written, type(error).__name__)
bag.close()
"""


@pytest.mark.parametrize("limit", [200_000, 201_111, 222_222])
def test_a_disk_that_refuses_keeps_what_was_flushed(tmp_path, limit):
    path = [str(Path(__file__).parent), str(Path(__file__).parents[2])]
    script = LIMITED.format(path=path, limit=limit)
    command = [sys.executable, "-c", script, str(tmp_path / "bag")]
    done = subprocess.run(command, check=True, timeout=120, capture_output=True, text=True)
    flushed, written, _ = done.stdout.split()
    assert 20 < int(flushed) <= int(written) <= int(flushed) + 5
    recover(tmp_path / "bag")  # where there was no room even for the end
    with BagReader(tmp_path / "bag") as bag:
        counters = [m.message.frame_counter for m in bag.messages(["/frame_info"])]
    assert counters == list(range(int(flushed)))
