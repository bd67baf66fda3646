"""Parameters as plain data: declared with descriptors, checked with a reason, written as commented YAML.

One table per node is the only place where a parameter is described; the node declares it, and
``config/*.yaml`` is generated from it.
"""

from __future__ import annotations

import dataclasses
import difflib
import importlib
import math
import sys
import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    ParameterType,
    SetParametersResult,
)
from rclpy.exceptions import (
    InvalidParameterTypeException,
    InvalidParameterValueException,
    ParameterUninitializedException,
)
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter

from mems6dof_ros.errors import InputError

#: The nodes with a table ``PARAMETERS``.
NODES = (
    "frame_source",
    "localizer",
    "pose_estimator",
    "pipeline",
    "recorder",
    "calibrator",
    "controller",
    "monitor",
    "foxglove_bridge",
)

#: Label of the state of a managed node in which parameters take effect.
UNCONFIGURED = "unconfigured"

Value = bool | int | float | str | Sequence[Any]
Settings = TypeVar("Settings")

#: Types in error messages.
_TYPE_NAMES = {
    ParameterType.PARAMETER_BOOL: "true or false",
    ParameterType.PARAMETER_INTEGER: "a whole number",
    ParameterType.PARAMETER_DOUBLE: "a number with a decimal point, such as 10.0",
    ParameterType.PARAMETER_STRING: "a text",
    ParameterType.PARAMETER_INTEGER_ARRAY: "a list of whole numbers",
    ParameterType.PARAMETER_DOUBLE_ARRAY: "a list of numbers with decimal points, such as [1.0, 2.0]",
    ParameterType.PARAMETER_STRING_ARRAY: "a list of texts",
}
_SCALARS = {
    bool: ParameterType.PARAMETER_BOOL,
    int: ParameterType.PARAMETER_INTEGER,
    float: ParameterType.PARAMETER_DOUBLE,
    str: ParameterType.PARAMETER_STRING,
}
_ARRAYS = {
    int: ParameterType.PARAMETER_INTEGER_ARRAY,
    float: ParameterType.PARAMETER_DOUBLE_ARRAY,
    str: ParameterType.PARAMETER_STRING_ARRAY,
}
#: Declared by rclpy itself.
_FOREIGN = ("use_sim_time", "start_type_description_service", "qos_overrides.")


@dataclass(frozen=True)
class Parameter:
    """One parameter of a node.

    ``span``: inclusive range of a number; ``choices``: the permitted texts; ``element``: type of the
    elements of a list; ``optional``: NaN is permitted and means "not set"; ``changeable``: may be set in any
    state of the node; the others only while it is unconfigured, ``fixed`` ones never.
    """

    name: str
    default: Value
    doc: str
    unit: str = ""
    span: tuple[float, float] | None = None
    choices: tuple[str, ...] = ()
    element: type = str
    optional: bool = False
    changeable: bool = False
    fixed: bool = False

    @property
    def type(self) -> int:
        """Of rcl_interfaces/ParameterType."""
        if isinstance(self.default, (tuple, list)):
            return _ARRAYS[self.element]
        return _SCALARS[type(self.default)]

    @property
    def constraint(self) -> str:
        """What is permitted, in words; empty: anything of its type."""
        parts = []
        if self.choices:
            parts.append(f"one of {', '.join(choice or 'empty' for choice in self.choices)}")
        if self.span:
            parts.append(f"{_number(self.span[0])} to {_number(self.span[1])}")
        if self.optional:
            parts.append(".nan: not set")
        return "; ".join(parts)

    def check(self, value: Any) -> str:
        """Why ``value`` is refused; empty: it is fine."""
        numbers = [v for v in (value if isinstance(value, Sequence) else [value]) if isinstance(v, float)]
        if any(math.isinf(v) or (math.isnan(v) and not self.optional) for v in numbers):
            return f"found {value}; expected {self.constraint or 'finite numbers'}"
        if self.choices and value not in self.choices:
            return f"found '{value}'; expected {self.constraint}"
        if self.span and not all(self.span[0] <= v <= self.span[1] for v in [value] if not math.isnan(v)):
            return f"found {value}; expected {self.constraint} {self.unit}".rstrip()
        return ""

    def descriptor(self) -> ParameterDescriptor:
        """For rclpy."""
        unit = f" [{self.unit}]" if self.unit else ""
        when = "" if self.changeable or self.fixed else f"set while {UNCONFIGURED}"
        descriptor = ParameterDescriptor(
            name=self.name,
            type=self.type,
            description=f"{self.doc}{unit}",
            additional_constraints="; ".join(filter(None, (self.constraint, when))),
            read_only=self.fixed,
        )
        if self.span and self.type == ParameterType.PARAMETER_INTEGER:
            first, last = map(int, self.span)
            descriptor.integer_range = [IntegerRange(from_value=first, to_value=last, step=1)]
        elif self.span and not self.optional:  # rclpy takes NaN for out of any range
            low, high = map(float, self.span)
            descriptor.floating_point_range = [FloatingPointRange(from_value=low, to_value=high, step=0.0)]
        return descriptor


