"""A recording that is whole passes; each thing that can be missing is named."""

from __future__ import annotations

import numpy as np
import pytest

from mems6dof_ros.analysis.check import check_bag
from mems6dof_ros.errors import InputError
from mems6dof_ros.frame import Frame
from mems6dof_ros.recording import messages
from mems6dof_ros.recording.bag import BagWriter

T0 = 1_700_000_000_000_000_000


def frame(counter: int, stamp: int | None = None, dropped: int = 0) -> Frame:
    stamp_ns = T0 + 10**7 * (counter if stamp is None else stamp)
    return Frame(np.zeros((4, 4), np.uint8), stamp_ns, counter, counter, frames_dropped=dropped)


def problems(path, infos, images=None) -> list[str]:
    with BagWriter(path) as bag:
        for n, info in enumerate(infos):
            bag.write_message("/left/frame_info", messages.frame_info(info), T0 + n)
        for n, image in enumerate(infos if images is None else images):
            bag.write_message("/left/image_raw", messages.image(image), T0 + n)
    return check_bag(path).problems


def test_a_whole_recording(tmp_path):
    frames = [frame(k) for k in (3, 4, 5, 6)]
    assert problems(tmp_path / "bag", frames) == []
    assert check_bag(tmp_path / "bag").topics == {
        "/left/frame_info": ("mems6dof_msgs/msg/FrameInfo", 4),
        "/left/image_raw": ("sensor_msgs/msg/Image", 4),
    }


def test_a_loss_that_was_reported_is_accounted_for(tmp_path):
    assert problems(tmp_path / "bag", [frame(3), frame(7, dropped=3), frame(8)]) == []


def test_a_loss_that_was_not(tmp_path):
    (problem,) = problems(tmp_path / "bag", [frame(3), frame(7, dropped=1), frame(9)])
    assert problem == "/left/frame_info: 3 frames neither recorded nor reported lost"


def test_frames_without_images_and_images_without_frames(tmp_path):
    frames = [frame(k) for k in range(5)]
    found = problems(tmp_path / "bag", frames[:4], [*frames[1:3], frames[4]])
    assert found == [
        "/left/image_raw: missing for 2 of 4 frames",
        "/left/image_raw: 1 messages of frames that /left/frame_info does not know",
    ]


def test_stamps_that_go_back_or_repeat(tmp_path):
    found = problems(tmp_path / "bag", [frame(0), frame(1, 5), frame(2), frame(3, 5)], [])
    assert found == [
        "/left/frame_info: 1 stamps earlier than the one before",
        "/left/frame_info: 1 frames with the stamp of another",
    ]


def test_what_cannot_be_read(tmp_path):
    (tmp_path / "x.mcap").write_bytes(b"x" * 100)
    with pytest.raises(InputError, match=r"x\.mcap"):
        check_bag(tmp_path / "x.mcap")
