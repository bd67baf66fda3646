"""Text files of plain values: one clear error for whatever is wrong."""

from __future__ import annotations

import os

import pytest

from mems6dof_ros.documents import read_document, write_whole
from mems6dof_ros.errors import InputError

BOMB = "\n".join(
    ["a0: &a0 [1, 1, 1, 1]", *(f"a{k}: &a{k} [*a{k - 1}, *a{k - 1}, *a{k - 1}]" for k in range(1, 40))]
)


@pytest.mark.parametrize(
    ("language", "content", "reason"),
    [
        ("YAML", b"a: [1, 2", "no valid YAML"),
        ("YAML", b"a: 2001-99-99", "no valid YAML"),
        ("YAML", b"\xff\xfe\x00", "no text"),
        ("YAML", b"[" * 20_000, "nested too deeply|no valid YAML"),
        ("YAML", BOMB.encode(), "references that multiply"),
        ("YAML", b"[" * 200 + b"]" * 200, "nested too deeply"),
        ("JSON", b"{", "no valid JSON"),
        ("JSON", b"[" * 200_000, "nested too deeply"),
        ("JSON", b"9" * 100_000, "no valid JSON"),
    ],
)
def test_what_is_no_document_is_refused(tmp_path, language, content, reason):
    path = tmp_path / "file"
    path.write_bytes(content)
    with pytest.raises(InputError, match=reason) as refused:
        read_document(path, language, "a good file")
    assert "\n" not in str(refused.value)
    with pytest.raises(InputError, match="No such file"):
        read_document(tmp_path / "absent", language, "a good file")


def test_documents_are_read(tmp_path):
    path = tmp_path / "file"
    path.write_text("a: &a [1, 2]\nb: *a\n")
    assert read_document(path, "YAML", "") == {"a": [1, 2], "b": [1, 2]}
    path.write_text("")
    assert read_document(path, "YAML", "") is None
    path.write_text('{"x": [1.5, NaN]}')
    assert read_document(path, "JSON", "")["x"][0] == 1.5


def test_a_file_is_written_whole(tmp_path):
    path = tmp_path / "file.yaml"
    for text in ("z: 1 µm\n", "z: 2 µm\n"):
        write_whole(path, text)
        assert path.read_text(encoding="utf-8") == text
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("name", [".", "absent/file", "file/below", 300 * "n"])
def test_where_no_file_can_be_written_is_said(tmp_path, name):
    (tmp_path / "file").write_text("kept")
    with pytest.raises(InputError, match="expected a file that can be written"):
        write_whole(tmp_path / name, "text")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
    assert (tmp_path / "file").read_text() == "kept"


def test_a_device_is_written_to_not_replaced(tmp_path):
    device = tmp_path / "null"
    device.symlink_to(os.devnull)
    write_whole(device, "text")
    assert device.is_char_device()
