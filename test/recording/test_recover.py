"""Bags without their end: completed in place, with every whole message."""

from __future__ import annotations

import os
import random
import shutil
from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap.records import Message as McapMessage
from mcap.stream_reader import StreamReader

from mems6dof_ros.errors import InputError
from mems6dof_ros.recording import messages
from mems6dof_ros.recording.bag import BagReader, BagWriter, Qos
from mems6dof_ros.recording.recover import interrupted, recover

T0 = 1_700_000_000_000_000_000


@pytest.fixture(params=["none", "zstd"])
def bag(request, tmp_path, make) -> Path:
    """60 messages on 2 topics in 15 chunks, an attachment, and the end."""
    with BagWriter(tmp_path / "bag", compression=request.param, provenance={"seed": "7"}) as writer:
        writer.attach("calibration.yaml", b"text")
        latched = Qos(durability="transient_local", depth=1)
        for k in range(30):
            message = messages.frame_info(make.frame())
            channel = writer.add_channel("/frame_info", message.type, (latched,))
            writer.write(channel, messages.serialize(message), T0 + 2 * k)
            writer.write_message(
                "/localizations", messages.localizations(make.localizations()), T0 + 2 * k + 1
            )
            if k % 2:
                writer.flush()
    return tmp_path / "bag"


def read(path: Path) -> list[int]:
    with BagReader(path) as reader:
        reader.provenance(), reader.attachments()
        return [recorded.log_time_ns - T0 for recorded in reader.messages()]


def test_a_complete_bag_is_left_as_it_is(bag):
    before = {file.name: file.read_bytes() for file in bag.iterdir()}
    (result,) = recover(bag)
    assert (result.complete, result.messages, result.lost) == (True, 60, 0)
    assert {file.name: file.read_bytes() for file in bag.iterdir()} == before  # metadata.yaml included


def test_cut_anywhere_every_whole_chunk_comes_back(bag, tmp_path):
    file = bag / "bag_0.mcap"
    whole = file.read_bytes()
    with file.open("rb") as stream:
        ends = [
            i.chunk_start_offset + i.chunk_length for i in make_reader(stream).get_summary().chunk_indexes
        ]
    assert len(ends) == 15
    for cut in sorted(random.Random(1).sample(range(200, len(whole)), 20)) + ends:
        shutil.rmtree(tmp_path / "cut", ignore_errors=True)
        shutil.copytree(bag, tmp_path / "cut")
        os.truncate(tmp_path / "cut" / "bag_0.mcap", cut)
        expected = list(range(4 * sum(end <= cut for end in ends)))
        (result,) = recover(tmp_path / "cut")
        assert (result.messages, result.complete) == (len(expected), False)
        for path in (tmp_path / "cut", tmp_path / "cut" / "bag_0.mcap"):
            assert read(path) == expected
        with (tmp_path / "cut" / "bag_0.mcap").open("rb") as stream:  # a reader that uses the index
            found = [m.log_time - T0 for _, _, m in make_reader(stream).iter_messages()]
        assert found == expected
        (again,) = recover(tmp_path / "cut")
        assert again.complete


def test_what_stands_beside_the_messages_survives(bag):
    file = bag / "bag_0.mcap"
    os.truncate(file, file.stat().st_size - 30)
    recover(bag)
    with BagReader(bag) as reader:
        assert reader.provenance()["seed"] == "7"
        assert reader.attachments() == {"calibration.yaml": b"text"}
        connection = next(c for c in reader._reader.connections if c.topic == "/frame_info")
        assert connection.digest.startswith("RIHS01_")
        assert connection.ext.offered_qos_profiles[0].durability.name == "TRANSIENT_LOCAL"


def test_garbage_behind_the_cut_is_removed(bag):
    file = bag / "bag_0.mcap"
    data = file.read_bytes()[:-3000]
    for tail in (bytes(5000), random.Random(2).randbytes(5000)):
        file.write_bytes(data + tail)
        (result,) = recover(bag)
        assert not result.complete
        assert read(bag) == list(range(result.messages))
        assert result.messages > 0


@pytest.mark.parametrize("seed", range(3))
def test_fuzzed_files_give_an_error_or_a_part(bag, tmp_path, seed):
    """Bits flipped, pieces removed: no exception but InputError, neither in reading nor in recovering."""
    rng = random.Random(seed)
    whole = (bag / "bag_0.mcap").read_bytes()
    target = tmp_path / "fuzzed.mcap"
    outcomes, lines = {"read": 0, "refused": 0}, set()
    for _ in range(40):
        data = bytearray(whole)
        for _ in range(rng.choice((1, 1, 3, 30))):
            data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
        if rng.random() < 0.3:
            start = rng.randrange(len(data))
            del data[start : start + rng.randrange(1, 2000)]
        target.write_bytes(data)
        for prepare in (lambda: None, lambda: recover(target)):
            try:
                prepare()
                read(target)
                outcomes["read"] += 1
            except InputError as error:
                outcomes["refused"] += 1
                lines.add(str(error).count("\n"))
    assert lines <= {0}
    assert outcomes["read"] > 10
    assert outcomes["refused"] > 10


