"""Noisy localizations of a simulated gear, with truth: to validate the pose without images.

Independent of the estimator and of the optical simulator: a rigid constellation, a motion with play,
nutation and step error, and localizations drawn with the covariance they claim, plus what goes wrong.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mems6dof_ros.frame import GroundTruth
from mems6dof_ros.localization.localizations import Flag, GaussianFits, Localizations
from mems6dof_ros.pose.angles import from_swing_twist

Array = NDArray[np.float64]


@dataclass(frozen=True)
class GearMotion:
    """How a body moves, m and rad; per motion cycle unless said otherwise.

    ``step`` with normal ``step_sd``; ``play_xy``, ``play_z`` sd of the centre, ``play_tilt`` sd of the
    tilts; ``nutation``: tilt of the body's axis that turns with it; ``centre`` (2,) of rotation in the
    microscope frame; ``drift`` (3,) of the stage.
    """

    step: float = math.radians(4.5)
    step_sd: float = math.radians(0.1)
    play_xy: float = 110e-9
    play_z: float = 50e-9
    play_tilt: float = 0.3e-3
    nutation: float = 1e-3
    centre: tuple[float, float] = (1.5e-6, -2.5e-6)
    drift: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Scene:
    """A constellation and how it is seen.

    ``particles`` on a disc of ``radius`` m with a hole of ``inner_radius`` m; ``field`` (width, height) m;
    ``sd_xy``, ``sd_z`` m of the localizations, spread over particles by the factor exp(N(0, ``spread``));
    ``missing`` and ``spurious``: fraction of the visible; ``wrong_z``: fraction on the wrong axial branch,
    unflagged; ``field_error_xy``, ``field_error_z`` m rms of a smooth static error, not claimed by the
    covariances.
    """

    particles: int = 100
    radius: float = 164e-6
    inner_radius: float = 0.0
    relief: float = 0.5e-6
    field: tuple[float, float] = (260e-6, 260e-6)
    sd_xy: float = 2.3e-9
    sd_z: float = 50e-9
    spread: float = 0.0
    missing: float = 0.0
    spurious: float = 0.0
    wrong_z: float = 0.0
    field_error_xy: float = 0.0
    field_error_z: float = 0.0
    motion: GearMotion = GearMotion()

    def with_visible(self, count: int) -> Scene:
        """The same with as many particles on the disc as show ``count`` in the field on average."""
        width, height = self.field
        inside = min(1.0, width * height / (math.pi * self.radius**2))
        return replace(self, particles=round(count / inside))


class SyntheticGear:
    """Cycles of one body in a Scene; everything follows from ``seed``, the field error from ``optics`` where
    that is given: bodies in one field have it in common."""

    def __init__(self, scene: Scene, seed: int, body: str = "load_gear", optics: int | None = None) -> None:
        self.scene, self.body = scene, body
        self.random = np.random.default_rng([seed, 20231])
        n = scene.particles
        hole = (scene.inner_radius / scene.radius) ** 2
        radius = scene.radius * np.sqrt(hole + (1 - hole) * self.random.random(n))
        azimuth = self.random.uniform(0, math.tau, n)
        height = self.random.normal(0, scene.relief, n)
        self.particles = np.c_[radius * np.cos(azimuth), radius * np.sin(azimuth), height]
        self.scale = np.exp(self.random.normal(0, scene.spread, n))
        self.psi = float(self.random.uniform(-math.pi, math.pi))
        self.cycle = 0
        waves = self.random if optics is None else np.random.default_rng([optics, 20232])
        self._waves = waves.normal(size=(3, 6, 4))

    def field_error(self, position: Array) -> Array:
        """Static error (n, 3) m at ``position``: a sum of long waves, not of the estimator's polynomials."""
        half = np.array(self.scene.field) / 2
        u = position[:, :2] / half
        out = np.zeros((len(position), 3))
        for axis, rms in enumerate(
            (self.scene.field_error_xy, self.scene.field_error_xy, self.scene.field_error_z)
        ):
            if rms:
                waves = self._waves[axis]
                phase = u @ (1.2 * waves[:, :2].T) + math.pi * waves[:, 2]
                out[:, axis] = rms * math.sqrt(2 / len(waves)) * np.sin(phase).sum(axis=1)
        return out

    def advance(self, step: float | None = None, cycles: int = 1) -> None:
        """Turn by ``step`` rad per cycle (None: as the motion says) for ``cycles``."""
        for _ in range(cycles):
            motion = self.scene.motion
            self.psi += self.random.normal(motion.step, motion.step_sd) if step is None else step
            self.cycle += 1

    def observe(self, shift: tuple[float, float] = (0.0, 0.0)) -> tuple[Localizations, GroundTruth]:
        """Localizations of the body as it stands, with new play; the view shifted by ``shift`` m."""
        scene, motion, random = self.scene, self.scene.motion, self.random
        tilt = motion.play_tilt * random.normal(size=2)
        tilt += motion.nutation * np.array([math.cos(self.psi), math.sin(self.psi)])
        rotation = from_swing_twist(tilt[0], tilt[1], self.psi)
        translation = np.array([motion.centre[0] + shift[0], motion.centre[1] + shift[1], 0.3e-6])
        translation += np.array(motion.drift) * self.cycle
        translation += random.normal(size=3) * [motion.play_xy, motion.play_xy, motion.play_z]
        position = self.particles @ rotation.T + translation
        half = np.array(scene.field) / 2
        visible = np.flatnonzero((np.abs(position[:, :2]) < half).all(axis=1))
        truth = GroundTruth(
            self.body, rotation, translation, self.psi, visible.astype(np.int32), position[visible],
            np.full(len(visible), 6e4),
        )  # fmt: skip
        seen = visible[random.random(len(visible)) >= scene.missing]
        sd = np.array([scene.sd_xy, scene.sd_xy, scene.sd_z]) * self.scale[seen, None]
        found = position[seen] + sd * random.normal(size=(len(seen), 3))
        found += self.field_error(found)
        wrong = random.random(len(seen)) < scene.wrong_z
        found[wrong, 2] += random.uniform(1e-6, 3e-6, wrong.sum()) * random.choice([-1, 1], wrong.sum())
        extra = random.binomial(len(visible), scene.spurious) if scene.spurious else 0
        ghosts = np.c_[random.uniform(-half, half, (extra, 2)), random.uniform(-2e-6, 2e-6, extra)]
        variance = np.r_[sd**2, np.tile([scene.sd_xy**2, scene.sd_xy**2, scene.sd_z**2], (extra, 1))]
        order = random.permutation(len(found) + extra)
        self.last_identity = np.r_[seen, np.full(extra, -1)][order]
        return (
            make_localizations(np.r_[found, ghosts][order], variance[order], self.cycle),
            truth,
        )


