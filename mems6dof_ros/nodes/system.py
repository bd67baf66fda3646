"""Systems of nodes as plain data.

A ``System`` has the arguments of a launch file and a function from their values to a table of nodes. The
files in ``launch_scripts/`` hand these tables to `launch`, ``runner`` starts them where it is missing.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import yaml

from mems6dof_ros.errors import InputError
from mems6dof_ros.nodes.common import WAIT_PARAMETER
from mems6dof_ros.nodes.parameters import to_yaml
from mems6dof_ros.nodes.recorder import DEFAULT_TOPICS
from mems6dof_ros.pose.bodies_file import load_bodies
from mems6dof_ros.recording import topics
from mems6dof_ros.recording.frames import camera_to_json
from mems6dof_ros.recording.poses import pose_topics
from mems6dof_ros.simulation.settings import SimulationSettings
from mems6dof_ros.sources.simulator import camera_noise
from mems6dof_ros.sources.source import kind_of

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

    ``parameters`` win over a parameter file, which wins over ``defaults``. ``ends_system``: when this process
    ends, the others have nothing left to do. ``respawn``: when it fails or is killed, it is started again.
    """

    executable: str
    parameters: Mapping[str, Any] = field(default_factory=dict)
    remappings: Mapping[str, str] = field(default_factory=dict)
    ends_system: bool = False
    respawn: bool = False
    defaults: Mapping[str, Any] = field(default_factory=dict)


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


def given(parameters: Mapping[str, Any]) -> dict[str, Any]:
    """Those that can be handed over: ROS 2 has no way to write an empty list or text."""
    return {name: value for name, value in parameters.items() if value not in ("", [], ())}


def arguments(parameters: Mapping[str, Any]) -> list[str]:
    """Parameters as ROS arguments; what comes later on a command line, files included, wins."""
    return [word for name, value in given(parameters).items() for word in ("-p", f"{name}:={to_yaml(value)}")]


def parameter_file(node: NodeSpec, config: str) -> Path:
    """The parameter file of a node in the directory ``config``."""
    return Path(config) / f"{node.executable}.yaml"


def expected(node: NodeSpec, name: str, config: str) -> Any:
    """The value that a parameter (without a dot in its name) will have, as far as the table and the parameter
    file tell; None: they do not."""
    if name in node.parameters:
        return node.parameters[name]
    value = None
    if config:
        # A file that cannot be read, or is none of parameters, is refused by the node.
        unusable = OSError, UnicodeDecodeError, yaml.YAMLError, AttributeError, KeyError, TypeError
        with contextlib.suppress(*unusable):
            document = yaml.safe_load(parameter_file(node, config).read_text(encoding="utf-8"))
            for of_node in document.values():
                value = of_node["ros__parameters"].get(name, value)
    return node.defaults.get(name) if value is None else value


def chain(
    source: NodeSpec | None,
    *,
    calibration: str,
    bodies: str = "",
    output: str = "",
    queue_policy: str = "",
    image_topic: str = topics.IMAGE,
    recorded: Sequence[str] = (),
    record_images: bool = False,
    recording: Mapping[str, Any] | None = None,
    controller: NodeSpec | None = None,
    watched: Mapping[str, str] | None = None,
    monitor: NodeSpec | None = None,
    arrangement: str = "processes",
    config: str = "",
) -> list[NodeSpec]:
    """frame_source, localizer, pose_estimator, ``controller`` if any, with an ``output`` recorder, and
    ``monitor`` if any. ``arrangement`` pipeline: the first three in one process.

    ``source`` None: a camera driver of somebody else publishes ``image_topic``. Each node waits for the
    subscribers that the table gives it, and for those in ``watched`` (topic to the name of a node that is
    not in the table), so that nothing is lost at the beginning. Nobody waits for a monitor. ``bodies``: file
    of several bodies in view, whose topics are recorded too. What is empty is left to the parameter files in
    ``config``, then to the nodes; ``record_images`` adds them to what is ``recorded``; ``recording``: further
    parameters of the recorder.
    """
    further = _topics_of_further(bodies)
    queue = {"queue_policy": queue_policy} if queue_policy else {}
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
        told = {
            "output": output,
            "attachments": [file for file in (calibration, bodies) if file],
            **(recording or {}),
        }
        if recorded:
            told["topics"] = [*recorded, *further]
        recorder = NodeSpec("recorder", told, remap, defaults={"topics": [*DEFAULT_TOPICS, *further]})
        if record_images:
            names = dict.fromkeys([*expected(recorder, "topics", config), topics.IMAGE])
            recorder = replace(recorder, parameters={**told, "topics": list(names)})
        nodes.append(recorder)
    if monitor:
        nodes.append(replace(monitor, remappings=remap))
    subscribed = [(topic, node.executable) for node in nodes for topic in _subscriptions(node, config)]
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