def test_other_files_are_refused_and_left_alone(tmp_path):
    (tmp_path / "notes.mcap").write_text("my notes")
    with pytest.raises(InputError, match="no MCAP file"):
        recover(tmp_path / "notes.mcap")
    assert (tmp_path / "notes.mcap").read_text() == "my notes"
    with pytest.raises(InputError, match="No such file"):
        recover(tmp_path / "absent.mcap")
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=r"no \.mcap file"):
        recover(tmp_path / "empty")
    (tmp_path / "empty" / "empty_0.db3").touch()
    with pytest.raises(InputError, match="an sqlite3 bag"):
        recover(tmp_path / "empty")
    (tmp_path / "zero.mcap").touch()
    with pytest.raises(InputError, match="an empty file"):
        recover(tmp_path / "zero.mcap")


def test_a_bag_that_is_being_written_is_left_alone(tmp_path):
    with BagWriter(tmp_path / "bag") as writer:
        notes = writer.add_channel("/notes", "std_msgs/msg/String")
        data = messages.serialize(messages.Message("std_msgs/msg/String", {"data": "x"}))
        for k in range(20):
            writer.write(notes, data, T0 + k)
            writer.flush()
            if k == 5:
                writer.split()
        before = (tmp_path / "bag" / "bag_1.mcap").read_bytes()
        with pytest.raises(InputError, match=r"bag_1\.mcap: found a file that is being written"):
            recover(tmp_path / "bag")
        assert (tmp_path / "bag" / "bag_1.mcap").read_bytes() == before
        with pytest.raises(InputError, match="this one is being written"):
            BagReader(tmp_path / "bag")
        assert not interrupted(tmp_path / "bag")
        for k in range(20, 30):
            writer.write(notes, data, T0 + k)
            writer.flush()
    assert [result.complete for result in recover(tmp_path / "bag")] == [True, True]
    assert read(tmp_path / "bag") == list(range(30))


def test_a_directory_named_like_a_file_is_none(bag):
    (bag / "bag_0.mcap").unlink()
    (bag / "bag_0.mcap").mkdir()
    with pytest.raises(InputError, match="Is a directory"):
        BagReader(bag)
    with pytest.raises(InputError, match=r"no \.mcap file"):
        recover(bag)
    assert not interrupted(bag)


def test_damage_in_the_middle_costs_that_chunk_only(bag):
    """The chunk is set aside; the reader that goes by the index and the one that reads on pass over it."""
    file = bag / "bag_0.mcap"
    with file.open("rb") as stream:
        chunks = make_reader(stream).get_summary().chunk_indexes
    data = bytearray(file.read_bytes())
    for hit in (0, 3, 14):  # the first one announces the channels
        data[chunks[hit].chunk_start_offset + chunks[hit].chunk_length - 5] ^= 1
    file.write_bytes(data)
    (result,) = recover(bag)
    expected = [k for k in range(60) if k // 4 not in (0, 3, 14)]
    lost = sum(chunks[hit].chunk_length for hit in (0, 3, 14))
    assert result == (file, False, len(expected), lost)
    assert read(bag) == expected
    with file.open("rb") as stream:
        found = [r.log_time - T0 for r in StreamReader(stream).records if isinstance(r, McapMessage)]
    assert found == expected
    assert recover(bag)[0].complete


def test_an_end_that_contradicts_the_data_is_written_anew(bag):
    file = bag / "bag_0.mcap"
    whole = file.read_bytes()
    with file.open("rb") as stream:
        start = make_reader(stream).get_summary().chunk_indexes[-1]
    position = whole.rindex(start.chunk_start_offset.to_bytes(8, "little"))
    file.write_bytes(whole[:position] + b"\0" + whole[position + 1 :])
    (result,) = recover(bag)
    assert (result.complete, result.messages, result.lost) == (False, 60, 0)
    assert read(bag) == list(range(60))


def test_a_split_bag_is_completed_as_a_whole(tmp_path):
    """Killed in its third file, which was only begun in the fourth, without metadata.yaml."""
    latched = Qos(durability="transient_local", depth=1)
    with BagWriter(tmp_path / "bag", provenance={"seed": "7"}) as writer:
        notes = writer.add_channel("/notes", "std_msgs/msg/String", (latched,))
        for k in range(12):
            if k in (4, 8):
                writer.split()
            writer.write(
                notes, messages.serialize(messages.Message("std_msgs/msg/String", {"data": str(k)})), T0 + k
            )
            writer.flush()
    last = tmp_path / "bag" / "bag_2.mcap"
    os.truncate(last, last.stat().st_size - 700)
    (tmp_path / "bag" / "bag_3.mcap").touch()
    (tmp_path / "bag" / "metadata.yaml").unlink()
    with pytest.raises(InputError, match="a directory without metadata"):
        BagReader(tmp_path / "bag")
    assert [result.complete for result in recover(tmp_path / "bag")] == [True, True, False]
    with BagReader(tmp_path / "bag") as reader:
        assert [m.message.data for m in reader.messages()] == [
            *("0", "1", "2", "3"),
            *("3", "4", "5", "6", "7"),
            *("7", "8", "9", "10", "11"),
        ]
        assert reader.counts == {"/notes": 14}
        assert reader.unlisted == ["bag_3.mcap"]
