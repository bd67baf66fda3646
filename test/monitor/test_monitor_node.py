"""The monitor as a node: real messages over DDS in, a page out."""

from __future__ import annotations

import asyncio
import json
import struct
from dataclasses import replace
from urllib.parse import urlsplit

import aiohttp
import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped
from monitor_helpers import Instrument
from peers import Peer
from rcl_interfaces.msg import ParameterType, ParameterValue
from rcl_interfaces.srv import GetParameters
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Float64
from std_srvs.srv import Trigger

from mems6dof_msgs.msg import ControllerState, Pose6DOF
from mems6dof_ros.monitor.history import COLUMNS
from mems6dof_ros.monitor.synthetic import Machine
from mems6dof_ros.nodes.actuation import ANSWERS
from mems6dof_ros.nodes.localizer import point_cloud
from mems6dof_ros.recording import messages

COLUMN = {name: index for index, name in enumerate(COLUMNS)}


class Page:
    """A page without a browser: collects what it is sent."""

    def __init__(self, socket: aiohttp.ClientWebSocketResponse) -> None:
        self.socket = socket
        self.rows = np.zeros((0, len(COLUMNS)))
        self.state: dict = {}
        self.pictures: list[tuple[dict, bytes]] = []
        self.results: list[dict] = []

    async def until(self, condition, timeout: float = 60.0) -> None:
        """Take in messages until ``condition()``."""

        async def take() -> None:
            while not condition():
                message = await self.socket.receive()
                if message.type is aiohttp.WSMsgType.BINARY:
                    kind, a, b, c = struct.unpack_from("<4I", message.data)
                    if kind == 1:
                        new = np.frombuffer(message.data, "<f8", offset=16).reshape(b, c)
                        self.rows = np.vstack([self.rows, new])
                    else:
                        body = message.data[16:]
                        self.pictures.append((json.loads(body[:a]), body[a:]))
                        await self.socket.send_json({"type": "seen"})
                else:
                    told = json.loads(message.data)
                    if told["type"] == "state":
                        self.state = told
                    elif told["type"] == "result":
                        self.results.append(told)

        await asyncio.wait_for(take(), timeout)


@pytest.fixture
def start():
    """Starts monitors without anything to watch, with their arguments."""
    running: list[Instrument] = []

    def start_one(*arguments: str) -> Instrument:
        running.append(Instrument(*arguments, machine_args=None))
        return running[-1]

    yield start_one
    for watched in running:
        watched.stop()


def with_page(instrument: Instrument, act) -> None:
    async def main() -> None:
        url = instrument.url
        origin = f"http://{urlsplit(url).netloc}"
        async with (
            aiohttp.ClientSession() as session,
            session.ws_connect(url + "live", headers={"Origin": origin}, max_msg_size=0) as socket,
        ):
            await act(Page(socket))

    asyncio.run(main())


def test_every_cycle_arrives_with_truth_beside_it(instrument):
    async def act(page: Page) -> None:
        true = COLUMN["true_dx"]
        await page.until(lambda: np.isfinite(page.rows[:, true]).sum() > 150)
        cycles = page.rows[:, COLUMN["cycle"]]
        assert np.all(np.diff(cycles) == 1)
        tracking = page.rows[page.rows[:, COLUMN["status"]] == 1]
        tracking = tracking[np.argmax(np.isfinite(tracking[:, true])) :]  # since truth is aligned
        # The synthetic noise, and a little of those cycles to which truth is aligned.
        for name, sd in {"dx": 0.25e-9, "dz": 7e-9, "tilt_x": 95e-6, "psi": 2.5e-6}.items():
            error = tracking[:, COLUMN[name]] - tracking[:, COLUMN[f"true_{name}"]]
            assert np.isfinite(error).mean() > 0.9
            assert 0.7 * sd < np.nanstd(error) < 1.5 * sd
        await page.until(lambda: page.state.get("rates", {}).get("pose_6dof", 0) > 10)
        assert page.state["frames_missing"] == 0
        assert page.state["diagnostics"]

    with_page(instrument, act)


