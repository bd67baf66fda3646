"""Frames out of bags: our own, disordered ones, other people's."""

from __future__ import annotations

import math
import os
from dataclasses import fields

import numpy as np
import pytest
from mcap_ros2.writer import Writer as Ros2Writer
from rosbags.rosbag2 import StoragePlugin, Writer

from mems6dof_ros.errors import InputError
from mems6dof_ros.frame import Frame, GroundTruth
from mems6dof_ros.recording import messages
from mems6dof_ros.recording.bag import BagWriter
from mems6dof_ros.recording.definitions import definition, typestore
from mems6dof_ros.sources.source import frames, open_source

T0 = 1_700_000_000_000_000_000


def make_frame(k: int, bodies: int = 2) -> Frame:
    truth = tuple(
        GroundTruth(
            f"gear_{b}",
            np.eye(3),
            np.zeros(3),
            float(k),
            np.arange(2, dtype=np.int32),
            np.ones((2, 3)),
            np.ones(2),
        )
        for b in range(bodies)
    )
    return Frame(
        image=np.full((6, 8), 1000 + k, np.uint16),
        stamp_ns=T0 + k * 11_111_111,
        frame_counter=100 + 2 * k,
        cycle=200 + k,
        frames_dropped=1,
        stage_z=1e-6,
        pixel_size=1.2734e-7,
        exposure_s=0.004,
        saturation_adu=4095,
        source="simulator",
        live=True,
        truth=truth,
    )


def parts(frame: Frame, namespace: str = "/mems6dof"):
    yield f"{namespace}/frame_info", messages.frame_info(frame)
    yield f"{namespace}/image_raw", messages.image(frame)
    for truth in messages.ground_truths(frame):
        yield f"{namespace}/truth", truth


def test_everything_comes_back(tmp_path):
    written = [make_frame(k) for k in range(7)]
    with BagWriter(tmp_path / "bag", compression="zstd") as bag:
        for frame in written:
            for topic, message in parts(frame):
                bag.write_message(topic, message, frame.stamp_ns + 5)
    for path in (tmp_path / "bag", tmp_path / "bag" / "bag_0.mcap"):
        source = open_source("bag", path=path)
        assert (source.info.frames, source.info.encoding, source.info.pixel_size) == (7, "mono16", 1.2734e-7)
        read = list(frames(source))
        for a, b in zip(written, read, strict=True):
            assert np.array_equal(a.image, b.image)
            same = {f.name for f in fields(Frame)} - {"image", "truth", "source", "live"}
            assert all(getattr(a, name) == getattr(b, name) for name in same)
            assert (b.source, b.live) == ("bag", False)
            assert [t.body for t in b.truth] == ["gear_0", "gear_1"]


@pytest.mark.parametrize("seed", range(5))
def test_parts_of_a_frame_find_each_other_in_disorder(tmp_path, seed):
    rng = np.random.default_rng(seed)
    written = [make_frame(k) for k in range(20)]
    pieces = [(k + rng.uniform(0, 1.5), piece) for k, frame in enumerate(written) for piece in parts(frame)]
    with BagWriter(tmp_path / "bag") as bag:
        for n, (_, (topic, message)) in enumerate(sorted(pieces, key=lambda p: p[0])):
            bag.write_message(topic, message, T0 + n)
    read = list(frames(open_source("bag", path=tmp_path / "bag")))
    assert sorted(f.frame_counter for f in read) == [f.frame_counter for f in written]
    assert all(len(f.truth) == 2 and f.pixel_size == 1.2734e-7 for f in read)


