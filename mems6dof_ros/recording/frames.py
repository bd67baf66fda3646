"""Frames into files: a bag, or a TIFF stack with tables beside it."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

import numpy as np
import tifffile

from mems6dof_ros.errors import InputError
from mems6dof_ros.frame import Frame
from mems6dof_ros.localization.camera import CameraNoise
from mems6dof_ros.recording import messages, topics
from mems6dof_ros.recording.bag import BagWriter
from mems6dof_ros.recording.tables import FRAMES, TRUTH, TableWriter

#: Key of the camera's noise numbers in the provenance of a bag, as JSON.
CAMERA = "camera"


def write_bag(
    path: Path,
    frames: Iterable[Frame],
    camera: CameraNoise,
    provenance: Mapping[str, str],
    progress: Callable[[int], None],
) -> None:
    """Write frames, their information and their truth as a compressed bag; calls ``progress(done)``."""
    provenance = {**provenance, CAMERA: camera_to_json(camera)}
    with BagWriter(path, compression="zstd", provenance=provenance) as bag:
        for done, frame in enumerate(frames, 1):
            write_frame(bag, frame)
            bag.write_message(f"/{topics.CAMERA_INFO}", messages.camera_info(frame), frame.stamp_ns)
            bag.write_message(f"/{topics.IMAGE}", messages.image(frame), frame.stamp_ns)
            bag.flush()
            progress(done)


def write_frame(bag: BagWriter, frame: Frame) -> None:
    """Write what is known of a frame beside its pixels."""
    bag.write_message(f"/{topics.FRAME_INFO}", messages.frame_info(frame), frame.stamp_ns)
    for truth in messages.ground_truths(frame):
        bag.write_message(f"/{topics.TRUTH}", truth, frame.stamp_ns)


def write_tiff(
    path: Path,
    frames: Iterable[Frame],
    camera: CameraNoise,
    provenance: Mapping[str, str],
    progress: Callable[[int], None],
) -> None:
    """Write ``frames.tif`` with ``frames.csv`` and ``truth.csv`` into a new directory ``path``."""
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise InputError(str(path), "something there already", "a new or empty directory")
    path.mkdir(parents=True, exist_ok=True)
    provenance = {**provenance, CAMERA: camera_to_json(camera)}
    with (
        tifffile.TiffWriter(path / "frames.tif", bigtiff=True) as stack,
        TableWriter(path / "frames.csv", FRAMES, provenance) as information,
        TableWriter(path / "truth.csv", TRUTH, provenance) as truths,
    ):
        for done, frame in enumerate(frames, 1):
            stack.write(frame.image, photometric="minisblack", metadata=None)
            information.write(frame)
            for truth in frame.truth:
                truths.write((frame, truth))
            progress(done)


def camera_to_json(camera: CameraNoise) -> str:
    """The camera's noise as JSON; of maps, the means (rms for the read noise)."""
    offset, gain, variance = (float(np.mean(part)) for part in camera.maps)
    values = {"offset_adu": offset, "gain_adu_per_electron": gain, "read_noise_electrons": variance**0.5}
    return json.dumps({**values, "saturation_adu": camera.saturation_adu})


def camera_from_json(text: str) -> CameraNoise:
    """The camera of ``camera_to_json``; InputError for anything else."""
    try:
        return CameraNoise(**json.loads(text))
    except (TypeError, ValueError):
        raise InputError("camera in the provenance", repr(text)[:60], "the camera's noise as JSON") from None
