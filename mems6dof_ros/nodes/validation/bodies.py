"""Several bodies live: two gears that turn differently in one field, through the nodes, against truth."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mems6dof_ros.analysis.recording import load_recording
from mems6dof_ros.analysis.relative import relative_motion
from mems6dof_ros.analysis.truth import compare
from mems6dof_ros.figures import Figure, between, exactly, information
from mems6dof_ros.nodes.runner import run_system
from mems6dof_ros.nodes.system import chain, simulated
from mems6dof_ros.simulation.settings import SimulationSettings

#: Both wholly in the field, about 40 particles each; the second is driven as the ring gear is.
CENTRE, RADIUS = 62e-6, 62e-6
TWO_GEARS: dict[str, Any] = {
    "particles": 40, "clumps": 0, "gear_diameter": 2 * RADIUS, "hub_diameter": 10e-6, "gear_x": -CENTRE,
    "gear_y": 0.0, "ring_particles": 40, "ring_diameter": 2 * RADIUS, "ring_width": RADIUS - 5e-6,
    "width_px": 2048, "height_px": 2048,
}  # fmt: skip
BODIES = f"""\
bodies:
  load_gear: {{region: {{centre: [{-CENTRE:.1e}, 0], outer_radius: {RADIUS + 1e-6:.1e}}}}}
  ring_gear: {{region: {{centre: [{CENTRE:.1e}, 0], outer_radius: {RADIUS + 1e-6:.1e}}}}}
"""


def bodies_figures(
    settings: SimulationSettings, calibration: Path, out: Path, cycles: int = 80
) -> list[Figure]:
    """Rows for ``validate stream``: the optics of ``settings``, with ``calibration``; works in ``out``."""
    file = out / "bodies.yaml"
    file.write_text(BODIES, encoding="utf-8")
    nodes = chain(
        simulated(cycles, seed=settings.seed, optics_seed=settings.optics_seed, **TWO_GEARS),
        calibration=str(calibration),
        bodies=str(file),
        output=str(out / "bodies"),
    )
    with (
        (out / "bodies.log").open("w", encoding="utf-8") as log,
        run_system(nodes, on_line=lambda line: print(line, file=log)) as system,
    ):
        system.wait("frame_source")
        system.stop()
    recording = load_recording(out / "bodies")
    rows = []
    for body, poses in recording.poses.items():
        valid = [pose for pose in poses if pose.valid]
        comparison = compare(valid, recording.truth_of(valid))
        rows += [
            exactly(f"two bodies, {body}: valid poses with their truth", len(comparison.cycle), cycles),
            between(f"two bodies, {body}: NEES/6", comparison.nees_per_dof, 0.8, 1.3),
        ]
    relative = relative_motion(recording, "ring_gear", "load_gear")
    if relative.error is not None:
        error = (relative.error - relative.error.mean(axis=0)) / relative.sd
        chi = float((error**2).sum() / (len(error) - 1) / error.shape[1])
        # For information: what the field does to both alike is not in it, a few tens of per cent either way.
        rows.append(information("two bodies: relative motion, squared error over claimed", chi))
    return rows
