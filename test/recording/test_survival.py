"""What `mems6dof validate lab` measures, in small: crashes, disks, damaged files, bags of others."""

from __future__ import annotations

import os
import random
import re
import threading
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from mems6dof_ros.analysis.check import check_bag
from mems6dof_ros.calibration.file import load_calibration
from mems6dof_ros.errors import InputError
from mems6dof_ros.frame import Frame
from mems6dof_ros.recording.validation import bags, fuzzing
from mems6dof_ros.recording.validation.mutation import BYTE_FAULTS, contradicted, to_yaml
from mems6dof_ros.sources.bag import BagSource
from mems6dof_ros.sources.source import frames as frames_of


@pytest.fixture(scope="module")
def originals(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return fuzzing.write_originals(tmp_path_factory.mktemp("fuzzing") / "originals")


@pytest.mark.parametrize(
    ("kind", "count"),
    [("bag", 25), ("images", 30), ("calibration", 8), ("bodies", 30)],
)
def test_damaged_files_end_in_one_line_or_in_a_part(originals, tmp_path, kind, count):
    told: list[str] = []
    answers = list(fuzzing.fuzz(kind, originals, count, 1, tmp_path, told.append))
    outcomes = Counter(answer.outcome for answer in answers)
    assert outcomes.keys() <= {"read", "refused", "part"}, told
    assert outcomes["refused"] + outcomes["part"] >= count // 4  # the faults are faults
    assert max(answer.memory for answer in answers) < fuzzing.MEMORY_LIMIT
    assert max(answer.seconds for answer in answers) < fuzzing.TIME_LIMIT


@pytest.mark.parametrize("version", ["[1]", "{}", "1.5", "text", "99"])
def test_a_calibration_of_an_impossible_version_is_refused(originals, tmp_path, version):
    text = (originals / "calibration" / "optics.yaml").read_text()
    path = tmp_path / "optics.yaml"
    path.write_text(re.sub(r"^version: .*", f"version: {version}", text, flags=re.MULTILINE))
    with pytest.raises(InputError, match="version"):
        load_calibration(path)


def test_the_originals_are_good(originals):
    """Else every refusal above would prove nothing."""
    for kind in ("bag", "images", "constellation"):
        with fuzzing._Reader(kind) as reader:
            for path in sorted((originals / kind).iterdir()):
                assert reader.read(path).outcome == "read", path


def test_a_reader_that_dies_or_hangs_is_seen(tmp_path, monkeypatch):
    """Opening a pipe that nobody writes to never returns."""
    path = tmp_path / "endless.tif"
    os.mkfifo(path)
    with fuzzing._Reader("images") as reader:
        monkeypatch.setattr(fuzzing, "TIME_LIMIT", 3.0)
        assert reader.read(path).outcome == "hang"
        assert reader._process is None  # begun anew for the next file
        monkeypatch.setattr(fuzzing, "TIME_LIMIT", 60.0)
        threading.Timer(2.0, lambda: reader._process.kill()).start()
        answer = reader.read(path)
        assert (answer.outcome, answer.reason) == ("crash", "exit status -9")
    with fuzzing._Reader("no such kind") as reader:
        answer = reader.read(path)
    assert answer.outcome == "defect"
    assert "KeyError" in answer.reason


def test_every_fault_changes_a_file():
    data = random.Random(1).randbytes(20_000)
    for name, fault in BYTE_FAULTS.items():
        changed = bytearray(data)
        fault(random.Random(2), changed)
        assert changed != data, name
    text = "a: 1\nb: [1.5, text]\nc: {d: true}\n"
    contents = {contradicted(random.Random(k), text, to_yaml) for k in range(50)}
    assert len(contents) > 30


@pytest.mark.parametrize("name", bags.WRITERS)
def test_bags_of_others_give_their_frames(tmp_path, name):
    rng = np.random.default_rng(1)
    frames = [
        Frame(rng.integers(0, 4096, (64, 96)).astype(np.uint16), 10**18 + k * 10**7 + k, k, k)
        for k in range(20)
    ]
    path = bags.WRITERS[name](tmp_path / "bag", frames)
    read = list(frames_of(BagSource(path)))
    assert [frame.stamp_ns for frame in read] == [frame.stamp_ns for frame in frames]
    assert all((a.image == b.image).all() for a, b in zip(read, frames, strict=True))
    assert check_bag(path).problems == []