def replayed(recording: str, topic: str = "", **parameters: Any) -> NodeSpec:
    """A frame_source that replays a bag, TIFF stack, folder of images or video, and ends when all of it has
    become poses; further ``parameters``. Empty: a bag, which a parameter file names."""
    kind = kind_of(Path(recording)) if recording else "bag"
    if kind == "bag":
        parameters["bag.topic"] = topic
    elif topic:
        raise InputError("argument topic", f"'{topic}' of {recording}", "none, which only bags have")
    return _finite(kind, {f"{kind}.path": recording, **parameters})


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


def _subscriptions(node: NodeSpec, config: str) -> Sequence[str]:
    if node.executable == "recorder":
        return list(expected(node, "topics", config))
    if node.executable in ("frame_source", "pipeline"):
        paced = node.parameters.get("pacing") == "consumer"
        return [node.parameters["acknowledged_by"]] if paced else []
    return _SUBSCRIBED.get(node.executable, ())


def _live(values: Mapping[str, str]) -> list[NodeSpec]:
    source = None if values["source"] == "none" else _camera(values, rate=10.0)
    nodes = chain(source, image_topic=values["image_topic"], **_common(values))
    newest = {"queue_policy": "drop_oldest"}
    measuring = ("localizer", "pose_estimator")
    nodes = [_with(node, newest, by_default=True) if node.executable in measuring else node for node in nodes]
    return _respawning(_tracking(nodes, values), values)


def _camera(values: Mapping[str, str], rate: float) -> NodeSpec:
    """A frame_source at its own pace."""
    told: dict[str, Any] = {"pacing": "rate"}
    if values["source"]:
        told["source"] = values["source"]
    if values["rate"]:
        told["rate"] = _number(values, "rate")
    return NodeSpec("frame_source", told, defaults={"source": "simulator", "rate": rate})


def _replay(values: Mapping[str, str]) -> list[NodeSpec]:
    # What is not told is left to the parameter files.
    told = {name: kind(values, name) for name, kind in _REPLAYING.items() if values[name]}
    return chain(replayed(values["recording"], values["topic"], **told), **_common(values))


def _demo(values: Mapping[str, str]) -> list[NodeSpec]:
    return chain(simulated(_whole(values, "cycles"), **_simulation(values)), **_common(values))


def _closed_loop(values: Mapping[str, str]) -> list[NodeSpec]:
    source = commanded(**_simulation(values))
    controller = NodeSpec("controller", {"law": values["law"]})
    return _respawning(chain(source, controller=controller, **_common(values)), values)


def _simulation(values: Mapping[str, str]) -> dict[str, int]:
    """What is told of size and seeds."""
    fields = {"size": ("width_px", "height_px"), "seed": ("seed",), "optics_seed": ("optics_seed",)}
    return {
        name: _whole(values, argument)
        for argument, names in fields.items()
        for name in names
        if values[argument]
    }