@pytest.mark.parametrize("storage", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_bags_of_rosbags_with_images_only(tmp_path, storage):
    with Writer(tmp_path / "bag", version=8, storage_plugin=storage) as bag:
        topic = bag.add_connection("/camera/image", "sensor_msgs/msg/Image", typestore=typestore())
        for k in range(5):
            bag.write(topic, T0 + k, messages.serialize(messages.image(make_frame(k))))
    read = list(frames(open_source("bag", path=tmp_path / "bag")))
    assert [f.stamp_ns for f in read] == [make_frame(k).stamp_ns for k in range(5)]
    assert [f.frame_counter for f in read] == [f.cycle for f in read] == list(range(5))
    assert math.isnan(read[0].pixel_size)
    assert read[3].image[0, 0] == 1003


def test_bags_of_mcap_ros2_support(tmp_path):
    with (tmp_path / "other.mcap").open("wb") as stream:
        writer = Ros2Writer(stream)
        schema = writer.register_msgdef("sensor_msgs/msg/Image", definition("sensor_msgs/msg/Image").schema)
        for k in range(4):
            image = {
                "header": {"stamp": {"sec": 5 + k, "nanosec": 7}, "frame_id": "cam"},
                "height": 2,
                "width": 3,
                "encoding": "8UC1",
                "is_bigendian": 0,
                "step": 3,
                "data": bytes([k] * 6),
            }
            writer.write_message("/cam/image_raw", schema, image, log_time=T0 + k, publish_time=T0 + k)
        writer.finish()
    read = list(frames(open_source("bag", path=tmp_path / "other.mcap")))
    assert [f.stamp_ns for f in read] == [(5 + k) * 10**9 + 7 for k in range(4)]
    assert [int(f.image[0, 0]) for f in read] == [0, 1, 2, 3]
    assert read[0].frame_id == "cam"


def test_images_without_stamps_are_all_kept(tmp_path):
    with BagWriter(tmp_path / "bag") as bag:
        for k in range(5):
            bag.write_message(
                "/image_raw", messages.image(Frame(np.full((4, 4), k, np.uint8), 0, k, k)), T0 + k
            )
    assert [int(f.image[0, 0]) for f in frames(open_source("bag", path=tmp_path / "bag"))] == [0, 1, 2, 3, 4]


def test_the_topic_is_chosen_or_asked_for(tmp_path):
    with BagWriter(tmp_path / "bag") as bag:
        for name in ("left/image_raw", "right/image_raw"):
            bag.write_message(f"/{name}", messages.image(make_frame(len(name))), T0)
        bag.write_message("/frame_info", messages.frame_info(make_frame(0)), T0)
    with pytest.raises(InputError, match=r"2 topics with images.*/left/image_raw, /right/image_raw"):
        open_source("bag", path=tmp_path / "bag")
    with pytest.raises(InputError, match="no images on topic '/middle'"):
        open_source("bag", path=tmp_path / "bag", topic="/middle")
    right = open_source("bag", path=tmp_path / "bag", topic="/right/image_raw")
    assert next(frames(right)).image[0, 0] == 1000 + len("right/image_raw")


def test_bags_that_cannot_be_read(tmp_path):
    with BagWriter(tmp_path / "bag") as bag:
        for k in range(10):
            bag.write_message("/image_raw", messages.image(make_frame(k)), T0 + k)
            bag.flush()
    file = tmp_path / "bag" / "bag_0.mcap"
    os.truncate(file, file.stat().st_size // 2)
    with pytest.raises(InputError, match="expected a readable bag"):
        open_source("bag", path=tmp_path / "bag")
    with BagWriter(tmp_path / "poses") as bag:
        bag.write_message("/frame_info", messages.frame_info(make_frame(0)), T0)
    with pytest.raises(InputError, match="no images"):
        open_source("bag", path=tmp_path / "poses")
    (tmp_path / "no.mcap").write_bytes(b"hello")
    with pytest.raises(InputError, match=r"no\.mcap"):
        open_source("bag", path=tmp_path / "no.mcap")
    (tmp_path / "folder").mkdir()
    with pytest.raises(InputError, match="folder"):
        open_source("bag", path=tmp_path / "folder")


def test_a_bad_image_is_refused_and_the_next_one_read(tmp_path):
    with BagWriter(tmp_path / "bag") as bag:
        for k in range(4):
            image = messages.image(make_frame(k))
            if k == 1:
                image.fields["encoding"] = "rgb8"
            bag.write_message("/image_raw", image, T0 + k)
    source = open_source("bag", path=tmp_path / "bag")
    source.start()
    assert source.read().frame_counter == 0
    with pytest.raises(InputError, match="rgb8"):
        source.read()
    assert source.read().image[0, 0] == 1002
