"""From focus stacks to a calibration, and from fitted shapes to three-dimensional positions."""
