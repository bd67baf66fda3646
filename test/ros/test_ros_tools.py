"""What the `ros2` commands find: by what they ask for, and by the commands themselves where there are any.

ros2cli, ros2bag and launch are in no package registry, so that the project's own tests cannot count on them.
"""

from __future__ import annotations

import importlib
import os
import shutil
import subprocess
import time
from collections.abc import Iterator
from typing import Any

import pytest
from lifecycle_msgs.msg import State
from lifecycle_msgs.srv import GetAvailableStates, GetAvailableTransitions, GetState
from peers import PATIENCE, SMALL_GEAR, Peer, own_domain
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import DescribeParameters, GetParameters, ListParameters, SetParameters
from rclpy.action import get_action_names_and_types, get_action_server_names_and_types_by_node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_srvs.srv import Trigger

from mems6dof_ros.nodes.recorder import DEFAULT_TOPICS, KNOWN_TYPES
from mems6dof_ros.nodes.runner import run_system
from mems6dof_ros.nodes.system import SYSTEMS, NodeSpec, chain

NODES = ("frame_source", "localizer", "pose_estimator", "recorder", "calibrator")
TOPICS = ("image_raw", "camera_info", "frame_info", "truth", "localizations", "pose_6dof", "pose")
TRIGGERS = {
    "frame_source": {"start", "stop", "step"},
    "localizer": set(),
    "pose_estimator": {"reset", "set_reference", "save_field_correction"},
    "recorder": {"start", "stop", "split"},
    "calibrator": set(),
}
#: No process that survives the command, and time to discover everybody.
ALONE = "--no-daemon --spin-time 8"


@pytest.fixture(scope="module")
def domain(tmp_path_factory: pytest.TempPathFactory, calibration: str) -> Iterator[int]:
    """Where every node is running, over and over through a few frames."""
    with pytest.MonkeyPatch.context() as patch, own_domain() as number:
        patch.setenv("ROS_DOMAIN_ID", str(number))
        patch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        settings = {f"simulator.{name}": value for name, value in SMALL_GEAR.items()}
        source = NodeSpec("frame_source", {"rate": 10.0, "simulator.loop": 4, **settings})
        bag = tmp_path_factory.mktemp("tools") / "bag"
        nodes = chain(
            source, calibration=calibration, output=str(bag), recorded=(*DEFAULT_TOPICS, "image_raw")
        )
        calibrator = SYSTEMS["calibrate"].table({})[-1]
        with run_system([*nodes, calibrator], on_line=lambda line: None):
            yield number
        if shutil.which("ros2"):  # some commands have no way but by their daemon
            subprocess.run(["ros2", "daemon", "stop"], capture_output=True, timeout=PATIENCE)


@pytest.fixture(scope="module")
def peer(domain: int) -> Iterator[Peer]:
    it = Peer(domain)
    yield it
    it.close()


def test_topic(peer: Peer) -> None:
    """`ros2 topic list`, `info`, `echo`, `hz`: all from the graph, with the quality that publishers offer."""
    types: dict[str, list[str]] = {}

    def published() -> bool:
        types.update(peer.node.get_topic_names_and_types())
        return all(peer.node.count_publishers(f"/{topic}") for topic in TOPICS)

    peer.wait(published)
    assert {topic: types[f"/{topic}"] for topic in TOPICS} == {
        topic: [KNOWN_TYPES[topic]] for topic in TOPICS
    }
    assert types["/diagnostics"] == ["diagnostic_msgs/msg/DiagnosticArray"]
    for topic in (*TOPICS, "diagnostics"):
        offered = [info.qos_profile for info in peer.node.get_publishers_info_by_topic(f"/{topic}")]
        assert {(q.reliability, q.durability) for q in offered} == {
            (ReliabilityPolicy.RELIABLE, DurabilityPolicy.VOLATILE)
        }
        package, _, name = types[f"/{topic}"][0].split("/")
        kind = getattr(importlib.import_module(f"{package}.msg"), name)
        heard = peer.received[topic]
        # Best effort, as `ros2 topic hz` and a reader of sensor data ask for.
        quality = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
        peer.node.create_subscription(kind, f"/{topic}", heard.append, quality)
    peer.wait(lambda: all(len(peer.received[topic]) > 2 for topic in (*TOPICS, "diagnostics")))
    counters = [message.frame_counter for message in peer.received["pose_6dof"]]
    assert counters == sorted(set(counters))


@pytest.mark.parametrize("node", NODES)
def test_param(peer: Peer, node: str) -> None:
    """`ros2 param list`, `describe`, `get` (and so `dump`): each is described, typed, and can be read."""
    names = peer.call(ListParameters, f"/{node}/list_parameters").result.names
    ours = [name for name in names if name != "use_sim_time" and not name.startswith("qos_overrides.")]
    assert "autostart" in ours
    request = DescribeParameters.Request(names=ours)
    described = peer.call(DescribeParameters, f"/{node}/describe_parameters", request).descriptors
    values = peer.call(GetParameters, f"/{node}/get_parameters", GetParameters.Request(names=ours)).values
    for descriptor, value in zip(described, values, strict=True):
        assert descriptor.description, descriptor.name
        assert value.type == descriptor.type != ParameterType.PARAMETER_NOT_SET, descriptor.name


