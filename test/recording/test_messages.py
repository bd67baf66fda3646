"""Core types survive the way through messages of both worlds."""

from __future__ import annotations

from dataclasses import fields, is_dataclass, replace

import numpy as np
import pytest

from mems6dof_ros.errors import InputError
from mems6dof_ros.frame import Frame, GroundTruth
from mems6dof_ros.localization.localizations import Flag, GaussianFits, Latency, Localizations
from mems6dof_ros.pose.cycle_pose import CyclePose, PaperAngles, Status
from mems6dof_ros.recording import messages

RNG = np.random.default_rng(1)
STAMP = 1_700_000_000_123_456_789


def through_rosbags(message):
    return messages.deserialize(messages.serialize(message), message.type)


def through_rclpy(message):
    serialization = pytest.importorskip("rclpy.serialization", reason="needs rclpy")
    pytest.importorskip("mems6dof_msgs.msg", reason="needs the generated messages")
    built = messages.to_rclpy(message)
    return serialization.deserialize_message(serialization.serialize_message(built), type(built))


@pytest.fixture(params=[through_rosbags, through_rclpy])
def transport(request):
    return request.param


def assert_equal(a, b):
    if is_dataclass(a):
        for field in fields(a):
            assert_equal(getattr(a, field.name), getattr(b, field.name))
    elif isinstance(a, tuple):
        assert len(a) == len(b)
        for x, y in zip(a, b, strict=True):
            assert_equal(x, y)
    elif isinstance(a, (np.ndarray, float)):
        np.testing.assert_allclose(b, a, rtol=0, atol=1e-15)
    else:
        assert a == b


