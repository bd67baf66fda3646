"""Files that are written past the cache hold what was written."""

from __future__ import annotations

import errno
import itertools
import os
import random
from pathlib import Path

import pytest

from mems6dof_ros.nodes.shared_memory import FOLDER
from mems6dof_ros.recording.direct_file import LARGE, DirectFile

SIZES = [
    5,
    LARGE,
    LARGE - 1,
    4096,
    9 * LARGE + 17,
    0,
    3 * LARGE + 4096,
    LARGE,
    1,
    8 * LARGE,
    2 * LARGE + 4095,
]


def write(path: Path) -> bytes:
    """Records of SIZES; returns what ought to be there."""
    written = []
    file = DirectFile(path)
    for number, size in enumerate(SIZES):
        data = random.Random(number).randbytes(size)
        assert file.write(memoryview(data) if number % 2 else data) == size
        written.append(data)
        assert file.tell() == sum(map(len, written))
        if number % 3 == 0:
            file.flush()
            assert path.read_bytes() == b"".join(written)  # with the operating system, if not on the disk
    file.sync()
    file.close()
    file.close()
    assert file.closed
    return b"".join(written)


def test_what_is_written_is_there(tmp_path: Path) -> None:
    assert write(tmp_path / "file") == (tmp_path / "file").read_bytes()


def test_large_records_go_past_the_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As far as whole blocks go."""
    parts = []
    write_at = os.pwrite
    monkeypatch.setattr(
        os, "pwrite", lambda f, data, at: parts.append((at, len(data))) or write_at(f, data, at)
    )
    write(tmp_path / "file")
    if not parts:
        pytest.skip("this file system offers no direct writes")
    assert all(at % 4096 == 0 and size % 4096 == 0 for at, size in parts)
    large = sum(size for size in SIZES if size >= LARGE)
    assert large - 2 * 4096 * len(SIZES) < sum(size for _, size in parts) <= large


@pytest.mark.parametrize("refused", [0, 3])
def test_a_file_system_without_direct_writes_gets_it_all_by_the_cache(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, refused: int
) -> None:
    """From the first, or from some later one on."""
    count, write_at = itertools.count(), os.pwrite

    def pwrite(file: int, data: memoryview, at: int) -> int:
        if next(count) >= refused:
            raise OSError(errno.EINVAL, "Invalid argument")
        return write_at(file, data, at)

    monkeypatch.setattr(os, "pwrite", pwrite)
    assert write(tmp_path / "file") == (tmp_path / "file").read_bytes()


def test_a_disk_in_memory_serves_too() -> None:
    path = FOLDER / f"mems6dof_test_{os.getpid()}"
    try:
        assert write(path) == path.read_bytes()
    finally:
        path.unlink()


def test_parts_may_be_written_in_part(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_at = os.pwrite
    monkeypatch.setattr(
        os, "pwrite", lambda f, data, at: write_at(f, data[: max(len(data) // 8192, 1) * 4096], at)
    )
    assert write(tmp_path / "file") == (tmp_path / "file").read_bytes()


def test_a_full_disk_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def pwrite(file: int, data: memoryview, at: int) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "pwrite", pwrite)
    file = DirectFile(tmp_path / "file")
    with pytest.raises(OSError, match="No space left") as raised:
        file.write(bytes(LARGE))
    assert raised.value.errno == errno.ENOSPC
    file.close()


def test_an_existing_file_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"a record")
    with pytest.raises(FileExistsError):
        DirectFile(tmp_path / "file")
    assert (tmp_path / "file").read_bytes() == b"a record"