def test_param_set(peer: Peer) -> None:
    """`ros2 param set`: takes effect, or is refused with its reason."""

    def set_rate(rate: float) -> tuple[bool, str]:
        value = ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=rate)
        request = SetParameters.Request(parameters=[Parameter(name="rate", value=value)])
        result = peer.call(SetParameters, "/frame_source/set_parameters", request).results[0]
        return bool(result.successful), str(result.reason)

    assert set_rate(12.0) == (True, "")
    successful, reason = set_rate(-1.0)
    assert not successful
    assert "rate" in reason
    found = peer.call(GetParameters, "/frame_source/get_parameters", GetParameters.Request(names=["rate"]))
    assert found.values[0].double_value == 12.0


@pytest.mark.parametrize("node", NODES)
def test_lifecycle_and_service(peer: Peer, node: str) -> None:
    """`ros2 lifecycle get`, `list`, `nodes`; `ros2 service list -t`, `ros2 node info`."""
    peer.wait(lambda: peer.call(GetState, f"/{node}/get_state").current_state.label == "active")
    states = peer.call(GetAvailableStates, f"/{node}/get_available_states").available_states
    assert State.PRIMARY_STATE_ACTIVE in {state.id for state in states}
    offered = peer.call(GetAvailableTransitions, f"/{node}/get_available_transitions").available_transitions
    assert {each.transition.label for each in offered} == {"deactivate", "shutdown"}
    graph = peer.call(GetAvailableTransitions, f"/{node}/get_transition_graph").available_transitions
    assert {"configure", "activate", "cleanup"} < {each.transition.label for each in graph}
    services = dict(peer.node.get_service_names_and_types_by_node(node, "/"))
    triggers = {name for name, types in services.items() if types == ["std_srvs/srv/Trigger"]}
    assert triggers == {f"/{node}/{name}" for name in TRIGGERS[node]}


def test_service_call(peer: Peer) -> None:
    assert peer.call(Trigger, "/frame_source/stop").success
    assert peer.call(Trigger, "/frame_source/step").success
    assert peer.call(Trigger, "/frame_source/start").success
    assert peer.call(Trigger, "/recorder/split").message.endswith("bag_0.mcap")


def test_action(peer: Peer) -> None:
    """`ros2 action list -t`, `info`."""
    wanted = ("/calibrate", ["mems6dof_msgs/action/Calibrate"])
    peer.wait(lambda: wanted in get_action_names_and_types(peer.node))
    assert get_action_server_names_and_types_by_node(peer.node, "calibrator", "/") == [wanted]


@pytest.mark.skipif(not shutil.which("ros2"), reason="ros2cli is not installed")
@pytest.mark.parametrize(
    ("command", "expected"),
    [
        (f"node list {ALONE}", [f"/{node}" for node in NODES]),
        (f"topic list -t {ALONE}", [f"/{name} [{KNOWN_TYPES[name]}]" for name in TOPICS]),
        (
            f"topic info -v /image_raw {ALONE}",
            ["Publisher count: 1", "RELIABLE", "VOLATILE"],
        ),
        (f"topic echo --once /pose_6dof {ALONE}", ["frame_counter:", "covariance:"]),
        (f"topic echo --once /diagnostics {ALONE}", ["lifecycle"]),
        ("topic hz /pose_6dof", ["average rate: "]),
        ("topic bw /image_raw", ["Message size mean: 0.52 MB"]),
        (f"param list /frame_source {ALONE}", ["simulator.particles", "genicam.exposure"]),
        (f"param get /localizer queue_policy {ALONE}", ["block"]),
        (f"param set /frame_source rate 11.0 {ALONE}", ["Set parameter successful"]),
        (f"param set /frame_source rate 1000000000.0 {ALONE}", ["failed", "rate"]),
        (
            f"param describe /frame_source rate {ALONE}",
            ["Type: double", "Max value: 10000.0"],
        ),
        (f"param dump /pose_estimator {ALONE}", ["ros__parameters:", "queue_size: 16"]),
        (f"lifecycle get /localizer {ALONE}", ["active [3]"]),
        (f"lifecycle set /recorder deactivate {ALONE}", ["Transitioning successful"]),
        (f"lifecycle set /recorder activate {ALONE}", ["Transitioning successful"]),
        (f"service list -t {ALONE}", ["/recorder/split [std_srvs/srv/Trigger]"]),
        ("service call /pose_estimator/reset std_srvs/srv/Trigger", ["success=True"]),
        ("action list -t", ["/calibrate [mems6dof_msgs/action/Calibrate]"]),
        ("action info /calibrate", ["Action servers: 1", "/calibrator"]),
    ],
)
def test_the_commands_themselves(domain: int, command: str, expected: list[str]) -> None:
    environment = {**os.environ, "ROS_DOMAIN_ID": str(domain), "PYTHONUNBUFFERED": "1"}
    arguments: list[Any] = ["timeout", "--signal=INT", "20", "ros2", *command.split()]
    said, deadline = "", time.monotonic() + PATIENCE
    while time.monotonic() < deadline:  # until the nodes are up, and discovered
        result = subprocess.run(arguments, env=environment, capture_output=True, text=True, timeout=PATIENCE)
        said = result.stdout + result.stderr
        if all(text in said for text in expected):
            return
    raise AssertionError(said)
