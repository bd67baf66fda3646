"""The monitor as a node: real messages over DDS in, a page out."""

from __future__ import annotations

import asyncio
import json
import struct
from urllib.parse import urlsplit

import aiohttp
import numpy as np
import pytest
from monitor_helpers import Instrument

from mems6dof_ros.monitor.history import COLUMNS

COLUMN = {name: index for index, name in enumerate(COLUMNS)}


class Page:
    """A page without a browser: collects what it is sent."""

    def __init__(self, socket: aiohttp.ClientWebSocketResponse) -> None:
        self.socket = socket
        self.rows = np.zeros((0, len(COLUMNS)))
        self.state: dict = {}
        self.pictures: list[tuple[dict, bytes]] = []
        self.results: list[dict] = []

    async def until(self, condition, timeout: float = 15.0) -> None:
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
                else:
                    told = json.loads(message.data)
                    if told["type"] == "state":
                        self.state = told
                    elif told["type"] == "result":
                        self.results.append(told)

        await asyncio.wait_for(take(), timeout)


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
        assert refused.monitor.wait(20) == 1
        refused.stop()
        errors = [line for line in refused.lines if line.startswith("error: ")]
        assert len(errors) == 1
        assert "Traceback" not in "\n".join(refused.lines)