def test_pictures_come_only_when_asked_for_and_match_their_particles(instrument):
    async def act(page: Page) -> None:
        await page.until(lambda: len(page.rows) > 60)
        assert page.pictures == []
        await page.socket.send_json({"type": "pictures", "on": True})
        await page.until(lambda: len(page.pictures) >= 3)
        for overlay, jpeg in page.pictures:
            assert jpeg[:2] == b"\xff\xd8"
            assert overlay["cycle"] % 6 == 0  # the only cycles with an image
            assert len(overlay["bodies"][0]["particle_id"]) == len(overlay["x_px"]) > 20

    with_page(instrument, act)


def test_services_are_called(instrument):
    async def act(page: Page) -> None:
        await page.until(lambda: page.state.get("services", {}).get("frame_source/stop"))
        assert page.state["services"]["recorder/stop"] is False  # the synthetic gear has none
        for number, service in enumerate(["frame_source/stop", "frame_source/start", "recorder/stop"]):
            await page.socket.send_json({"type": "call", "id": number, "service": service})
            await page.until(lambda number=number: len(page.results) > number)
            if service == "frame_source/stop":
                count = len(page.rows)
                with pytest.raises(asyncio.TimeoutError):
                    await page.until(lambda count=count: len(page.rows) > count + 20, timeout=1.5)
        assert [result["success"] for result in page.results] == [True, True, False]
        assert "nobody" in page.results[2]["message"]
        count = len(page.rows)
        await page.until(lambda: len(page.rows) > count + 20)

    with_page(instrument, act)


def test_a_controller_is_shown_and_steered(start):
    watched = start("-p", "port:=0")
    peer = Peer(watched.domain)
    limits = {
        "max_play": 3e-6,
        "max_tilt": 5e-3,
        "max_sd_psi": 5e-4,
        "max_pose_age": 1.0,
        "move_timeout": 60.0,
    }

    def tell(request, response):
        for name in request.names:
            response.values.append(
                ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=limits[name])
                if name in limits
                else ParameterValue(type=ParameterType.PARAMETER_STRING, string_value="load_gear")
            )
        return response

    def stop(_, response):
        response.success, response.message = True, "stopped"
        return response

    async def act(page: Page) -> None:
        await page.until(lambda: "services" in page.state)
        assert "controller" not in page.state
        stopping = peer.node.create_service(Trigger, "controller/stop", stop)
        peer.node.create_service(GetParameters, "controller/get_parameters", tell)
        peer.listen(Float64, "psi_target")
        states = peer.node.create_publisher(ControllerState, "controller_state", ANSWERS)
        await page.until(lambda: page.state.get("controller", {}).get("limits"))
        assert page.state["controller"]["limits"] == limits
        assert page.state["controller"]["body"] == "load_gear"
        assert page.state["services"]["controller/go"] is True
        for number, (service, value) in enumerate(
            (("go", 0.25), ("stop", None), ("go", None), ("stop", 1.0))
        ):
            with_value = {} if value is None else {"value": value}
            request = {"type": "call", "id": number, "service": f"controller/{service}", **with_value}
            await page.socket.send_json(request)
            await page.until(lambda number=number: len(page.results) > number)
        assert [result["success"] for result in page.results] == [True, True, False, False]
        peer.wait(lambda: peer.received["psi_target"])
        assert [message.data for message in peer.received["psi_target"]] == [0.25]
        states.publish(
            ControllerState(state=3, reason="pose lost", target=0.25, error=float("nan"), cycles=7)
        )
        await page.until(lambda: page.state["controller"]["state"] == "stopped")
        shown = page.state["controller"]
        assert (shown["reason"], shown["target"], shown["error"], shown["cycles"]) == (
            "pose lost",
            0.25,
            None,
            7,
        )
        peer.node.destroy_service(stopping)
        await page.until(lambda: page.state["services"]["controller/go"] is False)

    try:
        with_page(watched, act)
    finally:
        peer.close()


