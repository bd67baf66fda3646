"""Managed nodes: what each state means, and what becomes of errors."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from pathlib import Path

import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from lifecycle_msgs.msg import State, Transition, TransitionEvent
from lifecycle_msgs.srv import ChangeState, GetAvailableTransitions, GetState
from peers import SMALL_GEAR, NodeProcess, Peer
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters
from sensor_msgs.msg import Image
from std_msgs.msg import String
from std_srvs.srv import Trigger

from mems6dof_msgs.msg import Localizations, Pose6DOF
from mems6dof_ros.nodes.runner import command
from mems6dof_ros.nodes.system import NodeSpec, simulated
from mems6dof_ros.recording.bag import BagReader

Start = Callable[..., NodeProcess]

CONFIGURE, ACTIVATE = Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_ACTIVATE
DEACTIVATE, CLEANUP = Transition.TRANSITION_DEACTIVATE, Transition.TRANSITION_CLEANUP


def start_node(start: Start, executable: str, **parameters: object) -> NodeProcess:
    arguments = command(NodeSpec(executable, parameters))
    return start(executable, *arguments[arguments.index("--ros-args") + 1 :])


def change(peer: Peer, node: str, transition: int) -> bool:
    request = ChangeState.Request(transition=Transition(id=transition))
    return bool(peer.call(ChangeState, f"{node}/change_state", request).success)


def state(peer: Peer, node: str) -> str:
    return str(peer.call(GetState, f"{node}/get_state").current_state.label)


@pytest.mark.parametrize(
    "executable",
    ["frame_source", "localizer", "pose_estimator", "pipeline", "recorder", "controller", "monitor"],
)
def test_every_node_goes_through_its_states(
    start: Start, peer: Peer, calibration: str, tmp_path: Path, executable: str
) -> None:
    """Twice around, by the services that ros2 lifecycle calls."""
    parameters: dict[str, object] = {"autostart": False}
    if executable in ("localizer", "pipeline"):
        parameters["calibration"] = calibration
    if executable in ("frame_source", "pipeline"):
        parameters |= simulated(0, **SMALL_GEAR).parameters
    if executable == "pipeline":
        parameters |= {"pacing": "rate"}
        del parameters["acknowledged_by"]
    if executable == "recorder":
        parameters["output"] = str(tmp_path / "bag")
    if executable == "monitor":
        parameters["port"] = 0
    node = start_node(start, executable, **parameters)
    peer.listen(TransitionEvent, f"{executable}/transition_event")
    node.wait_for_line("waiting for a lifecycle manager")
    offered = peer.call(GetAvailableTransitions, f"{executable}/get_available_transitions")
    assert {t.transition.label for t in offered.available_transitions} == {"configure", "shutdown"}
    assert not change(peer, executable, ACTIVATE)  # not from here; the node lives
    for _ in range(2):
        for transition, reached in (
            (CONFIGURE, "inactive"),
            (ACTIVATE, "active"),
            (DEACTIVATE, "inactive"),
            (ACTIVATE, "active"),
            (DEACTIVATE, "inactive"),
            (CLEANUP, "unconfigured"),
        ):
            assert change(peer, executable, transition), node.output
            assert state(peer, executable) == reached
    visited = [event.goal_state.label for event in peer.received[f"{executable}/transition_event"]]
    assert "errorprocessing" not in visited
    assert change(peer, executable, Transition.TRANSITION_UNCONFIGURED_SHUTDOWN)
    assert node.wait() == 0
    assert "Traceback" not in node.output


def test_an_error_is_one_line_and_the_node_can_be_tried_again(start: Start, peer: Peer) -> None:
    node = start_node(start, "localizer", autostart=False, calibration="absent.yaml")
    peer.listen(TransitionEvent, "localizer/transition_event")
    for _ in range(2):
        assert not change(peer, "localizer", CONFIGURE)
        assert state(peer, "localizer") == "unconfigured"
    peer.wait(
        lambda: (
            State.TRANSITION_STATE_ERRORPROCESSING
            in [event.goal_state.id for event in peer.received["localizer/transition_event"]]
        )
    )
    assert node.output.count("unconfigured: absent.yaml: found") == 2
    assert "Traceback" not in node.output
    assert node.stop() == 0


def test_parameters_take_effect_when_the_node_is_configured_anew(start: Start, peer: Peer) -> None:
    node = start_node(start, "pose_estimator")
    node.wait_for_line("ready")

    def set_body(name: str) -> tuple[bool, str]:
        value = ParameterValue(type=ParameterType.PARAMETER_STRING, string_value=name)
        request = SetParameters.Request(parameters=[Parameter(name="body", value=value)])
        result = peer.call(SetParameters, "pose_estimator/set_parameters", request).results[0]
        return result.successful, result.reason

    assert set_body("ring") == (
        False,
        "body: can be set only while the node is unconfigured, and it is active",
    )
    assert change(peer, "pose_estimator", DEACTIVATE)
    assert change(peer, "pose_estimator", CLEANUP)
    assert set_body("ring") == (True, "")
    assert change(peer, "pose_estimator", CONFIGURE)
    assert change(peer, "pose_estimator", ACTIVATE)
    peer.listen(Pose6DOF, "pose_6dof")
    peer.publisher(Localizations, "localizations").publish(Localizations(frame_counter=1, cycle=1))
    peer.wait(lambda: peer.received["pose_6dof"])
    assert peer.received["pose_6dof"][0].body == "ring"


def test_an_inactive_source_publishes_nothing_and_goes_on_where_it_was(start: Start, peer: Peer) -> None:
    peer.listen(Image, "image_raw")
    source = simulated(0, **SMALL_GEAR).parameters | {"pacing": "rate", "rate": 50.0}
    start_node(start, "frame_source", **source)
    stamps = peer.received["image_raw"]
    peer.wait(lambda: len(stamps) >= 5)
    assert change(peer, "frame_source", DEACTIVATE)
    answer = peer.call(Trigger, "frame_source/stop")
    assert (answer.success, answer.message) == (False, "inactive")
    before = len(stamps)
    assert not change(peer, "frame_source", DEACTIVATE)
    assert len(stamps) == before
    assert peer.call(Trigger, "frame_source/start").success  # brings it up
    assert state(peer, "frame_source") == "active"
    peer.wait(lambda: len(stamps) >= before + 5)
    ns = [image.header.stamp.sec * 10**9 + image.header.stamp.nanosec for image in stamps]
    periods = {round((b - a) / (1e9 / 90), 3) for a, b in itertools.pairwise(ns)}
    assert periods == {1.0}  # none lost, none twice


def test_the_estimator_remembers_while_inactive_and_forgets_when_cleaned_up(start: Start, peer: Peer) -> None:
    peer.listen(Pose6DOF, "pose_6dof")
    start_node(start, "pose_estimator")
    poses, sender = peer.received["pose_6dof"], peer.publisher(Localizations, "localizations")

    def send(counter: int) -> None:
        sender.publish(Localizations(frame_counter=counter, cycle=counter))

    send(1)
    peer.wait(lambda: len(poses) == 1)
    assert change(peer, "pose_estimator", DEACTIVATE)
    peer.wait(lambda: sender.get_subscription_count() == 0)
    send(2)
    assert change(peer, "pose_estimator", ACTIVATE)
    peer.wait(lambda: sender.get_subscription_count() == 1)
    send(3)
    peer.wait(lambda: len(poses) == 2)
    assert [pose.cycle for pose in poses] == [1, 3]


def test_the_recorder_completes_its_bag_when_deactivated(start: Start, peer: Peer, tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    node = start_node(start, "recorder", output=str(bag), topics=["notes"])
    node.wait_for_line("recording")
    notes = peer.publisher(String, "notes")
    for k in range(3):
        notes.publish(String(data=str(k)))
    peer.wait(lambda: notes.wait_for_all_acked())
    assert change(peer, "recorder", DEACTIVATE)
    with BagReader(bag) as reader:
        assert reader.counts["/notes"] <= 3
        assert (bag / "metadata.yaml").is_file()
    assert change(peer, "recorder", ACTIVATE)
    peer.wait(lambda: notes.get_subscription_count() == 1)
    assert node.stop() == 0
    assert (tmp_path / "bag_1" / "metadata.yaml").is_file()


def test_diagnostics_worry_about_nodes_that_wait_and_streams_that_stop(start: Start, peer: Peer) -> None:
    peer.listen(DiagnosticArray, "/diagnostics")
    start_node(start, "pose_estimator")
    start_node(start, "controller")  # waits for a drive that does not come

    def told(node: str, level: bytes, text: str) -> bool:
        statuses = [s for message in peer.received["/diagnostics"] for s in message.status]
        return any(s.name == node and s.level == level and text in s.message for s in statuses)

    peer.publisher(Localizations, "localizations").publish(Localizations(frame_counter=1, cycle=1))
    peer.wait(lambda: told("pose_estimator", DiagnosticStatus.OK, "active: initializing"))
    peer.wait(lambda: told("pose_estimator", DiagnosticStatus.STALE, "nothing to do for"))
    assert told("controller", DiagnosticStatus.OK, "active: waiting for a drive")
    peer.wait(lambda: told("controller", DiagnosticStatus.WARN, "active: waiting for a drive"))
