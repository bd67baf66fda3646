"""Frames by the memory that a source and a localizer on one host share."""

from __future__ import annotations

import gc
import os
import signal
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from peers import SMALL_GEAR, NodeProcess, Peer
from rclpy.duration import Duration
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import Image

from mems6dof_msgs.msg import Localizations
from mems6dof_ros.frame import Frame
from mems6dof_ros.nodes import image_route
from mems6dof_ros.nodes.recorded_images import RecordedImages
from mems6dof_ros.nodes.shared_frames import SLOTS, FrameRing, SharedFrames, ring_path
from mems6dof_ros.nodes.shared_memory import FOLDER, remove_abandoned
from mems6dof_ros.recording import messages
from mems6dof_ros.recording.bag import BagReader
from mems6dof_ros.simulation.experiment import motion_frames
from mems6dof_ros.simulation.settings import SimulationSettings

Start = Callable[..., NodeProcess]

RNG = np.random.default_rng(5)


def frame(number: int, kind: type = np.uint16, size: tuple[int, int] = (48, 64)) -> Frame:
    pixels = RNG.integers(0, np.iinfo(kind).max, size).astype(kind)
    return Frame(pixels, stamp_ns=1000 + number, frame_counter=number, cycle=number)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return ring_path("/lab/frame_info", 7, tmp_path)


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_frames_come_back_without_a_copy(path: Path, kind: type) -> None:
    ring, reader = FrameRing(path, 48 * 64 * 2), SharedFrames(path)
    assert not ring.wanted
    reader.attend()
    assert ring.wanted
    written = [frame(number, kind) for number in range(SLOTS + 3)]
    for one in written:
        ring.write(one)
    for one in written[3:]:
        header = messages.to_rclpy(messages.header(one.stamp_ns, one.frame_id))
        image = reader.find(header, one.stamp_ns)
        assert image is not None
        back = messages.to_frame(image)
        assert back.image.dtype == kind
        assert np.array_equal(back.image, one.image)
        assert np.shares_memory(back.image, image.data)
        assert (back.stamp_ns, back.frame_id) == (one.stamp_ns, one.frame_id)
        with pytest.raises(ValueError, match="read-only"):
            back.image[0, 0] = 1
    assert reader.find(None, written[0].stamp_ns) is None  # its place is taken
    assert reader.find(None, 0) is None  # no stamp tells nothing apart
    ring.close()
    assert not path.exists()


def test_a_frame_that_is_overwritten_is_known(path: Path) -> None:
    ring, reader = FrameRing(path, 48 * 64 * 2), SharedFrames(path)
    reader.attend()
    ring.write(frame(0))
    image = reader.find(None, 1000)
    assert image is not None
    assert image.written_since() == 0
    for number in range(1, SLOTS):
        ring.write(frame(number))
    assert image.intact()
    assert image.written_since() == SLOTS - 1
    assert not reader.overtaken(1000)
    ring.write(frame(SLOTS))
    assert not image.intact()
    assert reader.overtaken(1000)
    assert not reader.overtaken(1000 + SLOTS + 1)  # of whom nobody wrote


def test_of_two_frames_with_one_stamp_the_later_is_found(path: Path) -> None:
    ring, reader = FrameRing(path, 48 * 64 * 2), SharedFrames(path)
    reader.attend()
    ring.write(frame(0))
    again = frame(0)
    ring.write(again)
    image = reader.find(messages.to_rclpy(messages.header(1000, "")), 1000)
    assert np.array_equal(messages.image_pixels(image), again.image)


def test_a_frame_greater_than_was_said_stays_out(path: Path) -> None:
    ring, reader = FrameRing(path, 48 * 64 * 2), SharedFrames(path)
    reader.attend()
    ring.write(frame(0, size=(480, 640)))
    assert reader.find(None, 1000) is None


def test_a_reader_follows_to_the_ring_of_a_later_source(path: Path) -> None:
    reader = SharedFrames(path)
    reader.attend()
    assert reader.find(None, 1000) is None
    first = FrameRing(path, 48 * 64)
    reader.attend()
    second = FrameRing(path, 48 * 64 * 2)  # in place of the first, which may have been killed
    first.close()
    assert path.exists()
    assert not second.wanted
    reader.attend()
    second.write(frame(0))
    assert reader.find(None, 1000) is not None
    second.close()
    reader.attend()
    assert reader.find(None, 1000) is None


def test_what_is_no_ring_is_left_alone(path: Path) -> None:
    for content in (b"", b"\1" * 10_000):
        path.write_bytes(content)
        reader = SharedFrames(path)
        reader.attend()
        assert reader.find(None, 1000) is None
        assert path.read_bytes() == content
        path.unlink()


