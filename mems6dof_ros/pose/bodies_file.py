"""Which rigid bodies are in view: a YAML file to one PoseEstimator for each.

```yaml
settings: {field_degree: 4}                                       # fields of PoseSettings, for all
bodies:
  load_gear:
    region: {centre: [-100.0e-6, 0], outer_radius: 170.0e-6}      # m, microscope frame
  ring_gear:
    region: {centre: [474.0e-6, 0], outer_radius: 420.0e-6, inner_radius: 300.0e-6}
    constellation: ring_gear_constellation.json                   # of an earlier session; beside this file
    settings: {confirm_after: 2}                                  # of this body alone
```

Settings of the field error are common to all bodies, because their optics are.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from mems6dof_ros.documents import read_document
from mems6dof_ros.errors import InputError
from mems6dof_ros.pose.bodies import COMMON_SETTINGS, Bodies
from mems6dof_ros.pose.constellation_file import ReferenceConstellation
from mems6dof_ros.pose.estimator import PoseEstimator
from mems6dof_ros.pose.field import FieldError
from mems6dof_ros.pose.settings import PoseSettings, Region

_OF_A_BODY = ("region", "constellation", "settings")


def load_bodies(path: Path, settings: PoseSettings | None = None, field: FieldError | None = None) -> Bodies:
    """The estimators that ``path`` describes, in its order; ``settings`` where it sets nothing of its own;
    ``field``: what is known of the field error.

    Raises InputError for anything but the form above, and for bodies that cannot be told apart.
    """
    content = read_document(path, "YAML", "a file of bodies")
    content = _mapping(content, str(path), ("settings", "bodies"))
    names = [item.name for item in fields(PoseSettings)]
    common = _settings(content.get("settings"), names, f"{path}: settings")
    settings, bodies = replace(settings or PoseSettings(), **common), content.get("bodies")
    if not isinstance(bodies, dict) or not bodies:
        raise InputError(str(path), "no bodies", "'bodies:' with one entry for each")
    for name in bodies:
        if not re.fullmatch("[A-Za-z][A-Za-z0-9_]*", str(name)):
            raise InputError(f"{path}: body {name}", "this name", "letters, digits and _, as in a topic")
    return Bodies([_estimator(str(name), entry, path, settings, field) for name, entry in bodies.items()])


def _estimator(
    name: str, entry: Any, path: Path, settings: PoseSettings, field: FieldError | None
) -> PoseEstimator:
    where = f"{path}: body {name}"
    entry = _mapping(entry, where, _OF_A_BODY)
    names = [item.name for item in fields(PoseSettings) if item.name not in COMMON_SETTINGS]
    own = _settings(entry.get("settings"), names, where)
    region = reference = None
    if "region" in entry:
        region = _region(entry["region"], f"{where}: region")
    if "constellation" in entry:
        reference = ReferenceConstellation.load(path.parent / str(entry["constellation"]))
    return PoseEstimator(replace(settings, **own), name, region, reference, field)


def _region(entry: Any, where: str) -> Region:
    entry = _mapping(entry, where, [item.name for item in fields(Region)])
    centre = entry.get("centre")
    if not isinstance(centre, list) or len(centre) != 2 or "outer_radius" not in entry:
        raise InputError(where, repr(entry), "centre [x, y] and outer_radius, in m")
    x, y = (_number(value, f"{where}: centre") for value in centre)
    radii = {key: _number(value, f"{where}: {key}") for key, value in entry.items() if key != "centre"}
    return Region((x, y), **radii)


def _settings(entry: Any, names: Sequence[str], where: str) -> dict[str, Any]:
    """Values for the fields ``names`` of PoseSettings."""
    return {
        key: _setting(key, value, f"{where}: {key}") for key, value in _mapping(entry, where, names).items()
    }


def _setting(name: str, value: Any, where: str) -> Any:
    """``value`` in the type that PoseSettings has for ``name``, which checks the rest."""
    default = getattr(PoseSettings(), name)
    if default is None or isinstance(default, tuple):
        if not isinstance(value, list):
            raise InputError(where, repr(value), "a list of numbers")
        return tuple(_number(item, where) for item in value)
    if isinstance(default, float):
        return _number(value, where)
    if type(value) is not type(default):
        raise InputError(where, repr(value), "a whole number" if isinstance(default, int) else "text")
    return value


def _number(value: Any, where: str) -> float:
    """YAML 1.1 takes 170e-6, without a point, for text."""
    try:
        return float(value)
    except (TypeError, ValueError, OverflowError):
        raise InputError(where, repr(value), "a number") from None


def _mapping(value: Any, where: str, names: Any) -> Mapping[str, Any]:
    """``value`` as a mapping with no other keys than ``names``; nothing is an empty one."""
    if value is None:
        return {}
    if not isinstance(value, dict):
        raise InputError(where, repr(value), f"a mapping of {', '.join(names)}")
    for key in value:
        if key not in names:
            raise InputError(where, f"unknown {key!r}", f"one of {', '.join(names)}")
    return value
