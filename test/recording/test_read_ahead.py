"""Reading bags by several threads gives what one gives."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from mems6dof_ros.errors import InputError
from mems6dof_ros.frame import Frame
from mems6dof_ros.recording import messages, read_ahead
from mems6dof_ros.recording.bag import BagReader, BagWriter
from mems6dof_ros.recording.recover import mcap_files
from mems6dof_ros.sources.bag import BagSource
from mems6dof_ros.sources.source import frames

COUNT = 9


def shots() -> Iterator[Frame]:
    rng = np.random.default_rng(3)
    for number in range(COUNT):
        image = rng.integers(0, 4096, (64, 96)).astype(np.uint16)
        yield Frame(image, 10**9 + number * 10**7, number, 3 * number)


def write(path: Path, compression: str, *, split: bool = False, backwards: bool = False) -> Path:
    with BagWriter(path, compression=compression, split_size=1 if split else 0) as bag:
        for shot in sorted(shots(), key=lambda shot: -shot.stamp_ns if backwards else shot.stamp_ns):
            bag.write_message("/frame_info", messages.frame_info(shot), shot.stamp_ns)
            bag.write_message("/image_raw", messages.image(shot), shot.stamp_ns)
            if shot.frame_counter % 2:
                bag.flush()
    return path


def same(one: list[Frame], other: list[Frame]) -> None:
    assert len(one) == len(other) == COUNT
    for a, b in zip(one, other, strict=True):
        assert np.array_equal(a.image, b.image)
        assert (a.stamp_ns, a.cycle, a.frame_counter) == (b.stamp_ns, b.cycle, b.frame_counter)


def spy(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """How often chunks are read ahead."""
    calls: list[int] = []
    real = read_ahead.messages

    def messages(places: list, threads: int) -> Iterator[read_ahead.Serialized]:
        calls.append(threads)
        return real(places, threads)

    monkeypatch.setattr(read_ahead, "messages", messages)
    return calls


@pytest.mark.parametrize("compression", ["none", "lz4", "zstd"])
@pytest.mark.parametrize("split", [False, True])
@pytest.mark.parametrize("threads", [2, 5])
def test_frames_are_the_same(
    tmp_path: Path, compression: str, split: bool, threads: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    bag = write(tmp_path / "bag", compression, split=split)
    assert (len(mcap_files(bag)) > 1) == split
    serial, ahead = BagSource(bag), BagSource(bag)
    ahead.threads, calls = threads, spy(monkeypatch)
    same(list(frames(serial)), list(frames(ahead)))
    assert calls == [threads]
    same(list(frames(serial)), list(shots()))
    if not split:
        alone = BagSource(mcap_files(bag)[0])
        alone.threads = threads
        same(list(frames(serial)), list(frames(alone)))


def test_chunks_that_overlap_are_merged(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bag = write(tmp_path / "bag", "zstd", backwards=True)
    assert read_ahead.ordered_chunks(mcap_files(bag), ["/image_raw"]) is None
    source, calls = BagSource(bag), spy(monkeypatch)
    source.threads = 3
    same(list(frames(source)), list(shots()))
    assert calls == []


def test_a_damaged_chunk_is_refused(tmp_path: Path) -> None:
    bag = write(tmp_path / "bag", "none")
    path = mcap_files(bag)[0]
    content = bytearray(path.read_bytes())
    content[content.index(next(shots()).image.tobytes()) + 100] ^= 1
    path.write_bytes(content)
    for threads in (1, 2):
        with BagReader(bag) as reader, pytest.raises(InputError, match=r"checksum|damaged"):
            list(reader.messages(["/image_raw"], threads))


def test_who_stops_early_leaves_no_thread(tmp_path: Path) -> None:
    bag = write(tmp_path / "bag", "zstd")
    before = threading.active_count()
    with BagReader(bag) as reader:
        found = reader.messages(["/image_raw"], 2)
        next(found)
        found.close()  # type: ignore[attr-defined]
    assert threading.active_count() == before