def test_without_room_there_is_no_ring(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    few = os.statvfs_result((4096, 4096, 100, 20_000, 20_000, 0, 0, 0, 0, 255))  # 78 MiB free
    monkeypatch.setattr(os, "statvfs", lambda _: few)
    with pytest.raises(OSError, match="192 MiB for shared frames, 78 MiB free"):
        FrameRing(path, 2048 * 2048 * 2)
    assert not path.exists()


def test_only_rings_of_dead_sources_are_removed(path: Path) -> None:
    ring = FrameRing(path, 48 * 64)
    os.utime(path, (time.time() - 60,) * 2)
    assert remove_abandoned(path.parent) == 0
    os.close(ring._file)  # with its memory, as the kernel does for a killed process
    del ring
    gc.collect()
    assert remove_abandoned(path.parent) == SLOTS * 2 * 4096 + 4096
    assert not path.exists()


@pytest.mark.parametrize("info_first", [True, False])
def test_an_image_is_recorded_once_and_again_with_its_stamp(
    path: Path, monkeypatch: pytest.MonkeyPatch, info_first: bool
) -> None:
    """By the topic at first, from memory when the recording begins anew."""
    monkeypatch.setattr(image_route, "ring_path", lambda *_: path)
    context, health = SimpleNamespace(get_domain_id=lambda: 7), SimpleNamespace(gauge=lambda *_: None)
    node: Any = SimpleNamespace(resolve_topic_name=lambda name: f"/{name}", context=context, health=health)
    recorded: list[bytes] = []
    lost: list[str] = []
    images = RecordedImages(
        node,
        lambda: None,
        lambda: None,
        lambda data, about: recorded.append(bytes(data)),
        lambda number, why: lost.append(why),
    )
    shot = frame(1)
    info, image = (bytes(messages.serialize(of(shot))) for of in (messages.frame_info, messages.image))
    arrivals = [lambda: images.on_info(info, {}), lambda: images.on_image(image, {})]
    for arrive in arrivals if info_first else arrivals[::-1]:
        arrive()
    assert recorded == [image]
    ring = FrameRing(path, shot.image.nbytes)
    images.tick()
    ring.write(shot)
    images.on_info(info, {})
    assert recorded == [image, image]
    images.on_image(image, {})  # by the topic, too
    assert recorded == [image, image]
    assert not lost
    ring.close()


# Live -----------------------------------------------------------------------------------------------


def by(peer: Peer, way: str, node: str = "localizer") -> bool:
    """The ``node`` says last that images come to it this ``way``."""
    said = [
        pair.value
        for array in peer.received["/diagnostics"]
        for status in array.status
        for pair in status.values
        if pair.key == "images by" and status.name.endswith(node)
    ]
    return bool(said) and said[-1] == way


def test_a_localizer_leaves_the_topic_and_comes_back(
    start: Start, peer: Peer, domain: int, calibration: str
) -> None:
    peer.listen(Localizations, "localizations")
    peer.listen(DiagnosticArray, "/diagnostics")
    localizer = start("localizer", "-p", f"calibration:={calibration}")
    localizer.wait_for_line("ready")
    small = [word for name, value in SMALL_GEAR.items() for word in ("-p", f"simulator.{name}:={value}")]
    arguments = ["-p", "rate:=40.0", "-p", "simulator.loop:=4", "-p", "simulator.frame_rate:=40.0"]
    source = start("frame_source", *arguments, *small)
    found: list[Any] = peer.received["localizations"]
    peer.wait(lambda: by(peer, "shared memory"))
    assert ring_path("/frame_info", domain, FOLDER).exists()
    assert peer.node.count_subscribers("image_raw") == 0
    here = len(found)
    peer.wait(lambda: len(found) > here + 40)
    counters = [message.frame_counter for message in found]
    assert counters == list(range(counters[0], counters[0] + len(counters)))  # also over the change
    assert min(len(message.x) for message in found) > 0.7 * max(len(message.x) for message in found)

    source.stop(signal.SIGKILL)
    peer.wait(lambda: by(peer, "topic"))
    # Somebody else's camera, which tells nothing of its frames.
    camera = peer.publisher(Image, "image_raw")
    last = found[-1].header.stamp.sec
    for shot in motion_frames(SimulationSettings(**SMALL_GEAR), 4):
        late = Frame(shot.image, (last + 10 + shot.cycle) * 10**9, shot.frame_counter, shot.cycle)
        camera.publish(messages.to_rclpy(messages.image(late)))
    peer.wait(lambda: sum(message.header.stamp.sec > last + 5 for message in found) == 4)
    assert localizer.stop() == 0
    ring_path("/frame_info", domain, FOLDER).unlink()  # of the source that was killed


@pytest.mark.parametrize("told", ["image_raw, frame_info", "image_raw"])
def test_a_recorder_takes_each_frame_once(
    start: Start, peer: Peer, domain: int, tmp_path: Path, told: str
) -> None:
    """Out of memory while the source sets the pace, and from the topic of who tells nothing of it."""
    peer.listen(DiagnosticArray, "/diagnostics")
    output = tmp_path / "bag"
    recorder = start("recorder", "-p", f"topics:=[{told}]", "-p", f"output:={output}")
    recorder.wait_for_line("active")
    small = [word for name, value in SMALL_GEAR.items() for word in ("-p", f"simulator.{name}:={value}")]
    for _ in range(2):  # the second with the stamps of the first
        source = start("frame_source", "-p", "rate:=40.0", "-p", "simulator.loop:=4", *small)
        peer.wait(lambda: by(peer, "shared memory", "recorder"))
        assert peer.node.count_subscribers("image_raw") == 0
        seen = len(peer.received["/diagnostics"])
        peer.wait(lambda seen=seen: len(peer.received["/diagnostics"]) > seen + 3)  # seconds
        assert source.stop() == 0
        peer.wait(lambda: by(peer, "topic", "recorder"))
    camera = peer.publisher(Image, "image_raw")
    other = frame(10**9)
    camera.publish(messages.to_rclpy(messages.image(other)))
    assert camera.wait_for_all_acked(Duration(seconds=10.0))
    assert recorder.stop() == 0

    shots = [shot.image for shot in motion_frames(SimulationSettings(**SMALL_GEAR), 4)]
    with BagReader(output) as bag:
        assert set(bag.topics) == {f"/{name}" for name in told.split(", ")}
        images = [found.message for found in bag.messages(["/image_raw"])]
        infos = [found.message for found in bag.messages(["/frame_info"])]
    stamps = [messages.nanoseconds(image.header.stamp) for image in images]
    assert stamps.pop() == other.stamp_ns
    assert np.array_equal(messages.to_frame(images.pop()).image, other.image)
    if infos:
        told_of = [messages.nanoseconds(info.header.stamp) for info in infos]
        assert stamps == told_of[told_of.index(stamps[0]) :]
    (seam,) = np.flatnonzero(np.diff(stamps) <= 0) + 1
    for run in (images[:seam], images[seam:]):
        assert len(run) > 60
        first = next(k for k in range(4) if np.array_equal(messages.image_pixels(run[0]), shots[k]))
        for number, image in enumerate(run, start=first):
            back = messages.to_frame(image)
            assert np.array_equal(back.image, shots[number % 4])
            assert (back.frame_id, image.encoding, image.step) == ("microscope", "mono16", 2 * image.width)


def test_a_camera_driver_that_promises_nothing_is_heard(start: Start, peer: Peer, calibration: str) -> None:
    """Best effort, as sensor data goes by custom, and begun after the localizer."""
    peer.listen(Localizations, "localizations")
    localizer = start("localizer", "-p", f"calibration:={calibration}")
    localizer.wait_for_line("ready")
    camera = peer.node.create_publisher(Image, "image_raw", qos_profile_sensor_data)
    peer.wait(camera.get_subscription_count)
    for number, shot in enumerate(motion_frames(SimulationSettings(**SMALL_GEAR), 3)):
        camera.publish(messages.to_rclpy(messages.image(shot)))
        peer.wait(lambda number=number: len(peer.received["localizations"]) > number)
    assert localizer.stop() == 0


@pytest.mark.parametrize("share", ["true", "false"])
def test_results_are_the_same_by_either_way(
    start: Start, peer: Peer, calibration: str, share: str, tmp_path_factory: pytest.TempPathFactory
) -> None:
    peer.listen(Localizations, "localizations")
    localizer = start("localizer", "-p", f"calibration:={calibration}")
    localizer.wait_for_line("ready")
    peer.wait(lambda: peer.node.count_publishers("localizations"))
    small = [word for name, value in SMALL_GEAR.items() for word in ("-p", f"simulator.{name}:={value}")]
    cycles = ["-p", "simulator.cycles:=12", "-p", "pacing:=consumer", "-p", f"share_frames:={share}"]
    assert start("frame_source", *cycles, *small).wait() == 0
    found = peer.received["localizations"]
    peer.wait(lambda: len(found) == 12)
    kept = tmp_path_factory.getbasetemp() / "localizations_by_either_way.npy"
    places = np.concatenate([np.column_stack([m.x, m.y, m.z]) for m in found])
    if kept.exists():
        assert np.array_equal(np.load(kept), places, equal_nan=True)
    np.save(kept, places)
    assert localizer.stop() == 0
