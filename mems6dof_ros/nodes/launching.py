"""Systems of nodes for `launch`: the thin other half of ``system``. Needs a ROS installation."""

from __future__ import annotations

import os
import uuid
from typing import Any

from mems6dof_ros.nodes.common import PARENT_VARIABLE
from mems6dof_ros.nodes.recorder import RUN_VARIABLE
from mems6dof_ros.nodes.runner import RunningSystem
from mems6dof_ros.nodes.system import NodeSpec, System, arguments, given, parameter_file


def description(system: System) -> Any:
    """LaunchDescription of ``system``: its arguments, then its nodes, once the arguments have values."""
    from launch import LaunchDescription
    from launch.actions import DeclareLaunchArgument, OpaqueFunction

    declared = [
        DeclareLaunchArgument(name, default_value=default, description=doc)
        for name, (default, doc) in system.arguments.items()
    ]
    return LaunchDescription([*declared, OpaqueFunction(function=lambda context: _nodes(system, context))])


def _nodes(system: System, context: Any) -> list[Any]:
    values = {name: context.launch_configurations[name] for name in system.arguments}
    table = system.table(values)
    finite = any(spec.ends_system for spec in table)
    ours = {PARENT_VARIABLE: str(os.getpid()), RUN_VARIABLE: uuid.uuid4().hex}
    return [_node(spec, values["namespace"], values["config"], finite, ours) for spec in table]


def _node(spec: NodeSpec, namespace: str, config: str, finite: bool, environment: dict[str, str]) -> Any:
    from launch.actions import Shutdown
    from launch_ros.actions import Node

    grace, grace_after = RunningSystem.GRACE
    files = [os.fspath(parameter_file(spec, config))] if config else []
    return Node(
        package="mems6dof_ros",
        executable=spec.executable,
        name=spec.executable,
        namespace=namespace,
        ros_arguments=arguments(spec.defaults),  # before the files on the command line
        parameters=[*files, given(spec.parameters)],
        remappings=list(spec.remappings.items()),
        output="screen",
        additional_env=environment,
        # Of a finite system, the end of its source and the failure of any node are the end.
        on_exit=Shutdown() if finite else None,
        respawn=spec.respawn,
        respawn_delay=RunningSystem.RESPAWN_DELAY,
        sigterm_timeout=str(grace),  # launch's own 5 s may be too short for a recorder and its disk
        sigkill_timeout=str(grace_after),
    )
