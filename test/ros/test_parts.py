"""The parts that nodes are made of, without any ROS traffic."""

from __future__ import annotations

import importlib
import math
import shutil
import sys
import threading
import types
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import yaml

from mems6dof_ros.errors import Mems6dofError
from mems6dof_ros.nodes import transport
from mems6dof_ros.nodes.frame_matcher import FrameMatcher
from mems6dof_ros.nodes.parameters import AUTOSTART, NODES, Parameter, as_yaml, config_text
from mems6dof_ros.nodes.system import SYSTEMS
from mems6dof_ros.nodes.worker import Worker
from mems6dof_ros.recording import messages

ROOT = Path(__file__).resolve().parents[2]

# Parameters -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", NODES)
def test_parameter_files_are_up_to_date(name: str) -> None:
    """``make config`` writes them; every declared parameter appears, with its default, and no other."""
    text = (ROOT / "config" / f"{name}.yaml").read_text()
    assert text == config_text(name)
    declared = (AUTOSTART, *importlib.import_module(f"mems6dof_ros.nodes.{name}").PARAMETERS)
    assert all(parameter.doc for parameter in declared)
    written = _flat(yaml.safe_load(text)["/**"]["ros__parameters"])
    assert set(written) == {parameter.name for parameter in declared}
    for parameter in declared:
        value, default = written[parameter.name], parameter.default
        if isinstance(default, tuple):
            assert value == list(default)
        else:
            assert type(value) is type(default)
            assert value == default or math.isnan(value) == math.isnan(default)