def make_localizations(position: Array, variance: Array, cycle: int) -> Localizations:
    """Localizations at ``position`` (n, 3) m with ``variance`` (n, 3) m^2, all good."""
    n = len(position)
    covariance = np.zeros((n, 3, 3))
    covariance[:, [0, 1, 2], [0, 1, 2]] = variance
    fits = GaussianFits(
        np.zeros((n, 7)), np.zeros((n, 7, 7)), np.ones(n), np.zeros(n, np.int32), np.zeros(n, np.uint32)
    )
    return Localizations(
        stamp_ns=cycle * 11_111_111,
        frame_id="microscope",
        frame_counter=cycle,
        cycle=cycle,
        position=position,
        covariance=covariance,
        fits=fits,
        z_gap=np.full(n, np.nan),
        flags=np.where(np.isfinite(position[:, 2]), 0, Flag.NO_Z).astype(np.uint32),
    )


def merged(views: Sequence[Localizations], seed: int) -> tuple[Localizations, NDArray[np.int64]]:
    """All ``views`` of one cycle as one, shuffled; element i was element ``order[i]`` of them in a row."""
    order = np.random.default_rng([seed, 7]).permutation(sum(len(view) for view in views))
    position = np.concatenate([view.position for view in views])[order]
    variance = np.concatenate([np.diagonal(view.covariance, axis1=1, axis2=2) for view in views])[order]
    return make_localizations(position, variance, views[0].cycle), order
