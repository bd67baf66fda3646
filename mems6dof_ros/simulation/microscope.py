"""The simulated microscope: rigid bodies in, frames with their truth out."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mems6dof_ros.frame import Frame, GroundTruth
from mems6dof_ros.simulation.aberrations import FieldAberrations
from mems6dof_ros.simulation.camera import Camera, illumination
from mems6dof_ros.simulation.microsystem import BodyPose, Particles
from mems6dof_ros.simulation.optics import Objective, Optics
from mems6dof_ros.simulation.settings import SimulationSettings


class Body(NamedTuple):
    """A rigid body in front of the microscope; ``electrons`` (n,) of its particles in this frame."""

    name: str
    particles: Particles
    electrons: NDArray[np.float64]
    pose: BodyPose


class Microscope:
    """Optics and camera. Frames count from 0; ``noise`` draws what differs from frame to frame."""

    def __init__(self, settings: SimulationSettings, noise: np.random.Generator) -> None:
        self.settings = settings
        objective = Objective(settings.numerical_aperture, settings.wavelength, settings.pixel_size)
        aberrations = FieldAberrations.from_preset(settings.optics, settings.optics_seed, settings.wavelength)
        self.optics = Optics(objective, aberrations)
        self.camera = Camera(settings, noise)
        self._frames = 0

    def frame(
        self,
        bodies: Sequence[Body],
        *,
        period: int,
        cycle: int,
        stage_z: float,
        focal_plane: float | None = None,
        covered: bool = False,
    ) -> Frame:
        """Expose ``bodies`` in clock period number ``period`` with the stage at ``stage_z`` m.

        ``focal_plane`` m is where the stage really is, if not where it says. The truth's z, and the z of
        its translation, count from that plane, as the microscope frame does. ``covered``: without light.
        """
        settings = self.settings
        focal_plane = stage_z if focal_plane is None else focal_plane
        size = np.array(settings.image_size)
        truth, positions, electrons, diameters = [], [], [], []
        for body in bodies:
            translation = body.pose.translation - [0, 0, focal_plane]
            position = body.particles.position @ body.pose.rotation.T + translation
            pixel = position[:, :2] / settings.pixel_size
            light = body.electrons * illumination(pixel[:, 0], pixel[:, 1], settings) * (not covered)
            inside = (np.abs(pixel) < size / 2).all(axis=1)
            truth.append(
                GroundTruth(
                    body=body.name,
                    rotation=body.pose.rotation,
                    translation=translation,
                    psi=body.pose.psi,
                    particle_id=np.flatnonzero(inside).astype(np.int32),
                    position=position[inside],
                    electrons=light[inside],
                )
            )
            shows = (np.abs(pixel) < (size + self.optics.window_px) / 2).all(axis=1) & (light > 0)
            positions.append(position[shows])
            electrons.append(light[shows])
            diameters.append(body.particles.diameter[shows])
        images = self.optics.render(
            np.concatenate(positions),
            np.concatenate(electrons),
            np.concatenate(diameters),
            settings.image_size,
        )
        frame = Frame(
            image=self.camera.expose(images, covered=covered),
            stamp_ns=settings.epoch_ns + round(period * 1e9 / settings.frame_rate),
            frame_counter=self._frames,
            cycle=cycle,
            exposure_s=settings.exposure,
            stage_z=stage_z,
            pixel_size=settings.pixel_size,
            saturation_adu=settings.saturation_adu,
            source="simulator",
            truth=tuple(truth),
        )
        self._frames += 1
        return frame