def test_further_bodies_are_shown_and_other_instruments_are_not(start):
    watched = start("-p", "port:=0")
    peer = Peer(watched.domain)
    pose = Machine(seed=2).cycle(0, image=False)[2]
    said = {"pose_6dof": "load_gear", "idler/pose_6dof": "idler", "left/pose_6dof": "load_gear"}

    async def act(page: Page) -> None:
        await page.until(lambda: "services" in page.state)
        publishers = {topic: peer.node.create_publisher(Pose6DOF, topic, 10) for topic in said}
        for topic, body in said.items():
            peer.wait(lambda topic=topic: publishers[topic].get_subscription_count())
            publishers[topic].publish(messages.to_rclpy(messages.pose6dof(replace(pose, body=body))))
        await page.until(lambda: len(page.rows) >= 2)
        peer.wait(lambda: not publishers["left/pose_6dof"].get_subscription_count())
        await page.until(lambda: len(page.state["bodies"]) == 2)
        assert {body["name"] for body in page.state["bodies"]} == {"load_gear", "idler"}
        assert sorted(page.rows[:, COLUMN["body"]]) == [0, 1]

    try:
        with_page(watched, act)
    finally:
        peer.close()


def test_enlarged_copies_are_published_where_asked_for_and_only_there(start):
    plain, enlarging = start("-p", "port:=0"), start("-p", "port:=0", "-p", "viz_scale:=1000.0")
    assert plain.url
    assert enlarging.url
    peers = Peer(plain.domain), Peer(enlarging.domain)
    try:
        found = Machine(seed=2, size=256).cycle(0, image=False)[1]
        cloud, pose = point_cloud(found), PoseStamped()
        pose.header.frame_id = "microscope"
        pose.pose.position.x, pose.pose.orientation.w = 2e-6, 1.0
        peer = peers[1]
        peer.listen(PoseStamped, "viz/pose")
        peer.listen(PointCloud2, "viz/points")
        poses, clouds = (
            peer.publisher(PoseStamped, "pose"),
            peer.publisher(PointCloud2, "localizations/points"),
        )
        poses.publish(pose)
        clouds.publish(cloud)
        peer.wait(lambda: peer.received["viz/pose"] and peer.received["viz/points"])
        enlarged, points = peer.received["viz/pose"][0], peer.received["viz/points"][0]
        assert enlarged.header.frame_id == points.header.frame_id == "microscope_enlarged"
        assert enlarged.pose.position.x == pytest.approx(2e-3)
        assert enlarged.pose.orientation.w == 1.0
        kinds = [("xyz", "<f4", 3), ("flux", "<f4"), ("flags", "<u4")]
        before, after = (np.frombuffer(c.data, dtype=kinds) for c in (cloud, points))
        np.testing.assert_allclose(after["xyz"], 1000 * found.position, rtol=1e-6)
        np.testing.assert_array_equal(after["flux"], before["flux"])
        np.testing.assert_array_equal(after["flags"], before["flags"])
        names = {topic for topic, _ in peers[0].node.get_topic_names_and_types()}
        assert not {topic for topic in names if "viz" in topic}
    finally:
        for peer in peers:
            peer.close()


def test_the_token_is_told_to_nobody_but_the_terminal(monkeypatch):
    monkeypatch.setenv("MEMS6DOF_MONITOR_TOKEN", "a token that stays here")
    watched = Instrument("-p", "port:=0", machine_args=None)
    try:
        assert watched.url.endswith("/?token=a%20token%20that%20stays%20here")
        tellers = [line for line in watched.lines if "token" in line]
        assert len(tellers) == 1
        assert tellers[0].startswith("live page: ")  # printed; a line of the log begins with its level
    finally:
        watched.stop()


def test_the_node_ends_in_good_order_and_refuses_bad_parameters(instrument):
    assert instrument.url  # the other tests are done: the module's instrument may go
    assert instrument.stop() == 0
    assert not any("Traceback" in line for line in instrument.lines)
    for parameter in ("port:=70000", "history:=5", "colour:=red"):
        refused = Instrument("-p", parameter, machine_args=None)
        assert refused.monitor.wait(60) == 1
        refused.stop()
        errors = [line for line in refused.lines if line.startswith("error: ")]
        assert len(errors) == 1
        assert "Traceback" not in "\n".join(refused.lines)