def _flat(tree: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    flat = {}
    for name, value in tree.items():
        if isinstance(value, dict):
            flat |= _flat(value, f"{prefix}{name}.")
        else:
            flat[prefix + name] = value
    return flat


@pytest.mark.parametrize(
    ("parameter", "value", "reason"),
    [
        (Parameter("a", 1.0, "", span=(0.0, 2.0)), 1.5, ""),
        (Parameter("a", 1.0, "", "m", span=(0.0, 2.0)), 3.0, "found 3.0; expected 0 to 2 m"),
        (Parameter("a", 1.0, ""), math.nan, "found nan; expected finite numbers"),
        (Parameter("a", 1.0, ""), math.inf, "found inf; expected finite numbers"),
        (Parameter("a", math.nan, "", optional=True), math.nan, ""),
        (Parameter("a", math.nan, "", optional=True), math.inf, "found inf; expected .nan: not set"),
        (
            Parameter("a", (1.0,), "", element=float),
            [1.0, math.nan],
            "found [1.0, nan]; expected finite numbers",
        ),
        (Parameter("a", "x", "", choices=("x", "y")), "z", "found 'z'; expected one of x, y"),
    ],
)
def test_values_are_checked_with_a_reason(parameter: Parameter, value: Any, reason: str) -> None:
    assert parameter.check(value) == reason


def test_numbers_keep_their_type_in_yaml() -> None:
    table = [
        Parameter("small", 1e-9, ""),
        Parameter("whole", 3, ""),
        Parameter("list", (2e-6,), "", element=float),
    ]
    values = yaml.safe_load(as_yaml("test", table))["/**"]["ros__parameters"]
    assert values == {"small": 1e-9, "whole": 3, "list": [2e-6]}
    assert isinstance(values["small"], float)


# Worker --------------------------------------------------------------------------------------------


def test_worker_drops_the_oldest_and_counts() -> None:
    gate, done = threading.Event(), []

    def work(item: int) -> None:
        gate.wait()
        done.append(item)

    worker = Worker(work, capacity=2, policy="drop_oldest")
    worker.put(0)
    while len(worker):  # until the worker holds the first one
        pass
    for item in range(1, 6):
        worker.put(item)
    assert (len(worker), worker.dropped) == (2, 3)
    gate.set()
    assert worker.end() == 0
    assert done == [0, 4, 5]


def test_worker_lets_bulky_items_push_nothing_out() -> None:
    gate, done = threading.Event(), []

    def work(item: str) -> None:
        gate.wait()
        done.append(item)

    worker = Worker(work, capacity=100, policy="drop_oldest")
    worker.put("first")
    while len(worker):
        pass
    for number in range(5):
        worker.put(f"image {number}", 40, share=0.9)
        worker.put(f"pose {number}", 2)
    assert worker.dropped == 3
    gate.set()
    assert worker.end() == 0
    assert done == ["first", "image 0", "pose 0", "image 1", *(f"pose {number}" for number in range(1, 5))]


def test_worker_blocks_instead_of_losing() -> None:
    done: list[int] = []
    worker = Worker(done.append, capacity=1)
    for item in range(200):
        worker.put(item)
    assert worker.end() == 0
    assert (done, worker.dropped) == (list(range(200)), 0)


def test_worker_that_fails_blocks_nobody() -> None:
    def work(item: int) -> None:
        raise ZeroDivisionError

    worker = Worker(work, capacity=1)
    for item in range(5):
        worker.put(item)
    worker.end()
    assert isinstance(worker.failure, ZeroDivisionError)


def test_worker_says_what_it_left() -> None:
    gate = threading.Event()
    worker = Worker(lambda _: gate.wait(), capacity=5)
    for item in range(4):
        worker.put(item)
    assert worker.end(timeout=0.05) == 4
    gate.set()


# Frame matcher ---------------------------------------------------------------------------------------


def test_images_wait_for_their_info_in_order() -> None:
    matcher = FrameMatcher()
    matcher.add_image(1, "image 1", 10)
    assert matcher.take(infos_expected=True) == []
    matcher.add_info(1, "info 1")
    assert matcher.take(True) == [("image 1", "info 1", 10)]
    matcher.add_info(2, "info 2")
    matcher.add_info(3, "info 3")
    matcher.add_image(2, "image 2", 20)
    matcher.add_image(3, "image 3", 30)
    assert matcher.take(True) == [("image 2", "info 2", 20), ("image 3", "info 3", 30)]


def test_a_lost_info_holds_up_nobody() -> None:
    matcher = FrameMatcher(patience=2)
    matcher.add_image(1, "image 1", 10)
    matcher.add_image(2, "image 2", 20)
    matcher.add_info(2, "info 2")
    assert matcher.take(True) == [("image 1", None, 10), ("image 2", "info 2", 20)]
    matcher.tick()
    matcher.add_image(3, "image 3", 30)
    matcher.tick()
    assert matcher.take(True) == []
    matcher.tick()
    assert matcher.take(True) == [("image 3", None, 30)]


def test_infos_behind_their_images_are_waited_for() -> None:
    """A backlog of infos, and images of which the older have been overwritten."""
    matcher = FrameMatcher(patience=2)
    matcher.add_image(9, "image 9", 0)
    for stamp in range(1, 9):
        matcher.add_info(stamp, f"info {stamp}")
        matcher.tick()
        assert matcher.take(True) == []
    matcher.add_info(9, "info 9")
    assert matcher.take(True) == [("image 9", "info 9", 0)]


def test_images_from_memory_and_by_the_topic_keep_the_order_of_the_infos() -> None:
    """The first frame came from memory; then the topic kept but ten images while nobody took them."""
    matcher = FrameMatcher()
    matcher.add_info(0, 0, "memory", 0)
    taken = matcher.take(True)
    for stamp in range(5, 15):
        assert not matcher.passes_by(stamp)
        matcher.add_image(stamp, "topic", 0)
    for stamp in range(1, 15):
        matcher.add_info(stamp, stamp, "memory" if stamp < 8 else None, 0)
        taken += matcher.take(True)
    assert [(frame.info, frame.image) for frame in taken] == [
        (stamp, "memory" if stamp < 8 else "topic") for stamp in range(15)
    ]
    assert matcher.take(False) == []


def test_what_is_lost_on_the_topic_holds_up_nobody() -> None:
    matcher = FrameMatcher(patience=2)
    for stamp in range(1, 5):
        matcher.add_info(stamp, stamp, "memory" if stamp in (2, 3) else None, 0)
    assert matcher.take(True) == []
    assert matcher.lacks_image
    assert matcher.passes_by(2)  # which 1 would have come before
    assert [frame.info for frame in matcher.take(True)] == [2, 3]
    matcher.tick()
    matcher.tick()
    assert matcher.take(True) == []
    assert not matcher.lacks_image
    matcher.add_info(5, 5, "memory", 0)
    assert [frame.info for frame in matcher.take(True)] == [5]


def test_stamps_may_begin_again() -> None:
    matcher = FrameMatcher()
    matcher.add_info(100, "info 100")
    matcher.add_image(100, "image 100", 0)
    matcher.take(True)
    matcher.add_info(1, "info 1")
    matcher.add_image(1, "image 1", 0)
    assert matcher.take(True) == [("image 1", "info 1", 0)]


def test_without_infos_images_pass_at_once() -> None:
    matcher = FrameMatcher()
    matcher.add_image(1, "image 1", 0)
    assert matcher.take(infos_expected=False) == [("image 1", None, 0)]


# Transport -------------------------------------------------------------------------------------------


@pytest.fixture
def no_profile(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE"):
        monkeypatch.setenv(name, "")  # so that the test's own setting is undone
        monkeypatch.delenv(name)


def _profile() -> str:
    import os

    assert os.environ["FASTRTPS_DEFAULT_PROFILES_FILE"] == os.environ["FASTDDS_DEFAULT_PROFILES_FILE"]
    return Path(os.environ["FASTRTPS_DEFAULT_PROFILES_FILE"]).name


def _free(monkeypatch: pytest.MonkeyPatch, mebibytes: int) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=mebibytes * 2**20))


