"""Systems of nodes as plain data.

A ``System`` has the arguments of a launch file and a function from their values to a table of nodes. The
files in ``launch_scripts/`` hand these tables to `launch`, ``runner`` starts them where it is missing.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from mems6dof_ros.errors import InputError
from mems6dof_ros.nodes.common import WAIT_PARAMETER
from mems6dof_ros.nodes.recorder import DEFAULT_TOPICS
from mems6dof_ros.pose.bodies_file import load_bodies
from mems6dof_ros.recording import topics
from mems6dof_ros.recording.frames import camera_to_json
from mems6dof_ros.recording.poses import pose_topics
from mems6dof_ros.simulation.settings import SimulationSettings
from mems6dof_ros.sources.simulator import camera_noise

#: What each node publishes and can be told to hold back until somebody listens.
_PUBLISHED = {
    "frame_source": (topics.IMAGE, topics.FRAME_INFO, topics.CAMERA_INFO, topics.TRUTH),
    "localizer": (topics.LOCALIZATIONS,),
    "pose_estimator": (topics.POSE_6DOF, topics.POSE, topics.POSE_WITH_COVARIANCE),
}
_PUBLISHED["pipeline"] = tuple(topic for published in _PUBLISHED.values() for topic in published)
_SUBSCRIBED = {
    "localizer": (topics.IMAGE, topics.FRAME_INFO),
    "pose_estimator": (topics.LOCALIZATIONS,),
    "controller": (topics.POSE_6DOF,),
}


@dataclass(frozen=True)
class NodeSpec:
    """One node of a system: ``executable`` of this package, with its parameters and remappings.

    ``ends_system``: when this process ends, the others have nothing left to do. ``respawn``: when it fails or
    is killed, it is started again.
    """

    executable: str
    parameters: Mapping[str, Any] = field(default_factory=dict)
    remappings: Mapping[str, str] = field(default_factory=dict)
    ends_system: bool = False
    respawn: bool = False


@dataclass(frozen=True)
class System:
    """``arguments``: name to default and description, as texts; ``nodes``: from their values to the table,
    in the order in which frames flow, which is also the order in which the nodes are stopped."""

    doc: str
    arguments: Mapping[str, tuple[str, str]]
    nodes: Callable[[Mapping[str, str]], list[NodeSpec]]

    def table(self, values: Mapping[str, str]) -> list[NodeSpec]:
        """The nodes for ``values``, defaults for the rest; InputError for an unknown argument."""
        for name in values:
            if name not in self.arguments:
                raise InputError("arguments", f"'{name}'", f"one of {', '.join(self.arguments)}")
        return self.nodes({**{name: default for name, (default, _) in self.arguments.items()}, **values})


# Tables ------------------------------------------------------------------------------------------


def given(node: NodeSpec) -> dict[str, Any]:
    """The parameters of a node that can be handed over: ROS 2 has no way to write an empty list or text."""
    return {name: value for name, value in node.parameters.items() if value not in ("", [], ())}


def chain(
    source: NodeSpec | None,
    *,
    calibration: str,
    bodies: str = "",
    output: str = "",
    queue_policy: str = "block",
    image_topic: str = topics.IMAGE,
    recorded: Sequence[str] = DEFAULT_TOPICS,
    compression: str = "none",
    controller: NodeSpec | None = None,
    watched: Mapping[str, str] | None = None,
    monitor: NodeSpec | None = None,
    arrangement: str = "processes",
) -> list[NodeSpec]:
    """frame_source, localizer, pose_estimator, ``controller`` if any, with an ``output`` recorder, and
    ``monitor`` if any. ``arrangement`` pipeline: the first three in one process.

    ``source`` None: a camera driver of somebody else publishes ``image_topic``. Each node waits for the
    subscribers that the table gives it, and for those in ``watched`` (topic to the name of a node that is
    not in the table), so that nothing is lost at the beginning. Nobody waits for a monitor. ``bodies``: file
    of several bodies in view, whose topics are recorded too.
    """
    further = _topics_of_further(bodies)
    queue = {"queue_policy": queue_policy}
    remap = {topics.IMAGE: image_topic} if image_topic != topics.IMAGE else {}
    if arrangement == "pipeline":
        nodes = [_in_one_process(source, calibration, bodies)]
    elif arrangement == "processes":
        nodes = [source] if source else []
        nodes.append(NodeSpec("localizer", {"calibration": calibration, **queue}, remap))
        nodes.append(NodeSpec("pose_estimator", {"calibration": calibration, "bodies": bodies, **queue}))
    else:
        raise InputError("argument arrangement", f"'{arrangement}'", "processes or pipeline")
    if controller:
        nodes.append(controller)
    if output:
        recorder = {
            "output": output,
            "topics": [*recorded, *further],
            "compression": compression,
            "attachments": [file for file in (calibration, bodies) if file],
        }
        nodes.append(NodeSpec("recorder", recorder, remap))
    if monitor:
        nodes.append(replace(monitor, remappings=remap))
    subscribed = [(topic, node.executable) for node in nodes for topic in _subscriptions(node)]
    subscribed += (watched or {}).items()
    return [_waiting_for_subscribers(node, subscribed, further) for node in nodes]


def _topics_of_further(bodies: str) -> list[str]:
    """Topics of the bodies after the first in the file ``bodies``."""
    if not bodies:
        return []
    names = [estimator.body for estimator in load_bodies(Path(bodies)).estimators]
    return [topic for topic in pose_topics(names) if topic not in pose_topics(names[:1])]


def simulated(cycles: int, **settings: Any) -> NodeSpec:
    """A frame_source that simulates ``cycles`` and ends when all of them have become poses."""
    options = {f"simulator.{name}": value for name, value in settings.items()}
    return _finite("simulator", {"simulator.cycles": cycles, **options})


def commanded(**settings: Any) -> NodeSpec:
    """A frame_source that simulates the microsystem under command: a frame for each cycle asked for."""
    options = {f"simulator.{name}": value for name, value in settings.items()}
    return NodeSpec(
        "frame_source",
        {"source": "simulator", "pacing": "rate", "rate": 0.0, "simulator.commanded": True, **options},
    )


def replayed(bag: str, topic: str = "", **parameters: Any) -> NodeSpec:
    """A frame_source that replays a bag and ends when all of it has become poses; further ``parameters``."""
    return _finite("bag", {"bag.path": bag, "bag.topic": topic, **parameters})


def _finite(kind: str, options: Mapping[str, Any]) -> NodeSpec:
    pacing = {"pacing": "consumer", "acknowledged_by": topics.POSE_6DOF}
    return NodeSpec("frame_source", {"source": kind, **pacing, **options}, ends_system=True)


def _in_one_process(source: NodeSpec | None, calibration: str, bodies: str) -> NodeSpec:
    if source is None:
        found = "pipeline without a source of ours"
        raise InputError("argument arrangement", found, "processes, where somebody else publishes the images")
    parameters = {name: value for name, value in source.parameters.items() if name != "acknowledged_by"}
    if parameters["pacing"] == "consumer":
        parameters |= {"pacing": "rate", "rate": 0.0}  # what is called is waited for
    parameters |= {"calibration": calibration, "bodies": bodies}
    return replace(source, executable="pipeline", parameters=parameters)


def _waiting_for_subscribers(
    node: NodeSpec, subscribed: Sequence[tuple[str, str]], further: Sequence[str]
) -> NodeSpec:
    published = _PUBLISHED.get(node.executable, ())
    if topics.POSE_6DOF in published:
        published = (*published, *further)
    waits = [f"{topic}:{name}" for topic, name in subscribed if topic in published]
    return replace(node, parameters={**node.parameters, WAIT_PARAMETER.name: waits}) if waits else node


def _subscriptions(node: NodeSpec) -> Sequence[str]:
    if node.executable == "recorder":
        return list(node.parameters["topics"])
    if node.executable in ("frame_source", "pipeline"):
        paced = node.parameters.get("pacing") == "consumer"
        return [node.parameters["acknowledged_by"]] if paced else []
    return _SUBSCRIBED.get(node.executable, ())


def _live(values: Mapping[str, str]) -> list[NodeSpec]:
    source = None
    if values["source"] != "none":
        parameters = {"source": values["source"], "pacing": "rate", "rate": _number(values, "rate")}
        source = NodeSpec("frame_source", parameters)
    image_topic = values["image_topic"]
    nodes = chain(source, queue_policy="drop_oldest", image_topic=image_topic, **_common(values))
    return _respawning(_tracking(nodes, values), values)


def _replay(values: Mapping[str, str]) -> list[NodeSpec]:
    # What is not told is left to the parameter files.
    told = {name: kind(values, name) for name, kind in _REPLAYING.items() if values[name]}
    return chain(replayed(values["bag"], values["topic"], **told), **_common(values))


def _demo(values: Mapping[str, str]) -> list[NodeSpec]:
    size = _whole(values, "size")
    source = simulated(
        _whole(values, "cycles"),
        width_px=size,
        height_px=size,
        seed=_whole(values, "seed"),
        optics_seed=_whole(values, "optics_seed"),
    )
    return chain(source, **_common(values))


def _closed_loop(values: Mapping[str, str]) -> list[NodeSpec]:
    size = _whole(values, "size")
    source = commanded(
        width_px=size, height_px=size, seed=_whole(values, "seed"), optics_seed=_whole(values, "optics_seed")
    )
    controller = NodeSpec("controller", {"law": values["law"]})
    return _respawning(chain(source, controller=controller, **_common(values)), values)


def _calibrate(values: Mapping[str, str]) -> list[NodeSpec]:
    """A camera, the stage of it where it is simulated, and the calibrator; all else waits for a goal."""
    remap = {topics.IMAGE: values["image_topic"]} if values["image_topic"] != topics.IMAGE else {}
    calibrator = NodeSpec("calibrator", remappings=remap)
    if values["source"] == "none":
        return [calibrator]
    camera = {"source": values["source"], "pacing": "rate", "rate": _number(values, "rate")}
    if values["source"] != "simulator":
        return [NodeSpec("frame_source", camera), calibrator]
    size = _whole(values, "size")
    simulated_substrate = {
        "simulator.substrate": True,
        "simulator.substrate_beads": max(200 * size**2 // 2048**2, 12),
        "simulator.width_px": size,
        "simulator.height_px": size,
        "simulator.seed": _whole(values, "seed"),
        "simulator.optics_seed": _whole(values, "optics_seed"),
    }
    simulation = SimulationSettings()
    noise = json.loads(camera_to_json(camera_noise(simulation)))
    known = {f"camera.{name}": float(value) for name, value in noise.items()}
    known |= {"wavelength": simulation.wavelength, "bead_diameter": simulation.diameter}
    return [NodeSpec("frame_source", camera | simulated_substrate), replace(calibrator, parameters=known)]


def _common(values: Mapping[str, str]) -> dict[str, Any]:
    """What ``chain`` is told by the arguments that every system has."""
    return {
        "calibration": values["calibration"],
        "bodies": values["bodies"],
        "output": values["output"],
        "monitor": _monitor(values),
        "arrangement": values["arrangement"],
    }


def _monitor(values: Mapping[str, str]) -> NodeSpec | None:
    return NodeSpec("monitor") if _truth(values, "monitor") else None


def with_tracking(nodes: Sequence[NodeSpec]) -> list[NodeSpec]:
    """The ``nodes``, particles tracked and not searched in every frame."""
    return [
        replace(node, parameters={**node.parameters, "tracking.enabled": True})
        if node.executable in ("localizer", "pipeline")
        else node
        for node in nodes
    ]


def _tracking(nodes: list[NodeSpec], values: Mapping[str, str]) -> list[NodeSpec]:
    """With the tracking that the argument asks for, where there is but one body to follow."""
    return with_tracking(nodes) if _truth(values, "tracking") and not values["bodies"] else nodes


def _respawning(nodes: list[NodeSpec], values: Mapping[str, str]) -> list[NodeSpec]:
    respawn = _truth(values, "respawn")
    return [replace(node, respawn=respawn) for node in nodes]


def _number(values: Mapping[str, str], name: str) -> float:
    try:
        return float(values[name])
    except ValueError:
        raise InputError(f"argument {name}", f"'{values[name]}'", "a number") from None


def _whole(values: Mapping[str, str], name: str) -> int:
    try:
        return int(values[name])
    except ValueError:
        raise InputError(f"argument {name}", f"'{values[name]}'", "a whole number") from None


def _truth(values: Mapping[str, str], name: str) -> bool:
    if values[name] not in ("true", "false"):
        raise InputError(f"argument {name}", f"'{values[name]}'", "true or false")
    return values[name] == "true"


_REPLAYING: Mapping[str, Callable[[Mapping[str, str], str], float]] = {
    "speed": _number,
    "begin": _number,
    "loop": _truth,
    "start_paused": _truth,
    "publish_clock": _truth,
}
_CALIBRATION = {
    "calibration": ("", "Calibration file; empty: x and y only"),
    "bodies": ("", "File of several rigid bodies in view (docs/files.md); empty: one"),
}
_OUTPUT = {"output": ("", "Directory of the bag to record; empty: none")}
_ARRANGEMENT = {
    "arrangement": (
        "processes",
        "processes: one for each node; pipeline: source, localizer and pose in one, for the lowest latency",
    )
}
_TRACKING = {
    "tracking": (
        "true",
        "Fit where the motion of the one body says that its particles will be, and search whole frames now"
        " and then; false: search every frame. Of several bodies none is followed",
    )
}
_MONITOR = {"monitor": ("false", "true: show it live to browsers on this machine, see docs/monitor.md")}
_RESPAWN = {"respawn": ("false", "true: start a node again, after a second, that has failed or was killed")}
_CONFIG = {"config": ("", "Directory of parameter files, <node>.yaml each; empty: defaults")}
_NAMESPACE = {"namespace": ("", "Namespace of the nodes and their topics")}
_SIMULATION = {
    "size": ("2048", "Width and height of the frames, px"),
    "seed": ("1", "Seed of particles, motion and noise"),
    "optics_seed": ("1", "Seed of the optics; must be that of the calibration"),
}

SYSTEMS = {
    "live": System(
        "A source at its own pace; what cannot be kept up with is dropped, oldest first, and counted.",
        {
            **_CALIBRATION,
            "source": ("simulator", "Source of the frames; none: a camera driver publishes image_topic"),
            "rate": ("10.0", "Frames per second; 0.0: as the source delivers them"),
            "image_topic": (topics.IMAGE, "Topic of the images"),
            **_OUTPUT,
            **_ARRANGEMENT,
            **_TRACKING,
            **_MONITOR,
            **_RESPAWN,
            **_CONFIG,
            **_NAMESPACE,
        },
        _live,
    ),
    "replay": System(
        "A bag, nothing lost.",
        {
            "bag": ("", "Directory of a rosbag2 bag, or an .mcap file"),
            "topic": ("", "Topic of its images; empty: the only one, or the only one named image_raw"),
            "speed": ("", "At most so many times as fast as recorded; empty: as fast as the nodes take it"),
            "begin": ("", "Seconds of the recording to leave out at its beginning"),
            "loop": ("", "true: begin again at the end, with stamps that follow"),
            "start_paused": ("", "true: wait for frame_source/start, or /step for a frame each"),
            "publish_clock": ("", "true: publish /clock, for nodes with use_sim_time"),
            **_CALIBRATION,
            **_OUTPUT,
            **_ARRANGEMENT,
            **_MONITOR,
            **_CONFIG,
            **_NAMESPACE,
        },
        _replay,
    ),
    "demo": System(
        "A simulated gear as fast as the nodes take it, nothing lost.",
        {
            **_CALIBRATION,
            "cycles": ("80", "Motion cycles; 80 are a revolution"),
            **_SIMULATION,
            **_OUTPUT,
            **_ARRANGEMENT,
            **_MONITOR,
            **_CONFIG,
            **_NAMESPACE,
        },
        _demo,
    ),
    "closed_loop": System(
        "A simulated gear on a drive that errs, and a controller that brings it to the angles on psi_target.",
        {
            **_CALIBRATION,
            "law": ("", "module:Class of the law that decides the motion; empty: the controller's own"),
            **_SIMULATION,
            **_OUTPUT,
            **_ARRANGEMENT,
            **_MONITOR,
            **_RESPAWN,
            **_CONFIG,
            **_NAMESPACE,
        },
        _closed_loop,
    ),
    "calibrate": System(
        "A camera over a substrate of beads, a stage, and the calibrator, which waits for 'mems6dof scan'.",
        {
            "source": ("simulator", "Source of the frames; none: a camera driver publishes image_topic"),
            "rate": ("5.0", "Frames per second; 0.0: as the source delivers them"),
            "image_topic": (topics.IMAGE, "Topic of the images"),
            **_SIMULATION,
            **_CONFIG,
            **_NAMESPACE,
        },
        _calibrate,
    ),
}
