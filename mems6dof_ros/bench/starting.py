"""How long a process takes from its start to its first localizations, its kernels compiled before."""

from __future__ import annotations

import subprocess
import sys
import time

from mems6dof_ros.bench.material import Material
from mems6dof_ros.bench.table import Row

_PROGRAM = """
import sys, time
import numpy as np
from mems6dof_ros.calibration.file import load_calibration
from mems6dof_ros.frame import Frame
from mems6dof_ros.localization.localizer import Localizer
from mems6dof_ros.pose.estimator import PoseEstimator
image = np.load(sys.argv[2])
calibration = load_calibration(sys.argv[1])
frame = Frame(image, 1, 1, 1, pixel_size=calibration.pixel_size)
PoseEstimator().update(Localizer(calibration.camera, calibration).localize(frame))
print(time.process_time())
"""


def second_start(material: Material) -> list[Row]:
    """Processor time from the start of Python to the first pose; the least of three second starts."""
    import numpy as np

    image = material.directory / "frame.npy"
    np.save(image, material.frames[0].image)
    command = [sys.executable, "-c", _PROGRAM, str(material.calibration_path), str(image)]
    times, walls = [], []
    for _ in range(4):
        begin = time.monotonic()
        answer = subprocess.run(command, check=True, capture_output=True, text=True).stdout
        walls.append(time.monotonic() - begin)
        times.append(float(answer))
    seconds = min(times[1:])
    return [
        Row("second start to first pose", seconds, "s", "a second", 1.0, seconds, None, 1.0,
            details={"wall s": min(walls[1:]), "first start here s": times[0]})
    ]  # fmt: skip
