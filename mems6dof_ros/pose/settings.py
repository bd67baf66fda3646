"""What the user may set of the pose estimator."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields

import numpy as np
from numpy.typing import NDArray

from mems6dof_ros.errors import InputError


@dataclass(frozen=True)
class PoseSettings:
    """What the user may set; lengths in m, angles in rad.

    reference: ``map`` registers to the constellation map, refined as cycles arrive; ``previous`` to the
        micrograph before, as the paper does, whose errors add up over the cycles.
    gates: annealed gates of the iterative closest point, descending; the last one is the final gate.
    min_particles: fewer matched particles give no pose.
    confirm_after: sightings of a newcomer before it joins the map.
    retire_after: misses in a row, where it should have been seen, before a particle leaves the map.
    overlap: particles closer than this to another count less until their residuals prove them good.
    gate_xy, gate_z: standard deviations beyond which a particle, or only its z, is left out.
    max_displacement: farther from its centre of rotation no body moves by itself; beyond it the view has
        been shifted, and the pose is lost.
    max_tilt: likewise for the tilt.
    max_centre_distance: the centre of rotation lies within this of the field's centre; only used until
        the body has turned enough to tell.
    max_false_alarms: matches this good that chance would give, log10; the proof against a wrong pose.
    field_size: (width, height) of the field; None: taken from where particles are seen.
    field_degree: degree of the smooth field error that is estimated with the map; 0: none.
    field_sd_xy, field_sd_z: its prior standard deviation, what the calibration leaves over the field.
    beyond_calibration: use particles outside the ranges of z, field and brightness of the calibration, too.
    recentre_at: turns (rad, since the reference) after which the origin is moved to the centre of rotation as
        known by then; each such moment is a new reference version. Empty: only ``set_reference``.
    """

    reference: str = "map"
    gates: tuple[float, ...] = (8e-6, 4e-6, 2e-6, 1e-6, 0.3e-6, 0.05e-6)
    min_particles: int = 4
    confirm_after: int = 3
    retire_after: int = 20
    overlap: float = 3e-6
    gate_xy: float = 4.5
    gate_z: float = 4.0
    max_displacement: float = 5e-6
    max_tilt: float = 0.02
    max_centre_distance: float = field(
        default=1e-3,
        metadata={
            "unit": "m",
            "doc": "The centre of rotation lies within this of the field's centre: used until the body has"
            " turned enough to tell.",
        },
    )
    max_false_alarms: float = -6.0
    field_size: tuple[float, float] | None = None
    field_degree: int = 4
    field_sd_xy: float = 5e-9
    field_sd_z: float = 30e-9
    beyond_calibration: bool = False
    recentre_at: tuple[float, ...] = (math.radians(30), math.tau)

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            numbers = value if isinstance(value, tuple) else (value,)
            if any(isinstance(number, float) and not math.isfinite(number) for number in numbers):
                raise InputError(f"pose setting {item.name}", str(value), "finite numbers")
        if self.reference not in ("map", "previous"):
            raise InputError("pose setting reference", repr(self.reference), "'map' or 'previous'")
        if not self.gates or list(self.gates) != sorted(self.gates, reverse=True) or self.gates[-1] <= 0:
            raise InputError(
                "pose setting gates", str(self.gates), "positive lengths (m) in descending order"
            )
        if self.min_particles < 3:
            raise InputError("pose setting min_particles", str(self.min_particles), "at least 3")
        for name in _POSITIVE:
            if not getattr(self, name) > 0:
                raise InputError(f"pose setting {name}", str(getattr(self, name)), "a positive number")
        if not 0 <= self.field_degree <= 8:
            raise InputError("pose setting field_degree", str(self.field_degree), "0 (none) to 8")
        if self.field_size is not None and (len(self.field_size) != 2 or min(self.field_size) <= 0):
            raise InputError("pose setting field_size", str(self.field_size), "width and height in m")

    @property
    def identity_gate(self) -> float:
        """Distance within which a localization is taken for a known particle: no two spheres of a
        micrometre can both be there."""
        return min(max(self.gates[-1], 0.3e-6), self.gates[0])


_POSITIVE = (
    "confirm_after", "retire_after", "gate_xy", "gate_z", "max_displacement", "max_tilt",
    "max_centre_distance", "field_sd_xy", "field_sd_z",
)  # fmt: skip


@dataclass(frozen=True)
class Region:
    """Where in the field a body is: a ring about ``centre`` (x, y) m in the microscope frame, from
    ``inner_radius`` to ``outer_radius`` m (a disc where the former is 0)."""

    centre: tuple[float, float]
    outer_radius: float
    inner_radius: float = 0.0

    def __post_init__(self) -> None:
        if not 0 <= self.inner_radius < self.outer_radius:
            found = f"inner_radius {self.inner_radius}, outer_radius {self.outer_radius}"
            raise InputError("region", found, "0 <= inner_radius < outer_radius (m)")

    def contains(self, position: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Where ``position`` (n, 2 or 3) m lies in the region, (n,)."""
        radius = np.hypot(position[:, 0] - self.centre[0], position[:, 1] - self.centre[1])
        return np.asarray((radius >= self.inner_radius) & (radius <= self.outer_radius))
