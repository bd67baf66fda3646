"""A micrograph made small enough for a page, with what was found on it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mems6dof_ros.frame import Frame
from mems6dof_ros.localization.localizations import Localizations
from mems6dof_ros.pose.cycle_pose import CyclePose

#: Longest side of the picture, px; an ordinary screen shows no more in one panel.
MAX_SIDE_PX = 1024
_JPEG_QUALITY = 85
#: Darkest and brightest grey, as quantiles of the pixels, so that one hot pixel does not set the scale.
_DARK, _BRIGHT = 0.05, 0.9995


@dataclass(frozen=True)
class Picture:
    """``jpeg`` and ``overlay``, the JSON-ready description of what to draw on it."""

    jpeg: bytes
    overlay: dict[str, Any]


def make_picture(
    frame: Frame | None, localizations: Localizations | None, poses: list[CyclePose], bodies: dict[str, int]
) -> Picture:
    """The picture of one frame; whatever is None is left out. All of them have the same stamp.

    In the overlay, positions are px of the full image, lengths m; ``grey`` are the ADU shown as
    black and as white.
    """
    overlay: dict[str, Any] = {}
    jpeg = b""
    if frame is not None:
        height, width = frame.image.shape
        jpeg, grey = encode(frame.image)
        overlay |= {
            "width": width,
            "height": height,
            "grey": grey,
            "pixel_size": _number(frame.pixel_size),
            "stage_z": _number(frame.stage_z),
            "frame_counter": frame.frame_counter,
            "cycle": frame.cycle,
        }
    if localizations is not None:
        overlay |= {
            "frame_counter": localizations.frame_counter,
            "cycle": localizations.cycle,
            "x_px": _numbers(localizations.fits.parameters[:, 0], 3),
            "y_px": _numbers(localizations.fits.parameters[:, 1], 3),
            "x": _numbers(localizations.position[:, 0], 12),
            "y": _numbers(localizations.position[:, 1], 12),
            "z": _numbers(localizations.position[:, 2], 12),
            "flux": _numbers(localizations.fits.flux, 0),
            "flags": localizations.flags.tolist(),
        }
        overlay["bodies"] = [
            {
                "body": bodies[pose.body],
                "particle_id": pose.particle_id.tolist(),
                "residual_x": _numbers(pose.residual[:, 0], 12),
                "residual_y": _numbers(pose.residual[:, 1], 12),
                "residual_z": _numbers(pose.residual[:, 2], 12),
            }
            for pose in poses
            if pose.body in bodies and len(pose.particle_id) == len(localizations)
        ]
    return Picture(jpeg, overlay)


def encode(image: NDArray[Any]) -> tuple[bytes, tuple[float, float]]:
    """JPEG of ``image`` (height, width), and the pixel values shown as black and as white."""
    scale = MAX_SIDE_PX / max(image.shape)
    small = image
    if scale < 1:
        small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    dark, bright = np.quantile(small[::2, ::2], (_DARK, _BRIGHT))
    bright = max(bright, dark + 1)
    grey = cv2.convertScaleAbs(
        np.maximum(small, int(dark)), alpha=255 / (bright - dark), beta=-255 * dark / (bright - dark)
    )
    _, data = cv2.imencode(".jpg", grey, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    return data.tobytes(), (float(dark), float(bright))


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _numbers(values: NDArray[np.floating], digits: int) -> list[float | None]:
    """JSON knows no NaN; and digits beyond the noise only cost bandwidth."""
    return [round(value, digits) if np.isfinite(value) else None for value in values.tolist()]
