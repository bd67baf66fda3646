"""Everything that can be set in a simulation, with units and permitted ranges."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NoReturn

from mems6dof_ros.errors import InputError
from mems6dof_ros.simulation.aberrations import PRESETS

PIXEL_FORMATS = {"mono8": 255, "mono16": 65535}


def _number(default: float, unit: str, low: float, high: float, doc: str) -> Any:
    """A field with its unit, permitted range (inclusive) and meaning."""
    return dataclasses.field(default=default, metadata={"unit": unit, "range": (low, high), "doc": doc})


def _choice(default: str, choices: tuple[str, ...], doc: str) -> Any:
    return dataclasses.field(default=default, metadata={"unit": "", "choices": choices, "doc": doc})


@dataclass(frozen=True)
class SimulationSettings:
    """Settings of the simulated microscope, microsystem and camera; SI units, ranges are checked.

    Each field carries ``metadata`` with ``unit``, ``doc`` and ``range`` or ``choices``, so that nodes
    and documentation can describe it. Raises InputError for a value of the wrong type, not finite,
    or out of range.
    """

    # Image and time.
    width_px: int = _number(2048, "px", 64, 8192, "image width")
    height_px: int = _number(2048, "px", 64, 8192, "image height")
    frame_rate: float = _number(90.0, "Hz", 0.1, 1e4, "motion cycles, and frames, per second")
    exposure: float = _number(2e-3, "s", 1e-6, 10.0, "exposure time as reported; the gear stands still")
    epoch_ns: int = _number(1_767_225_600_000_000_000, "ns", 0, 2**62, "mid-exposure of the first frame")
    seed: int = _number(1, "1", 0, 2**32 - 1, "particles, motion and noise")

    # Optics.
    optics: str = _choice("paper", tuple(PRESETS), "preset of aberrations")
    optics_seed: int = _number(1, "1", 0, 2**32 - 1, "which optics of that preset")
    numerical_aperture: float = _number(0.55, "1", 0.1, 0.8, "numerical aperture, in air")
    wavelength: float = _number(645e-9, "m", 300e-9, 1100e-9, "emission wavelength")
    pixel_size: float = _number(127.34e-9, "m", 40e-9, 500e-9, "image pixel size in object space")
    illumination_falloff: float = _number(0.1, "1", 0.0, 0.9, "relative loss of light at the image's corners")

    # Camera.
    pixel_format: str = _choice("mono16", tuple(PIXEL_FORMATS), "encoding of the pixels")
    saturation_adu: int = _number(65535, "ADU", 15, 65535, "largest pixel value")
    gain: float = _number(2.0, "ADU/electron", 1e-3, 100.0, "mean gain")
    gain_spread: float = _number(0.005, "1", 0.0, 0.1, "relative sd of the gain from pixel to pixel")
    offset_adu: float = _number(100.0, "ADU", 0.0, 10000.0, "mean offset")
    offset_spread_adu: float = _number(0.5, "ADU", 0.0, 50.0, "sd of the offset from pixel to pixel")
    read_noise: float = _number(1.6, "electrons", 0.0, 100.0, "median read noise, rms")
    read_noise_spread: float = _number(0.15, "1", 0.0, 1.0, "sd of ln(read noise) from pixel to pixel")
    background: float = _number(10.0, "electrons/px", 0.0, 1000.0, "background at the centre of the field")
    camera_seed: int = _number(1, "1", 0, 2**32 - 1, "which camera: fixed pattern")

    # Particles.
    particles: int = _number(104, "1", 0, 5000, "particles on the gear, clumps and all")
    clumps: int = _number(2, "1", 0, 1000, "of which so many touch another particle")
    stray_particles: int = _number(0, "1", 0, 5000, "particles that stand still, not on the gear")
    missing: float = _number(0.0, "1", 0.0, 1.0, "chance of a particle to be dark in a frame")
    diameter: float = _number(1e-6, "m", 50e-9, 2e-6, "mean diameter of the spheres")
    diameter_spread: float = _number(0.02, "1", 0.0, 0.2, "relative sd of the diameter")
    height_relief: float = _number(100e-9, "m", 0.0, 5e-6, "sd of the particles' heights on the gear")
    electrons: float = _number(6e4, "electrons", 0.0, 1e8, "mean over the particles, per frame")
    brightness_spread: float = _number(0.25, "1", 0.0, 2.0, "sd of ln(brightness) from particle to particle")
    bleaching: float = _number(0.0, "1/cycle", 0.0, 1.0, "mean loss of brightness per motion cycle")

    # Gear and where it stands.
    gear_diameter: float = _number(328e-6, "m", 1e-6, 5e-3, "diameter within which particles lie")
    hub_diameter: float = _number(40e-6, "m", 0.0, 5e-3, "diameter of the hub, free of particles")
    gear_x: float = _number(1.5e-6, "m", -1e-3, 1e-3, "mean centre of rotation in the field")
    gear_y: float = _number(-2.5e-6, "m", -1e-3, 1e-3, "mean centre of rotation in the field")
    gear_z: float = _number(0.0, "m", -5e-5, 5e-5, "mean height of the gear")
    stage_z: float = _number(0.0, "m", -1e-3, 1e-3, "position of the focal plane")

    # Ring gear, a second body, in view where the load gear is moved aside by gear_x or gear_y.
    ring_particles: int = _number(0, "1", 0, 5000, "particles all around the ring gear; 0: no ring gear")
    ring_diameter: float = _number(
        820e-6, "m", 1e-6, 5e-3, "diameter of the ring gear, outside the load gear"
    )
    ring_width: float = _number(100e-6, "m", 1e-6, 5e-3, "width of its rim, which carries the particles")
    ring_direction: float = _number(0.0, "rad", -math.pi, math.pi, "where it lies, seen from the load gear")

    # Drive.
    step: float = _number(math.pi / 40, "rad", -math.pi, math.pi, "nominal rotation per motion cycle")
    step_error: float = _number(
        0.01, "1", 0.0, 1.0, "relative sd of the drive's gain error, one draw per seed"
    )
    step_jitter: float = _number(1e-3, "rad", 0.0, 0.5, "sd of the rotation from cycle to cycle")
    stall_probability: float = _number(0.0, "1", 0.0, 1.0, "chance of a cycle without rotation")
    skip_probability: float = _number(0.0, "1", 0.0, 1.0, "chance of a cycle with twice the rotation")
    backlash: float = _number(5e-3, "rad", 0.0, 0.5, "rotation lost when the direction changes")

    # Departures from pure rotation.
    play: float = _number(390e-9, "m", 0.0, 5e-5, "diameter of the clearance in x and y")
    play_z: float = _number(100e-9, "m", 0.0, 1e-5, "clearance in z")
    eccentricity: float = _number(
        200e-9, "m", 0.0, 5e-5, "offset of the body's origin from the rotation axis"
    )
    tilt_field: float = _number(0.7e-3, "rad", 0.0, 0.1, "tilt of the mean axis, fixed in the field")
    tilt_body: float = _number(0.7e-3, "rad", 0.0, 0.1, "tilt of the gear on its axis: turns with it")
    tilt_play: float = _number(0.5e-3, "rad", 0.0, 0.1, "largest tilt within the clearance")
    drift_xy: float = _number(2e-9, "m/s", 0.0, 1e-5, "speed of the stage's lateral drift")
    drift_z: float = _number(5e-9, "m/s", 0.0, 1e-5, "speed of the stage's axial drift")
    vibration_xy: float = _number(0.3e-9, "m", 0.0, 1e-6, "rms from frame to frame, each of x and y")
    vibration_z: float = _number(2e-9, "m", 0.0, 1e-6, "rms from frame to frame")

    def __post_init__(self) -> None:
        for spec in dataclasses.fields(self):
            _check(spec, getattr(self, spec.name))
        limit = PIXEL_FORMATS[self.pixel_format]
        if self.saturation_adu > limit:
            _refuse("saturation_adu", self.saturation_adu, f"at most {limit} for {self.pixel_format}")
        if self.hub_diameter >= self.gear_diameter:
            _refuse("hub_diameter", self.hub_diameter, f"less than gear_diameter, {self.gear_diameter} m")
        if self.ring_width > self.ring_diameter / 2:
            _refuse(
                "ring_width", self.ring_width, f"at most {self.ring_diameter / 2} m, half of ring_diameter"
            )
        if self.clumps and self.clumps >= self.particles:
            _refuse("clumps", self.clumps, f"fewer than the {self.particles} particles")

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> SimulationSettings:
        """Settings from plain values, defaults for the rest; InputError for an unknown name."""
        known = [spec.name for spec in dataclasses.fields(cls)]
        for name in values:
            if name not in known:
                raise InputError(
                    "simulation settings", f"unknown name {name!r}", f"one of {', '.join(known)}"
                )
        return cls(**values)

    def to_dict(self) -> dict[str, Any]:
        """Plain values of all fields: what ``from_dict`` takes."""
        return dataclasses.asdict(self)

    @property
    def image_size(self) -> tuple[int, int]:
        """(width, height) px."""
        return self.width_px, self.height_px


def _check(spec: dataclasses.Field[Any], value: Any) -> None:
    """Raise InputError unless ``value`` suits the field ``spec``."""
    if "choices" in spec.metadata:
        if value not in spec.metadata["choices"]:
            _refuse(spec.name, value, f"one of {', '.join(spec.metadata['choices'])}")
        return
    low, high = spec.metadata["range"]
    whole = spec.type == "int"
    kind = int if whole else (int, float)
    if isinstance(value, bool) or not isinstance(value, kind) or not low <= value <= high:
        noun = "a whole number" if whole else "a number"
        _refuse(spec.name, value, f"{noun} from {low:g} to {high:g} {spec.metadata['unit']}")


def _refuse(name: str, value: Any, expected: str) -> NoReturn:
    raise InputError(f"simulation setting {name}", repr(value), expected)
