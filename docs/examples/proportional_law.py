"""A law of one's own for the controller: in every cycle, eight tenths of what is missing."""

from __future__ import annotations

from mems6dof_ros.control.commands import Motion
from mems6dof_ros.control.position import DriveSettings
from mems6dof_ros.pose.cycle_pose import CyclePose


class ProportionalLaw:
    """Knows nothing of backlash, learns nothing, and arrives all the same, after a few cycles more."""

    def __init__(self, drive: DriveSettings) -> None:
        self._drive = drive

    def next_motion(self, target: float, pose: CyclePose, made: Motion | None) -> Motion | None:
        drive = self._drive
        missing = target - pose.displacement[5]
        if abs(missing) <= 0.9 * max(drive.tolerance, drive.resolution):
            return None
        turn = min(0.8 * abs(missing), drive.step)
        amplitude = drive.stiction + (1 - drive.stiction) * turn / drive.step
        return Motion(1, amplitude, 1 if missing > 0 else -1)
