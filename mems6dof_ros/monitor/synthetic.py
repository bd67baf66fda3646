"""A made-up turning gear, to watch: what an instrument says of it, without optics and estimation.

Nothing is measured here, so nothing of it tells how well the instrument measures.
"""

from __future__ import annotations

import math
import time
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mems6dof_ros.frame import Frame, GroundTruth
from mems6dof_ros.localization.localizations import GaussianFits, Latency, Localizations
from mems6dof_ros.pose.angles import from_swing_twist, paper_angles
from mems6dof_ros.pose.cycle_pose import CyclePose, Status

Array = NDArray[np.float64]

#: rad per cycle; standard deviations of the poses, m and rad; width of the field, m.
STEP = math.radians(4.5)
SD = np.array([0.25e-9, 0.25e-9, 7e-9, 95e-6, 95e-6, 2.5e-6])
FIELD = 260e-6
_BACKGROUNDS = 4  # different ones: noise costs more than all particles


class Machine:
    """Gear with run-out, wobble, play and step errors, lost now and then; ``size`` px of its images."""

    def __init__(self, seed: int = 1, size: int = 1024, particles: int = 110) -> None:
        self.rng = np.random.default_rng(seed)
        self.size = size
        self.pixel_size = FIELD / size
        radius = 164e-6 * np.sqrt(self.rng.random(particles))
        azimuth = self.rng.uniform(0, 2 * math.pi, particles)
        height = self.rng.normal(0, 0.6e-6, particles)
        self.body = np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), height], axis=1)
        self.brightness = self.rng.lognormal(math.log(1e5), 0.4, particles)
        self.psi = 0.0
        self.previous = np.zeros(6)
        self.lost_until = -1
        self._backgrounds: list[NDArray[np.float32]] = []

    def cycle(self, number: int, *, image: bool = True) -> tuple[Frame, Localizations, CyclePose]:
        """Everything one motion cycle gives; call in the order of cycles."""
        rng = self.rng
        if number:
            self.psi += STEP * (1 + rng.normal(0, 0.004)) + 0.002 * math.sin(number / 9)
        wobble = 0.0006
        true = np.array(
            [
                180e-9 * math.cos(self.psi) + rng.normal(0, 12e-9) - 180e-9,
                180e-9 * math.sin(self.psi) + rng.normal(0, 12e-9),
                60e-9 * math.sin(2 * self.psi) + rng.normal(0, 8e-9),
                wobble * math.cos(self.psi + 0.7) + rng.normal(0, 3e-5),
                wobble * math.sin(self.psi + 0.7) + rng.normal(0, 3e-5),
                self.psi,
            ]
        )
        rotation, translation = from_swing_twist(*true[3:]), true[:3]
        position = self.body @ rotation.T + translation
        pixel = position[:, :2] / self.pixel_size + (self.size - 1) / 2
        inside = np.flatnonzero(np.all((pixel > 2) & (pixel < self.size - 3), axis=1))
        now = time.time_ns()
        truth = GroundTruth(
            "load_gear",
            rotation,
            translation,
            self.psi,
            inside.astype(np.int32),
            position[inside],
            self.brightness[inside],
        )
        frame = Frame(
            self._render(pixel[inside], position[inside, 2], self.brightness[inside])
            if image
            else np.zeros((1, 1), np.uint16),
            now,
            number,
            number,
            exposure_s=2e-3,
            stage_z=0.0,
            pixel_size=self.pixel_size,
            saturation_adu=4095,
            source="synthetic",
            live=True,
            published_ns=now,
            truth=(truth,),
        )
        return frame, *self._measure(number, now, true, inside, position[inside], pixel[inside])

    def _measure(
        self, number: int, now: int, true: Array, inside: NDArray[np.intp], position: Array, pixel: Array
    ) -> tuple[Localizations, CyclePose]:
        rng, n = self.rng, len(inside)
        residual = rng.normal(0, 1, (n, 3)) * [2.2e-9, 2.2e-9, 40e-9]
        residual[rng.random(n) < 0.03] *= 4
        flags = np.where(rng.random(n) < 0.05, 8, 0).astype(np.uint32)
        used = flags == 0
        sigma = 3 + 0.4e6 * np.abs(position[:, 2]) * 2
        fits = GaussianFits(
            np.stack(
                [
                    pixel[:, 0],
                    pixel[:, 1],
                    self.brightness[inside] / 60,
                    sigma,
                    sigma,
                    0.2 * position[:, 2] * 1e6,
                    np.full(n, 10.0),
                ],
                axis=1,
            ),
            np.full((n, 7, 7), np.nan),
            np.ones(n),
            np.full(n, 5, np.int32),
            flags,
        )
        latency = Latency(
            1.6e-3, 3.4e-3, rng.gamma(2, 2e-4), rng.gamma(60, 1e-4), 4e-4, rng.gamma(30, 4e-5), math.nan
        )
        total = latency.frame_transport + latency.queue + latency.localization + latency.pose + 4e-4
        localizations = Localizations(
            now,
            "microscope",
            number,
            number,
            position + residual,
            np.tile(np.diag([4e-18, 4e-18, 1.6e-15]), (n, 1, 1)),
            fits,
            np.full(n, np.nan),
            flags,
            "synthetic",
            latency=latency,
            published_ns=now,
            frame_published_ns=now,
        )
        if self.lost_until < number and number and number % 700 == 0:
            self.lost_until = number + 12
        status = (
            Status.LOST
            if number <= self.lost_until
            else Status.DEGRADED
            if number % 700 > 680
            else Status.TRACKING
        )
        reason = {
            Status.LOST: "no constellation match: 9 of 84 particles found",
            Status.DEGRADED: "few particles",
        }
        sd = SD * (3 if status is Status.DEGRADED else 1)
        measured = true + rng.normal(0, 1, 6) * sd
        nan = status is Status.LOST
        covariance = np.diag(sd**2)
        blank = np.nan if nan else 1.0
        increment = measured - self.previous
        pose = CyclePose(
            now,
            "microscope",
            number,
            number,
            "load_gear",
            status,
            reason.get(status, ""),
            1,
            from_swing_twist(*measured[3:]) * blank,
            measured[:3] * blank,
            covariance * blank,
            measured * blank,
            covariance * blank,
            paper_angles(measured, covariance),
            increment * blank,
            2 * covariance * blank,
            0 if nan or number == 0 else 1,
            2.2e-9 * (1 + 0.05 * rng.normal()) * blank,
            41e-9 * (1 + 0.05 * rng.normal()) * blank,
            (1.05 + 0.08 * rng.normal()) * blank,
            0 if nan else int(used.sum()),
            n,
            n + 2,
            np.where(used & (not nan), inside, -1).astype(np.int32),
            np.where((used & (not nan))[:, None], residual, np.nan),
            replace(latency, total=total),
        )
        self.previous = measured
        return localizations, pose

    def _render(self, pixel: Array, z: Array, brightness: Array) -> NDArray[np.uint16]:
        if len(self._backgrounds) < _BACKGROUNDS:
            self._backgrounds.append(self.rng.normal(110, 3.5, (self.size, self.size)).astype(np.float32))
        image = self._backgrounds[self.rng.integers(len(self._backgrounds))].copy()
        scale = self.size / 2048
        half = max(int(16 * scale), 4)
        for (x, y), height, electrons in zip(pixel, z, brightness, strict=True):
            sigma = scale * (3.2 + abs(height) * 2.5e6)
            x0, y0 = round(x), round(y)
            ys = np.arange(max(y0 - half, 0), min(y0 + half + 1, self.size))
            xs = np.arange(max(x0 - half, 0), min(x0 + half + 1, self.size))
            peak = electrons / (2 * math.pi * sigma**2) * 0.4
            image[ys[0] : ys[-1] + 1, xs[0] : xs[-1] + 1] += peak * np.exp(
                -((ys[:, None] - y) ** 2 + (xs - x) ** 2) / (2 * sigma**2)
            )
        return np.clip(image, 0, 4095).astype(np.uint16)
