"""One camera frame and what is known of it: the start of the flow.

Microscope frame, used by everything downstream: right-handed, x along image columns (right),
y along image rows (down), z along the optical axis away from the objective; origin at the
centre of the field, in the focal plane.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from mems6dof_ros.errors import InputError

NAN = math.nan


@dataclass(frozen=True)
class GroundTruth:
    """What a simulator knows of one frame; the measurement never reads it.

    ``rotation`` (3, 3) and ``translation`` (3,) m: body to microscope frame. ``psi`` rad,
    unwrapped. ``particle_id`` (n,), ``position`` (n, 3) m in the microscope frame and
    ``electrons`` (n,): the particles whose centres lie inside the image.
    """

    body: str
    rotation: NDArray[np.float64]
    translation: NDArray[np.float64]
    psi: float
    particle_id: NDArray[np.int32]
    position: NDArray[np.float64]
    electrons: NDArray[np.float64]


@dataclass(frozen=True)
class Frame:
    """One micrograph, ``image`` (height, width) uint8 or uint16 in ADU, and its circumstances.

    Times in ns since the Unix epoch; ``stamp_ns`` is the middle of the exposure, 0 where unknown.
    Unknown floats are NaN, unknown integers 0. Fields as in mems6dof_msgs/FrameInfo.
    """

    image: NDArray[np.generic]
    stamp_ns: int
    frame_counter: int
    cycle: int
    frame_id: str = "microscope"
    frames_dropped: int = 0
    device_time_ns: int = 0
    exposure_s: float = NAN
    stage_z: float = NAN
    pixel_size: float = NAN
    saturation_adu: int = 0
    source: str = ""
    live: bool = False
    published_ns: int = 0
    truth: tuple[GroundTruth, ...] = field(default=())

    def __post_init__(self) -> None:
        check_image(self.image, f"frame {self.frame_counter}")

    @property
    def encoding(self) -> str:
        """ROS image encoding of the pixels: mono8 or mono16."""
        return "mono8" if self.image.dtype == np.uint8 else "mono16"


def check_image(image: NDArray[np.generic], where: str) -> None:
    """Raise InputError unless ``image`` is a non-empty 2-D uint8 or uint16 array."""
    if image.ndim != 2 or image.size == 0:
        raise InputError(where, f"an image of shape {image.shape}", "a non-empty image (height, width)")
    if image.dtype not in (np.uint8, np.uint16):
        raise InputError(where, f"pixels of type {image.dtype}", "uint8 (mono8) or uint16 (mono16)")