#: Of every node.
AUTOSTART = Parameter(
    "autostart",
    True,
    "Configure and activate by itself; otherwise whoever manages lifecycle nodes does.",
    fixed=True,
)

#: Of nodes that can be paused.
START_PAUSED = Parameter("start_paused", False, "Once active, wait for a call of ~/start.")


def of_settings(
    settings: type, prefix: str, docs: Mapping[str, tuple[str, str]] | None = None
) -> tuple[Parameter, ...]:
    """Parameters of a dataclass of settings, from the ``metadata`` of its fields or from ``docs``:
    name to (unit, doc). Fields that are settings themselves are left out."""
    parameters = []
    for field in dataclasses.fields(settings):
        if field.default is dataclasses.MISSING:
            continue
        default = () if field.default is None else field.default
        metadata = field.metadata
        unit, doc = (docs or {}).get(field.name) or (metadata.get("unit", ""), metadata.get("doc", ""))
        parameters.append(
            Parameter(
                prefix + field.name,
                default,
                doc,
                unit,
                span=metadata.get("range"),
                choices=metadata.get("choices", ()),
                element=metadata.get("element", float),
                optional=isinstance(default, float) and math.isnan(default),
            )
        )
    return tuple(parameters)


def to_settings(settings: type[Settings], prefix: str, values: Mapping[str, Any], **others: Any) -> Settings:
    """The dataclass of settings from the values of its parameters; InputError as it raises them."""
    taken = dict(others)
    for field in dataclasses.fields(settings):  # type: ignore[arg-type]
        if prefix + field.name in values:
            value = values[prefix + field.name]
            if isinstance(value, list):
                value = tuple(value) if value or field.default is not None else None
            taken[field.name] = value
    return settings(**taken)


