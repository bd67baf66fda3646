"""Frames from a TIFF stack or a folder of images, for instance a focus stack."""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import tifffile
from numpy.typing import NDArray

from mems6dof_ros.errors import InputError
from mems6dof_ros.frame import NAN, Frame, check_image
from mems6dof_ros.sources.source import SourceInfo

TIFF_SUFFIXES = (".tif", ".tiff", ".btf")
IMAGE_SUFFIXES = (*TIFF_SUFFIXES, ".png", ".pgm", ".bmp")

Pixels = NDArray[np.generic]


class ImagesSource:
    """Frames of a TIFF or OME-TIFF stack, or of a folder of single images in natural order of their names.

    8 and 16 bit, one channel. ``pixel_size`` m and ``step`` m (axial distance from image to image) are
    taken from OME metadata where not given; with a step, ``stage_z`` is ``start`` + k ``step``.
    Images carry no time: the k-th is stamped (k + 1) ``period`` s after the epoch, so that nobody takes
    it for a real one. Each image counts as one motion cycle. ``saturation_adu`` 0: unknown.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        pixel_size: float = NAN,
        step: float = NAN,
        start: float = 0.0,
        period: float = 0.1,
        saturation_adu: int = 0,
    ) -> None:
        self._path = Path(path)
        if not self._path.exists():
            raise InputError(str(path), "nothing there", "a TIFF stack or a folder of images")
        if not period > 0:
            raise InputError("period", f"{period}", "a positive number of seconds")
        known_pixel_size, known_step = NAN, NAN
        if self._path.is_dir():
            self._count, self._load = _open_folder(self._path)
        elif self._path.suffix.lower() in TIFF_SUFFIXES:
            self._count, self._load, known_pixel_size, known_step = _open_tiff(self._path)
        else:
            self._count, self._load = 1, lambda _: _read_image(self._path)
        self._pixel_size = known_pixel_size if math.isnan(pixel_size) else pixel_size
        self._step = known_step if math.isnan(step) else step
        self._start, self._period, self._saturation = start, period, saturation_adu
        first = self._read_image(0)
        self._shape, self._dtype = first.shape, first.dtype
        self._next = 0

    @property
    def info(self) -> SourceInfo:
        height, width = self._shape
        encoding = "mono8" if self._dtype == np.uint8 else "mono16"
        return SourceInfo("images", width, height, encoding, self._pixel_size, self._count)

    def start(self) -> None:
        self._next = 0

    def read(self, timeout: float | None = None) -> Frame | None:
        k = self._next
        if k >= self._count:
            return None
        self._next += 1
        image = self._read_image(k)
        if image.shape != self._shape or image.dtype != self._dtype:
            raise InputError(
                f"{self._path}, image {k}",
                f"{image.shape[1]} x {image.shape[0]} px of {image.dtype}",
                f"{self._shape[1]} x {self._shape[0]} px of {self._dtype} like the first",
            )
        return Frame(
            image=image,
            stamp_ns=round((k + 1) * self._period * 1e9),
            frame_counter=k,
            cycle=k,
            stage_z=self._start + k * self._step,
            pixel_size=self._pixel_size,
            saturation_adu=self._saturation,
            source="images",
        )

    def stop(self) -> None:
        pass  # the files stay open for the next start

    def _read_image(self, k: int) -> Pixels:
        image = self._load(k)
        image = image.astype(image.dtype.newbyteorder("="), copy=False)
        check_image(image, f"{self._path}, image {k}")
        return image


def _open_folder(path: Path) -> tuple[int, Callable[[int], Pixels]]:
    files = sorted(
        (file for file in path.iterdir() if file.suffix.lower() in IMAGE_SUFFIXES), key=_natural_order
    )
    if not files:
        raise InputError(str(path), "no images", f"files named {', '.join('*' + s for s in IMAGE_SUFFIXES)}")
    return len(files), lambda k: _read_image(files[k])


def _natural_order(file: Path) -> list[tuple[int, str]]:
    """Numbers by value, so that z10 follows z9."""
    parts = re.split(r"(\d+)", file.name)
    return [(int(part) if part.isdigit() else -1, part) for part in parts]


def _read_image(path: Path) -> Pixels:
    if path.suffix.lower() in TIFF_SUFFIXES:
        count, load, _, _ = _open_tiff(path)
        if count != 1:
            raise InputError(str(path), f"a stack of {count} images", "one image per file of a folder")
        return load(0)
    # OpenCV 4 fills the missing rows of a cut PNG with zeros and says nothing.
    if path.suffix.lower() == ".png" and b"IEND" not in path.read_bytes()[-16:]:
        raise InputError(str(path), "a PNG without its end", "a complete file")
    image = _read_by_opencv(path, 0)
    if image is None:
        raise InputError(str(path), "a damaged file or another format", "a readable image")
    return image


def _open_tiff(path: Path) -> tuple[int, Callable[[int], Pixels], float, float]:
    """Count, loader, pixel size m and axial step m (NaN where the file does not say) of a stack."""
    try:
        with _complaints() as complaints:
            tiff = tifffile.TiffFile(path)
            series = tiff.series[0]
            pages = len(tiff.pages)
        if any("offset" in text or "corrupt" in text for text in complaints):
            raise InputError(str(path), f"{pages} images and then a break", "a complete TIFF")
        if "S" in series.axes:
            raise InputError(str(path), f"colour, axes {series.axes}", "one channel")
        pixel_size, step = _ome_scale(tiff.ome_metadata)
        count, (height, width) = math.prod(series.shape[:-2]), series.shape[-2:]
        if series.dataoffset is not None:
            stored = series.dtype.newbyteorder(tiff.byteorder)
            stack = np.memmap(path, stored, "r", series.dataoffset, (count, height, width))
            return count, lambda k: np.array(stack[k]), pixel_size, step
    except InputError:
        raise
    except Exception as error:  # a foreign parser on foreign bytes: any failure means the same
        raise _damaged(path, error) from error

    def load(k: int) -> Pixels:
        try:
            page, needed = series.pages[k], math.prod(series.keyframe.chunked)
            pieces = min(len(page.dataoffsets), len(page.databytecounts)) if page else 0
            if pieces != needed:  # tifffile fills in zeros
                raise ValueError(f"{pieces} of its {needed} strips or tiles")
            return series.asarray(key=k)
        except Exception as error:
            # Without its optional codecs tifffile knows no LZW, which OpenCV does.
            if "imagecodecs" in str(error) and (image := _read_by_opencv(path, k)) is not None:
                return image
            raise _damaged(f"{path}, image {k}", error) from error

    return count, load, pixel_size, step


def _read_by_opencv(path: Path, k: int) -> Pixels | None:
    """Image ``k`` of a file, None where OpenCV cannot read it; it throws where the sizes are absurd."""
    level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        _, images = cv2.imreadmulti(str(path), k, 1, flags=cv2.IMREAD_UNCHANGED)
    except cv2.error:
        return None
    finally:
        cv2.utils.logging.setLogLevel(level)
    return images[0] if images else None


@contextmanager
def _complaints() -> Iterator[list[str]]:
    """What tifffile logs: that the chain of images breaks off is a warning to it, no error."""
    logger, texts = logging.getLogger("tifffile"), []
    handler = logging.Handler()
    handler.emit = lambda record: texts.append(record.getMessage())  # type: ignore[method-assign]
    logger.addHandler(handler)
    propagate, logger.propagate = logger.propagate, False
    try:
        yield texts
    finally:
        logger.removeHandler(handler)
        logger.propagate = propagate


def _damaged(where: object, error: Exception) -> InputError:
    return InputError(str(where), " ".join(str(error).split()) or type(error).__name__, "a complete TIFF")


def _ome_scale(metadata: str | None) -> tuple[float, float]:
    if not metadata:
        return NAN, NAN
    images = tifffile.xml2dict(metadata)["OME"]["Image"]
    pixels = (images[0] if isinstance(images, list) else images)["Pixels"]
    return _ome_length(pixels, "PhysicalSizeX"), _ome_length(pixels, "PhysicalSizeZ")


def _ome_length(pixels: dict, name: str) -> float:
    unit = {"m": 1.0, "mm": 1e-3, "µm": 1e-6, "um": 1e-6, "nm": 1e-9}.get(pixels.get(f"{name}Unit", "µm"))
    return float(pixels[name]) * unit if name in pixels and unit else NAN