@pytest.mark.usefixtures("no_profile")
def test_profile_suits_the_process(monkeypatch: pytest.MonkeyPatch) -> None:
    _free(monkeypatch, 1000)
    assert transport.use_profile(frames=True) == ""
    assert _profile() == "fastdds_frames.xml"
    assert transport.use_profile(frames=False) == ""  # ours in the environment is no wish of the user's
    assert _profile() == "fastdds.xml"


@pytest.mark.usefixtures("no_profile")
def test_full_shared_memory_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    _free(monkeypatch, 60)  # a container's default of 64 MiB
    assert "60 of 136 MiB free" in transport.use_profile(frames=True)
    assert _profile() == "fastdds.xml"
    _free(monkeypatch, 2)
    with pytest.raises(Mems6dofError, match="/dev/shm: found 2 MiB free"):
        transport.use_profile(frames=False)


@pytest.mark.usefixtures("no_profile")
def test_the_users_own_profile_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FASTDDS_DEFAULT_PROFILES_FILE", "/etc/mine.xml")
    transport.use_profile(frames=True)
    import os

    assert "FASTRTPS_DEFAULT_PROFILES_FILE" not in os.environ


def test_stamps_are_read_from_serialized_messages() -> None:
    frame = SimpleNamespace(stamp_ns=1_767_225_600_123_456_789, frame_id="microscope")
    message = messages.Message(
        "geometry_msgs/msg/PoseStamped",
        {
            "header": messages.header(frame.stamp_ns, frame.frame_id),
            "pose": messages.pose(*_identity()),
        },
    )
    assert transport.stamp_of(bytes(messages.serialize(message))) == frame.stamp_ns


def _identity() -> tuple[Any, Any]:
    import numpy as np

    return np.eye(3), np.zeros(3)


# Launch files ----------------------------------------------------------------------------------------


@pytest.fixture
def recorded_launch(monkeypatch: pytest.MonkeyPatch) -> None:
    """`launch` and `launch_ros`, reduced to remembering what they are given."""

    class Remembered:
        def __init__(self, *arguments: Any, **options: Any) -> None:
            self.arguments, self.options = arguments, options

    for module, names in {
        "launch": ["LaunchDescription"],
        "launch.actions": ["DeclareLaunchArgument", "OpaqueFunction", "Shutdown"],
        "launch_ros": [],
        "launch_ros.actions": ["Node"],
    }.items():
        stand_in = types.ModuleType(module)
        for name in names:
            setattr(stand_in, name, type(name, (Remembered,), {}))
        monkeypatch.setitem(sys.modules, module, stand_in)


@pytest.mark.usefixtures("recorded_launch")
@pytest.mark.parametrize("name", SYSTEMS)
def test_launch_files_start_the_same_table(name: str) -> None:
    path = ROOT / "launch_scripts" / f"{name}.launch.py"
    specification = importlib.util.spec_from_file_location("launch_file", path)
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    *arguments, function = module.generate_launch_description().arguments[0]
    system = SYSTEMS[name]
    assert [argument.arguments[0] for argument in arguments] == list(system.arguments)
    values = {argument.arguments[0]: argument.options["default_value"] for argument in arguments}
    given = {"output": "out", "namespace": "left", "config": "settings"}
    values |= {name: value for name, value in given.items() if name in system.arguments}
    nodes = function.options["function"](SimpleNamespace(launch_configurations=values))
    table = system.table(values)
    assert [node.options["executable"] for node in nodes] == [spec.executable for spec in table]
    for node, spec in zip(nodes, table, strict=True):
        assert node.options["namespace"] == "left"
        assert node.options["respawn"] is spec.respawn
        file, parameters = node.options["parameters"]
        assert file == f"settings/{spec.executable}.yaml"
        assert parameters.items() <= spec.parameters.items()
        assert len(node.options["ros_arguments"]) == 2 * len(spec.defaults)
        assert bool(node.options["on_exit"]) == any(spec.ends_system for spec in table)


def test_launch_files_load_where_launch_is_missing() -> None:
    for name in SYSTEMS:
        compile((ROOT / "launch_scripts" / f"{name}.launch.py").read_text(), name, "exec")
        assert "import launch" not in (ROOT / "launch_scripts" / f"{name}.launch.py").read_text()