def declare(
    node: Node, parameters: Iterable[Parameter], state: Callable[[], str] = lambda: UNCONFIGURED
) -> dict[str, Any]:
    """Declare all on the node and return their values by name, kept current when they are set later; which
    is refused, but for changeable ones, while the ``state`` of the node is not "unconfigured".

    Raises InputError where a value that the user gave is of the wrong type, out of range, not finite, or
    for a parameter that does not exist.
    """
    known = {parameter.name: parameter for parameter in parameters}
    _refuse_unknown(node, known)
    values = {}
    for name, parameter in known.items():
        default: Any = parameter.default
        if isinstance(default, (tuple, list)):
            # rclpy cannot tell the type of an empty list.
            default = list(default) or RosParameter.Type(parameter.type)
        try:
            value = node.declare_parameter(name, default, parameter.descriptor()).value
        except ParameterUninitializedException:
            value = []
        except InvalidParameterTypeException:
            found = _given(node)[name].value
            raise InputError(f"parameter {name}", repr(found), _TYPE_NAMES[parameter.type]) from None
        except InvalidParameterValueException:
            found = _given(node)[name].value
            raise InputError(f"parameter {name}", repr(found), parameter.constraint) from None
        if value is None:
            if not isinstance(parameter.default, (tuple, list)):
                raise InputError(f"parameter {name}", "nothing", _TYPE_NAMES[parameter.type])
            value = []
        if value == []:  # otherwise whoever asks for all parameters of the node is told of none
            node.set_parameters([RosParameter(name, RosParameter.Type(parameter.type), value)])
        values[name] = value
        if reason := parameter.check(values[name]):
            found, expected = reason.removeprefix("found ").split("; expected ", 1)
            raise InputError(f"parameter {name}", found, expected)

    def refuse(changes: list[RosParameter]) -> SetParametersResult:
        for change in changes:
            parameter = known.get(change.name)
            if parameter is None:
                continue
            reason = parameter.check(change.value)
            if not parameter.changeable and (now := state()) != UNCONFIGURED:
                reason = f"can be set only while the node is {UNCONFIGURED}, and it is {now}"
            if reason:
                return SetParametersResult(successful=False, reason=f"{change.name}: {reason}")
        return SetParametersResult(successful=True)

    def note(changes: list[RosParameter]) -> None:
        values.update({change.name: change.value for change in changes if change.name in known})

    node.add_on_set_parameters_callback(refuse)
    node.add_post_set_parameters_callback(note)
    return values


def _given(node: Node) -> Mapping[str, RosParameter]:
    """What the user has set on the command line or in files; rclpy has no public way to it."""
    return node._parameter_overrides


def _refuse_unknown(node: Node, known: Mapping[str, Parameter]) -> None:
    for name in _given(node):
        if name not in known and not name.startswith(_FOREIGN):
            close = difflib.get_close_matches(name, known, n=1)
            hint = f"'{close[0]}'" if close else f"one of {', '.join(known)}"
            raise InputError("parameters", f"unknown '{name}'", hint)


def as_yaml(title: str, parameters: Iterable[Parameter]) -> str:
    """A parameter file with every parameter at its default, under ``/**:``, commented."""
    lines = [f"# {line}" for line in textwrap.wrap(title, 98)] + ["/**:", "  ros__parameters:"]
    section: tuple[str, ...] = ()
    for parameter in parameters:
        *path, name = parameter.name.split(".")
        if tuple(path) != section:
            section = tuple(path)
            lines += ["", f"    {'.'.join(section)}:"] if section else [""]
        indent = "    " + "  " * bool(section)
        notes = [note for note in (parameter.unit, parameter.constraint) if note]
        if parameter.changeable:
            notes.append("may be changed while running")
        doc = parameter.doc + (f" ({'; '.join(notes)})" if notes else "")
        lines += [f"{indent}# {line}" for line in textwrap.wrap(doc, 102 - len(indent))]
        lines.append(f"{indent}{name}: {to_yaml(parameter.default)}")
    return "\n".join(lines) + "\n"


def to_yaml(value: Value) -> str:
    """A value as YAML that ROS 2 reads back with its type."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        return ".nan" if math.isnan(value) else _decimal(value)
    if isinstance(value, str):
        return f'"{value}"'
    if isinstance(value, Sequence):
        return f"[{', '.join(map(to_yaml, value))}]"
    return str(value)


def _decimal(value: float) -> str:
    """With a decimal point, also before an exponent: YAML takes 1e-6 for a text."""
    mantissa, exponent, power = repr(value).partition("e")
    if "." not in mantissa:
        mantissa += ".0"
    return mantissa + exponent + power


def _number(value: float) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


def main() -> None:
    """Write ``config/<node>.yaml`` of every node into the directory given, by default ``config``."""
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else "config")
    for name in NODES:
        (folder / f"{name}.yaml").write_text(config_text(name), encoding="utf-8")


def config_text(name: str) -> str:
    """The parameter file of the node ``name``."""
    module = importlib.import_module(f"mems6dof_ros.nodes.{name}")
    title = f"Parameters of {name}, all at their defaults. Generated by make config: do not edit, copy."
    return as_yaml(title, (AUTOSTART, *module.PARAMETERS))


if __name__ == "__main__":
    main()
