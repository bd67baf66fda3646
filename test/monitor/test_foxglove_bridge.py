"""The Foxglove bridge, seen by a client that shares no code with it: the protocol by hand, decoded by
mcap-ros2-support with the schemas that it is sent."""

from __future__ import annotations

import asyncio
import json
import re
from pathlib import Path

import numpy as np
import pytest
from monitor_helpers import Instrument

from mems6dof_ros.monitor.validation.foxglove import foxglove_messages
from mems6dof_ros.nodes.recorder import KNOWN_TYPES
from mems6dof_ros.recording.definitions import typestore

pytest.importorskip("foxglove", reason="the bridge is optional: foxglove-sdk is not installed")
LAYOUT = Path(__file__).parents[2] / "config" / "foxglove-layout.json"


@pytest.fixture
def bridge():
    running = Instrument(
        "-p",
        "port:=0",
        machine_args=("rate:=30.0", "size:=256", "image_every:=1"),
        module="mems6dof_ros.nodes.foxglove_bridge",
        says="Foxglove WebSocket: ",
    )
    yield running
    running.stop()


def test_an_independent_client_decodes_what_it_is_sent(bridge):
    wanted = {"/pose_6dof": 60, "/localizations": 20, "/frame_info": 20, "/image_raw": 2, "/diagnostics": 1}
    channels, decoded = asyncio.run(foxglove_messages(bridge.url, wanted))
    assert {topic.lstrip("/") for topic in KNOWN_TYPES} == {topic.lstrip("/") for topic in channels}
    poses = decoded["/pose_6dof"]
    steps = np.diff([pose.cycle for pose in poses])
    assert steps.min() >= 1
    assert steps.mean() < 1.2  # who looks on gives way where the host is overloaded
    assert {pose.body for pose in poses} == {"load_gear"}
    assert len(poses[0].displacement_covariance) == 36
    turned = np.diff([pose.psi for pose in poses if pose.status == 1])
    assert np.median(turned) == pytest.approx(np.deg2rad(4.5), rel=0.05)
    assert "# m, of the origin, along microscope x" in channels["/pose_6dof"]["schema"]
    for found in decoded["/localizations"]:
        assert len(found.x) == len(found.x_px) == len(found.flags) == len(found.covariance) / 9 > 20
    image = decoded["/image_raw"][0]
    assert (image.width, image.height, image.encoding, len(image.data)) == (256, 256, "mono16", 2 * 256**2)
    assert bridge.stop() == 0


def test_a_taken_port_is_one_line(bridge):
    port = bridge.url.rpartition(":")[2]
    second = Instrument(
        "-p",
        f"port:={port}",
        machine_args=None,
        module="mems6dof_ros.nodes.foxglove_bridge",
    )
    assert second.monitor.wait(60) == 1
    second.stop()
    assert len([line for line in second.lines if line.startswith("error: ") and port in line]) == 1


def test_every_path_of_the_layout_exists():
    layout = json.loads(LAYOUT.read_text())
    panels = layout["configById"]

    def leaves(node) -> list[str]:
        return [node] if isinstance(node, str) else leaves(node["first"]) + leaves(node["second"])

    assert sorted(leaves(layout["layout"])) == sorted(panels)
    paths = [path["value"] for panel in panels.values() for path in panel.get("paths", [])]
    paths += [panel["xAxisPath"]["value"] for panel in panels.values() if "xAxisPath" in panel]
    assert len(paths) > 10
    for path in paths:
        topic, field = re.fullmatch(r"/(\w+)\.(\w+)(?:\[\d+\])?", path).groups()
        assert field in typestore().types[KNOWN_TYPES[topic]].__dataclass_fields__
    topics = [panels["Image!micrograph"]["imageMode"]["imageTopic"]]
    topics.append(panels["DiagnosticSummary!health"]["topicToRender"])
    assert {topic.lstrip("/") for topic in topics} <= {topic.lstrip("/") for topic in KNOWN_TYPES}