def rotation():
    q, r = np.linalg.qr(RNG.normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q * np.sign(np.linalg.det(q))


def make_frame(dtype=np.uint16, n=5):
    truth = GroundTruth(
        body="load_gear",
        rotation=rotation(),
        translation=RNG.normal(size=3) * 1e-6,
        psi=12.3,
        particle_id=np.arange(n, dtype=np.int32),
        position=RNG.normal(size=(n, 3)) * 1e-4,
        electrons=RNG.uniform(1e4, 1e5, n),
    )
    return Frame(
        image=RNG.integers(0, np.iinfo(dtype).max, (7, 9)).astype(dtype),
        stamp_ns=STAMP,
        frame_counter=2**40,
        cycle=17,
        frames_dropped=3,
        device_time_ns=99,
        exposure_s=0.005,
        stage_z=1e-6,
        pixel_size=1.2734e-7,
        saturation_adu=4095,
        source="simulator",
        live=True,
        published_ns=STAMP + 5,
        truth=(truth,),
    )


def make_localizations(n=6):
    fits = GaussianFits(
        parameters=RNG.uniform(0.1, 0.9, (n, 7)),
        covariance=np.full((n, 7, 7), np.nan),
        chi_square=RNG.uniform(size=n),
        iterations=np.zeros(n, np.int32),
        flags=np.full(n, Flag.POOR_FIT, np.uint32),
    )
    return Localizations(
        stamp_ns=STAMP,
        frame_id="microscope",
        frame_counter=4,
        cycle=5,
        position=RNG.normal(size=(n, 3)),
        covariance=RNG.normal(size=(n, 3, 3)),
        fits=fits,
        z_gap=np.full(n, np.nan),
        flags=fits.flags | np.uint32(Flag.NO_Z),
        calibration_id="abc",
        frames_dropped=1,
        published_ns=STAMP + 7,
        frame_published_ns=STAMP + 6,
        latency=Latency(capture=1.0, queue=2.0),
    )


def make_pose(status=Status.TRACKING, n=6):
    known = status is Status.TRACKING
    fill = 1.0 if known else np.nan
    return CyclePose(
        stamp_ns=STAMP,
        frame_id="microscope",
        frame_counter=4,
        cycle=5,
        body="load_gear",
        status=status,
        reason="" if known else "too few particles",
        reference_version=2,
        rotation=rotation() if known else np.full((3, 3), np.nan),
        translation=RNG.normal(size=3) * fill,
        covariance=RNG.normal(size=(6, 6)) * fill,
        displacement=RNG.normal(size=6) * fill,
        displacement_covariance=RNG.normal(size=(6, 6)) * fill,
        angles=PaperAngles(1.0, 2.0, 3.0, 0.1, 0.2, 0.3, True, False),
        increment=RNG.normal(size=6) * fill,
        increment_covariance=RNG.normal(size=(6, 6)) * fill,
        increment_cycles=1,
        residual_rms_xy=1e-9,
        residual_rms_z=5e-8,
        chi_square=1.1,
        particles_used=n,
        particles_seen=n + 1,
        particles_expected=n + 2,
        particle_id=np.arange(n, dtype=np.int32),
        residual=RNG.normal(size=(n, 3)).astype(np.float32).astype(float),
        latency=Latency(pose=0.001, total=0.02),
    )


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_frame(transport, dtype):
    frame = make_frame(dtype)
    truth = messages.to_ground_truth(transport(messages.ground_truths(frame)[0]))
    image, info = transport(messages.image(frame)), transport(messages.frame_info(frame))
    again = messages.to_frame(image, info, (truth,))
    assert again.image.dtype == dtype
    assert_equal(frame, again)
    camera = transport(messages.camera_info(frame))
    assert (camera.height, camera.width) == frame.image.shape


@pytest.mark.parametrize("n", [0, 6])
def test_localizations(transport, n):
    found = make_localizations(n)
    assert_equal(found, messages.to_localizations(transport(messages.localizations(found))))


@pytest.mark.parametrize("status", [Status.TRACKING, Status.LOST])
def test_pose(transport, status):
    cycle_pose = make_pose(status)
    assert_equal(cycle_pose, messages.to_cycle_pose(transport(messages.pose6dof(cycle_pose))))


def test_the_three_pose_messages_agree(transport):
    cycle_pose = make_pose()
    full = transport(messages.pose6dof(cycle_pose))
    with_covariance = transport(messages.pose_with_covariance_stamped(cycle_pose))
    plain = transport(messages.pose_stamped(cycle_pose))
    assert full.header == with_covariance.header == plain.header
    assert str(full.pose) == str(with_covariance.pose)
    assert str(full.pose.pose) == str(plain.pose)


def test_foreign_layouts_of_an_image():
    frame = make_frame()
    image = messages.to_rosbags(messages.image(frame))
    padded = np.zeros((7, 24), np.uint8)
    padded[:, :18] = frame.image.astype(">u2").view(np.uint8)
    foreign = replace(image, step=24, is_bigendian=1, encoding="16UC1", data=padded.reshape(-1))
    assert np.array_equal(messages.image_pixels(foreign), frame.image)


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"encoding": "rgb8"}, "encoding 'rgb8'"),
        ({"encoding": "32FC1"}, "encoding '32FC1'"),
        ({"height": 0}, "empty image"),
        ({"step": 17}, "step 17 B"),
        ({"step": 2**31}, "126 B of data"),
        ({"height": 8}, "126 B of data"),
        ({"data": np.zeros(0, np.uint8)}, "0 B of data"),
    ],
)
def test_contradictory_images_are_refused(change, complaint):
    image = replace(messages.to_rosbags(messages.image(make_frame())), **change)
    with pytest.raises(InputError, match=complaint):
        messages.image_pixels(image)


def test_localizations_of_unequal_length_are_refused():
    message = messages.to_rosbags(messages.localizations(make_localizations(6)))
    with pytest.raises(InputError, match=r"Localizations\.covariance.*expected 54"):
        messages.to_localizations(replace(message, covariance=message.covariance[:-1]))
    with pytest.raises(InputError, match="rho"):
        messages.to_localizations(replace(message, rho=message.rho[:-1]))


def test_a_large_frame_is_built_quickly_for_rclpy():
    """Element-by-element assignment takes 130 ms and more; a copy of 8 MB takes below 10 ms."""
    import time

    pytest.importorskip("rclpy")
    frame = replace(make_frame(), image=np.zeros((2048, 2048), np.uint16))
    messages.to_rclpy(messages.image(frame))
    best = min(_timed(lambda: messages.to_rclpy(messages.image(frame)), time.perf_counter) for _ in range(5))
    assert best < 0.05


def _timed(call, clock):
    start = clock()
    call()
    return clock() - start
