"""Parameters of running nodes, asked for by the services that every node has, as parameter files."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import yaml
from rcl_interfaces.srv import GetParameters, ListParameters
from rclpy.client import Client
from rclpy.node import Node
from rclpy.parameter import parameter_value_to_python
from rclpy.task import Future


def parameter_file(node: str, values: Mapping[str, Any]) -> tuple[str, str]:
    """Name and text of the parameter file of ``node``, by its full name."""
    known = {name: value for name, value in values.items() if value is not None}
    text = yaml.safe_dump({node: {"ros__parameters": known}})
    return f"parameters{node}.yaml", text


class ParameterReader:
    """Asks nodes for their parameters, once each; for one executor's thread."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._asked: dict[str, _Question] = {}

    def forget(self) -> None:
        """Ask all of them again."""
        for question in self._asked.values():
            question.withdraw()
        self._asked.clear()

    def look(self, topics: Iterable[str]) -> Iterator[tuple[str, str]]:
        """Name and text of the parameter files of nodes that publish on ``topics`` and have answered since
        the last call. One that went away is asked anew when it comes back."""
        here = set()
        for topic in topics:
            for info in self._node.get_publishers_info_by_topic(topic):
                here.add(f"{info.node_namespace.rstrip('/')}/{info.node_name}")
        here.discard(self._node.get_fully_qualified_name())
        for name in self._asked.keys() - here:
            self._asked.pop(name).withdraw()
        for name in here:
            question = self._asked.setdefault(name, _Question(self._node, name))
            if (values := question.look()) is not None:
                yield parameter_file(name, values)


class _Question:
    """To one node: the names of its parameters, then their values."""

    def __init__(self, node: Node, name: str) -> None:
        self._node = node
        self._name = name
        self._clients: list[Client] = []
        self._names: Future | None = None
        self._values: Future | None = None
        self._done = False

    def look(self) -> dict[str, Any] | None:
        """Go on as far as the answers are there; returns the values once."""
        if self._done:
            return None
        if not self._clients:
            for kind, service in ((ListParameters, "list_parameters"), (GetParameters, "get_parameters")):
                self._clients.append(self._node.create_client(kind, f"{self._name}/{service}"))
        names, values = self._clients
        if self._names is None and names.service_is_ready() and values.service_is_ready():
            self._names = names.call_async(ListParameters.Request())
        elif self._values is None and self._names is not None and self._names.done():
            found = self._names.result().result.names
            self._values = values.call_async(GetParameters.Request(names=found))
        elif self._names is not None and self._values is not None and self._values.done():
            answers = map(parameter_value_to_python, self._values.result().values)
            found = dict(zip(self._names.result().result.names, map(_plain, answers), strict=False))
            self.withdraw()
            return found
        return None

    def withdraw(self) -> None:
        """Ask no more."""
        for client in self._clients:
            self._node.destroy_client(client)
        self._clients, self._done = [], True


def _plain(value: Any) -> Any:
    return list(value) if not isinstance(value, (str, bytes)) and hasattr(value, "__len__") else value