def _calibrate(values: Mapping[str, str]) -> list[NodeSpec]:
    """A camera, the stage of it where it is simulated, and the calibrator; all else waits for a goal."""
    remap = {topics.IMAGE: values["image_topic"]} if values["image_topic"] != topics.IMAGE else {}
    calibrator = NodeSpec("calibrator", remappings=remap)
    if values["source"] == "none":
        return [calibrator]
    camera = _camera(values, rate=5.0)
    if expected(camera, "source", values["config"]) != "simulator":
        return [camera, calibrator]
    simulation = SimulationSettings()
    told = _simulation(values)
    size = told.get("width_px", simulation.width_px)
    substrate = {"substrate": True, "substrate_beads": max(200 * size**2 // 2048**2, 12), **told}
    parameters = {**camera.parameters, **{f"simulator.{name}": value for name, value in substrate.items()}}
    noise = json.loads(camera_to_json(camera_noise(simulation)))
    known = {f"camera.{name}": float(value) for name, value in noise.items()}
    known |= {"wavelength": simulation.wavelength, "bead_diameter": simulation.diameter}
    return [replace(camera, parameters=parameters), replace(calibrator, parameters=known)]


def _common(values: Mapping[str, str]) -> dict[str, Any]:
    """What ``chain`` is told by the arguments that every system has."""
    return {
        "calibration": values["calibration"],
        "bodies": values["bodies"],
        "output": values["output"],
        "record_images": _truth(values, "record_images"),
        "config": values["config"],
        "monitor": _monitor(values),
        "arrangement": values["arrangement"],
    }


def _monitor(values: Mapping[str, str]) -> NodeSpec | None:
    return NodeSpec("monitor") if _truth(values, "monitor") else None


def with_tracking(
    nodes: Sequence[NodeSpec], enabled: bool = True, *, by_default: bool = False
) -> list[NodeSpec]:
    """The ``nodes``, particles tracked and not searched in every frame, or, not ``enabled``, the reverse."""
    told = {"tracking.enabled": enabled}
    return [
        _with(node, told, by_default) if node.executable in ("localizer", "pipeline") else node
        for node in nodes
    ]


def _with(node: NodeSpec, parameters: Mapping[str, Any], by_default: bool) -> NodeSpec:
    if by_default:
        return replace(node, defaults={**node.defaults, **parameters})
    return replace(node, parameters={**node.parameters, **parameters})


def _tracking(nodes: list[NodeSpec], values: Mapping[str, str]) -> list[NodeSpec]:
    """With the tracking that is told, else by default, where there is but one body to follow."""
    if values["tracking"]:
        return with_tracking(nodes, _truth(values, "tracking") and not values["bodies"])
    return nodes if values["bodies"] else with_tracking(nodes, by_default=True)


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
_EMPTY = "empty: what the parameter file says, else"
_SOURCE = (
    "",
    f"Source of the frames; {_EMPTY} simulator; none: a camera driver publishes image_topic",
)
_RATE = "Frames per second, 0.0: as the source delivers them"
_CALIBRATION = {
    "calibration": ("", "Calibration file; empty: x and y only"),
    "bodies": ("", "File of several rigid bodies in view (docs/files.md); empty: one"),
}
_OUTPUT = {
    "output": ("", "Directory of the bag to record; empty: none"),
    "record_images": ("false", "true: record the images, too"),
}
_ARRANGEMENT = {
    "arrangement": (
        "processes",
        "processes: one for each node; pipeline: source, localizer and pose in one, for the lowest latency",
    )
}
_TRACKING = {
    "tracking": (
        "",
        "true: fit where the motion of the one body says that its particles will be, and search whole frames"
        f" now and then; false: search every frame; {_EMPTY} true. Of several bodies none is followed",
    )
}
_MONITOR = {"monitor": ("false", "true: show it live to browsers on this machine, see docs/monitor.md")}
_RESPAWN = {"respawn": ("false", "true: start a node again, after a second, that has failed or was killed")}
_CONFIG = {"config": ("", "Directory of parameter files, <node>.yaml each; empty: defaults")}
_NAMESPACE = {"namespace": ("", "Namespace of the nodes and their topics")}
_SIMULATION = {
    "size": ("", f"Width and height of the frames, px; {_EMPTY} 2048"),
    "seed": ("", f"Seed of particles, motion and noise; {_EMPTY} 1"),
    "optics_seed": ("", f"Seed of the optics, must be that of the calibration; {_EMPTY} 1"),
}

SYSTEMS = {
    "live": System(
        "A source at its own pace; what cannot be kept up with is dropped, oldest first, and counted.",
        {
            **_CALIBRATION,
            "source": _SOURCE,
            "rate": ("", f"{_RATE}; {_EMPTY} 10.0"),
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
        "A recording, nothing lost.",
        {
            "recording": ("", "rosbag2 bag, .mcap file, TIFF or OME-TIFF stack, folder of images, or video"),
            "topic": ("", "Topic of a bag's images; empty: the only one, or the only one named image_raw"),
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
            "source": _SOURCE,
            "rate": ("", f"{_RATE}; {_EMPTY} 5.0"),
            "image_topic": (topics.IMAGE, "Topic of the images"),
            **_SIMULATION,
            **_CONFIG,
            **_NAMESPACE,
        },
        _calibrate,
    ),
}
