"""Messages as they must not be: what `mems6dof validate lab` and the tests send to the nodes."""

from __future__ import annotations

import array
import copy
import importlib
import math
import random
from collections.abc import Callable, Iterator
from typing import Any

from rclpy.serialization import serialize_message
from sensor_msgs.msg import Image
from std_msgs.msg import Float64

from mems6dof_msgs.msg import ActuationAcknowledgement, ActuationCommand, FrameInfo, Localizations, Pose6DOF

_UINT32, _UINT64 = 2**32 - 1, 2**64 - 1

#: By name: what is done to a good sensor_msgs/Image so that it cannot be measured.
IMAGE_FAULTS: dict[str, Callable[[Image], None]] = {
    "step too small": lambda image: setattr(image, "step", image.step // 2),
    "step too large": lambda image: setattr(image, "step", _UINT32),
    "odd step": lambda image: setattr(image, "step", image.step + 1),
    "huge size": lambda image: _set(image, width=_UINT32, height=_UINT32, step=_UINT32),
    "no rows": lambda image: _set(image, height=0),
    "no columns": lambda image: _set(image, width=0, step=0),
    "colour": lambda image: _set(image, encoding="rgb8"),
    "floats, all NaN": lambda image: _set(
        image,
        encoding="32FC1",
        step=4 * image.width,
        data=array.array("B", b"\xff" * (4 * image.width * image.height)),
    ),
    "encoding of nobody": lambda image: _set(image, encoding="\x00\xff" * 1000),
    "data cut short": lambda image: _set(image, data=image.data[:-1]),
    "data in excess": lambda image: _set(image, data=image.data + image.data),
    "no data": lambda image: _set(image, data=array.array("B")),
    "empty": lambda image: _set(image, width=0, height=0, step=0, data=array.array("B")),
    "another size": lambda image: _set(
        image, height=image.height // 2, data=image.data[: len(image.data) // 2]
    ),
}

#: By name: what is done to a good FrameInfo so that its image cannot be measured.
INFO_FAULTS: dict[str, Callable[[FrameInfo], None]] = {
    "pixels of other optics": lambda info: _set(info, pixel_size=2 * info.pixel_size),
    "pixels of no size": lambda info: _set(info, pixel_size=0.0),
    "infinite pixels": lambda info: _set(info, pixel_size=math.inf),
    "another camera's saturation": lambda info: _set(info, saturation_adu=1),
}

#: By name: what is done to good Localizations so that they contradict themselves.
LOCALIZATIONS_FAULTS: dict[str, Callable[[Localizations], None]] = {
    "x too short": lambda found: _set(found, x=found.x[:-1]),
    "z too long": lambda found: _set(found, z=found.z + found.z),
    "no covariance": lambda found: _set(found, covariance=array.array("d")),
    "covariance of one more": lambda found: _set(found, covariance=found.covariance + found.covariance[:9]),
    "no flags": lambda found: _set(found, flags=array.array("I")),
    "one chi-square": lambda found: _set(found, chi_square=found.chi_square[:1]),
    "nothing but flags": lambda found: found.__init__(header=found.header, flags=found.flags),
}

#: By name: what is done to good Localizations so that no particle, or few, can be used.
LOCALIZATIONS_NONSENSE: dict[str, Callable[[Localizations], None]] = {
    "all NaN": lambda found: _fill(found, ("x", "y", "z"), math.nan),
    "infinite": lambda found: _fill(found, ("x", "y", "z"), math.inf),
    "huge": lambda found: _fill(found, ("x", "y", "z"), 1e300),
    "all in one place": lambda found: _fill(found, ("x", "y", "z"), 0.0),
    "covariance NaN": lambda found: _fill(found, ("covariance",), math.nan),
    "covariance negative": lambda found: _fill(found, ("covariance",), -1e-18),
    "covariance zero": lambda found: _fill(found, ("covariance",), 0.0),
    "covariance infinite": lambda found: _fill(found, ("covariance",), math.inf),
    "fits NaN": lambda found: _fill(found, ("x", "y", "x_px", "sigma_x_px", "chi_square", "z_gap"), math.nan),
    "all flags": lambda found: _fill(found, ("flags",), _UINT32),
}

#: Of topics whose middleware drops what is no message: what every one that subscribes to them must refuse.
REFUSABLE = (
    Float64(data=math.nan),
    Pose6DOF(body="load_gear", status=255),
    ActuationAcknowledgement(status=255),
    ActuationCommand(id=1, cycles=_UINT32),
)


def spoiled(good: Any, fault: Callable[[Any], None]) -> Any:
    """A copy of the message ``good`` with a fault."""
    message = copy.deepcopy(good)
    fault(message)
    return message


def fuzzed(kind: type, rng: random.Random) -> Any:
    """A message of ``kind`` whose fields have values that their types permit and nobody expects."""
    message = kind()
    for field, typename in kind.get_fields_and_field_types().items():  # type: ignore[attr-defined]
        setattr(
            message,
            field,
            _anything(typename, rng, len(getattr(message, field, ())) if "[" in typename else 0),
        )
    return message


def garbage(kind: type, rng: random.Random) -> Iterator[bytes]:
    """Bytes that are no message of ``kind``: none, random ones, and a message cut off anywhere."""
    yield b""
    yield b"\x00\x01\x00\x00"
    yield b"\x00\x01\x00\x00" + b"\xff" * 64
    yield rng.randbytes(rng.randrange(5, 5000))
    whole = serialize_message(fuzzed(kind, rng))
    yield whole[: rng.randrange(len(whole))]


def _set(message: Any, **values: Any) -> None:
    for name, value in values.items():
        setattr(message, name, value)


def _fill(message: Any, names: tuple[str, ...], value: float) -> None:
    for name in names:
        old = getattr(message, name)
        setattr(message, name, array.array(old.typecode, [value] * len(old)))


_FLOATS = (math.nan, math.inf, -math.inf, 0.0, -1.0, 1e300, -1e300, 1e-300, 1.0)
_TEXTS = ("", "load_gear", "\x00", "é" * 300, "x" * 100_000, "%s%n{}")


def _anything(typename: str, rng: random.Random, fixed: int) -> Any:
    """A value of an IDL type such as ``uint8``, ``sequence<double>``, ``double[36]``, ``pkg/Name``."""
    if typename.startswith("sequence<"):
        element = typename[len("sequence<") :].rstrip(">").split(",")[0]
        return [_anything(element, rng, 0) for _ in range(rng.choice((0, 1, 7, 100)))]
    if "[" in typename:
        return [_anything(typename.split("[")[0], rng, 0) for _ in range(fixed)]
    if "/" in typename:
        package, name = typename.split("/")
        return fuzzed(getattr(importlib.import_module(f"{package}.msg"), name), rng)
    if typename in ("float", "double"):
        value = rng.choice(_FLOATS)
        return (
            math.copysign(min(abs(value), 3e38), value) if typename == "float" and value == value else value
        )
    if typename == "boolean":
        return rng.random() < 0.5
    if typename.startswith("string"):
        return rng.choice(_TEXTS)
    if typename == "octet":
        return rng.randbytes(1)
    bits = int(typename.rpartition("int")[2])
    low, high = (0, 2**bits - 1) if typename.startswith("u") else (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)
    return rng.choice((low, high, 0, 1, rng.randint(low, high)))
