"""Core types filled with random numbers."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from mems6dof_ros.frame import Frame, GroundTruth
from mems6dof_ros.localization.localizations import Flag, GaussianFits, Latency, Localizations
from mems6dof_ros.pose.cycle_pose import CyclePose, PaperAngles, Status

RNG = np.random.default_rng(1)
STAMP = 1_700_000_000_123_456_789


@pytest.fixture
def make():
    """Factories: ``make.frame()``, ``make.localizations()``, ``make.pose()``."""
    return SimpleNamespace(frame=make_frame, localizations=make_localizations, pose=make_pose)


def rotation():
    q, r = np.linalg.qr(RNG.normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q * np.sign(np.linalg.det(q))


def spread():
    root = RNG.normal(size=(6, 6))
    return root @ root.T


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
        covariance=spread() * fill,
        displacement=RNG.normal(size=6) * fill,
        displacement_covariance=spread() * fill,
        angles=PaperAngles(1.0, 2.0, 3.0, 0.1, 0.2, 0.3, True, False),
        increment=RNG.normal(size=6) * fill,
        increment_covariance=spread() * fill,
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
