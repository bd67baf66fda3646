"""The server of the live page: what it serves, and what it refuses without being disturbed."""

from __future__ import annotations

import asyncio
import http.client
import json
import shutil
import socket
import ssl
import struct
import subprocess
import threading
import time
import tracemalloc
from dataclasses import replace
from urllib.parse import urlsplit

import aiohttp
import numpy as np
import pytest

from mems6dof_ros.errors import InputError
from mems6dof_ros.monitor import access, door, server
from mems6dof_ros.monitor.attacks import ATTACKS
from mems6dof_ros.monitor.history import COLUMNS
from mems6dof_ros.monitor.picture import make_picture
from mems6dof_ros.monitor.server import MAX_MESSAGE, MAX_MESSAGES_PER_SECOND, MAX_PAGES
from mems6dof_ros.monitor.validation.attacked import attacked
from mems6dof_ros.pose.cycle_pose import CyclePose

CYCLE = list(COLUMNS).index("cycle")
TOKEN = "correct horse battery staple"


def get(served, path: str, headers: dict[str, str] | None = None, method: str = "GET", body: bytes = b""):
    where = urlsplit(served.url)
    connection = http.client.HTTPConnection("127.0.0.1", where.port, timeout=5)
    connection.putrequest(method, path, skip_host="Host" in (headers or {}))
    for name, value in (headers or {}).items():
        connection.putheader(name, value)
    connection.endheaders(body or None)
    response = connection.getresponse()
    return response, response.read()


def raw(served, data: bytes) -> bytes:
    where = urlsplit(served.url)
    with socket.create_connection(("127.0.0.1", where.port), timeout=5) as connection:
        connection.settimeout(2)
        answer = b""
        try:
            connection.sendall(data)
            while chunk := connection.recv(65536):
                answer += chunk
                if len(answer) > 200000:
                    break
        except (TimeoutError, ConnectionError):
            pass
        return answer


def wait_for(condition, timeout: float = 5.0) -> None:
    """The server finishes with a connection after its client has."""
    deadline = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def origin(served) -> str:
    return f"http://{urlsplit(served.url).netloc}"


def open_page(session: aiohttp.ClientSession, served, **headers: str):
    return session.ws_connect(
        origin(served) + "/live", headers={"Origin": origin(served), **headers}, max_msg_size=0
    )


def upgrade(served) -> bytes:
    """The opening handshake of a page, as bytes."""
    lines = ("GET /live HTTP/1.1", f"Host: {urlsplit(served.url).netloc}", f"Origin: {origin(served)}",
             "Upgrade: websocket", "Connection: Upgrade", "Sec-WebSocket-Version: 13",
             "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==", "", "")  # fmt: skip
    return "\r\n".join(lines).encode()


def text_frame(text: str) -> bytes:
    """A short WebSocket frame of a client, masked by zero."""
    return bytes([0x81, 0x80 | len(text), 0, 0, 0, 0]) + text.encode()


def poses(machine, count: int) -> list[CyclePose]:
    return [machine.cycle(number, image=False)[2] for number in range(count)]


def rows_of(message: bytes) -> np.ndarray:
    kind, _, rows, columns = struct.unpack_from("<4I", message)
    assert kind == 1
    return np.frombuffer(message, "<f8", offset=16).reshape(rows, columns)


# What is served ----------------------------------------------------------------------------------


def test_page_and_its_files_are_served_with_security_headers(serve):
    served = serve()
    for path, kind in {
        "/": "text/html",
        "/main.js": "text/javascript",
        "/style.css": "text/css",
        "/vendor/uPlot.esm.js": "text/javascript",
        "/vendor/uPlot.LICENSE": "text/plain",
    }.items():
        response, body = get(served, path)
        assert response.status == 200
        assert response.headers["Content-Type"].startswith(kind)
        assert body
        for name, value in access.SECURITY_HEADERS.items():
            assert response.headers[name] == value


def test_page_needs_nothing_from_elsewhere(serve):
    served = serve()
    _, page = get(served, "/")
    for path in ("/", "/main.js", "/style.css", "/charts.js", "/micrograph.js"):
        _, body = get(served, path)
        assert b"https://" not in body
        assert b"http://" not in body.replace(b"http://www.w3.org/2000/svg", b"")
    assert b"style=" not in page  # the policy forbids inline styles and scripts
    assert b"onclick" not in page


def test_a_page_gets_every_row_state_events_and_pictures_it_asked_for(serve, machine):
    served = serve()
    made = poses(machine, 300)

    async def watch():
        async with aiohttp.ClientSession() as session, open_page(session, served) as page:
            hello = json.loads((await page.receive(5)).data)
            assert hello["type"] == "hello"
            assert list(hello["columns"]) == list(COLUMNS)
            for pose in made:
                served.feed.add_pose(pose)
            cycles, kinds = [], set()
            while len(cycles) < len(made) or not {"state", "events"} <= kinds:
                message = await page.receive(5)
                if message.type is aiohttp.WSMsgType.BINARY:
                    cycles += rows_of(message.data)[:, CYCLE].astype(int).tolist()
                else:
                    kinds.add(json.loads(message.data)["type"])
            assert cycles == list(range(300))
            frame, found, pose = machine.cycle(300)
            served.feed.add_picture(make_picture(frame, found, [pose], served.feed.bodies))
            await page.send_json({"type": "pictures", "on": True})
            while True:
                message = await page.receive(5)
                if (
                    message.type is aiohttp.WSMsgType.BINARY
                    and struct.unpack_from("<I", message.data)[0] == 2
                ):
                    break
            _, size, jpeg, _ = struct.unpack_from("<4I", message.data)
            overlay = json.loads(message.data[16 : 16 + size])
            assert len(overlay["x_px"]) == len(found)
            assert message.data[16 + size :][:2] == b"\xff\xd8"
            assert len(message.data) == 16 + size + jpeg
            assert served.feed.watchers == 1

    asyncio.run(watch())
    wait_for(lambda: served.feed.watchers == 0)


def test_a_page_calls_services_and_sets_limits(serve, machine):
    served = serve()

    async def steer():
        async with aiohttp.ClientSession() as session, open_page(session, served) as page:
            await page.send_json({"type": "call", "id": 7, "service": "frame_source/stop"})
            await page.send_json({"type": "limit", "quantity": "psi", "low": None, "high": 0.1})
            result = state = None
            while result is None or not (state and state["limits"]):
                message = json.loads((await page.receive(5)).data)
                result = message if message["type"] == "result" else result
                state = message if message["type"] == "state" else state
            assert result == {"type": "result", "id": 7, "success": True, "message": "stopped"}
            assert served.called == ["frame_source/stop"]
            for pose in poses(machine, 5):
                served.feed.add_pose(pose)
            assert served.feed.state()["limits"][0]["active"]
            await page.send_json({"type": "remove_limit", "quantity": "psi"})
            await asyncio.sleep(0.2)
            assert served.feed.state()["limits"] == []

    asyncio.run(steer())


# Who gets in -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "host", ["evil.example", "evil.example:80", "127.0.0.1.evil.example", "", "[::1", "a b"]
)
def test_other_hosts_are_refused(serve, host):
    served = serve()
    response, body = get(served, "/", {"Host": host})
    assert response.status in (400, 403)
    assert b"<html" not in body
    assert response.status == 400 or any("403" in line for line in served.log)


def test_a_forwarded_port_is_no_other_host(serve):
    served = serve()
    assert get(served, "/", {"Host": "localhost:9999"})[0].status == 200
    assert get(served, "/", {"Host": "192.168.1.7:8606"})[0].status == 200


@pytest.mark.parametrize(
    "other", ["http://evil.example", "null", "http://localhost", "http://127.0.0.1:1", "file://"]
)
def test_other_origins_are_refused(serve, other):
    served = serve()
    assert get(served, "/", {"Origin": other})[0].status == 403

    async def connect():
        async with aiohttp.ClientSession() as session:
            with pytest.raises(aiohttp.WSServerHandshakeError, match="403"):
                await session.ws_connect(origin(served) + "/live", headers={"Origin": other})

    asyncio.run(connect())
    assert len(served.log) == 2


def test_a_connection_without_origin_is_refused(serve):
    served = serve()

    async def connect():
        async with aiohttp.ClientSession() as session:
            with pytest.raises(aiohttp.WSServerHandshakeError, match="403"):
                await session.ws_connect(origin(served) + "/live")

    asyncio.run(connect())


@pytest.mark.parametrize(
    "path",
    [
        "/../../../../etc/passwd",
        "/..%2f..%2f..%2fetc%2fpasswd",
        "/%2e%2e/%2e%2e/etc/passwd",
        "/vendor/../../server.py",
        "/vendor/..%5c..%5cserver.py",
        "//etc/passwd",
        "/server.py",
        "/page/main.js",
        "/vendor/",
        "/vendor",
        "/main.js/",
        "/main.js%00.html",
        "/.git/config",
        "http://evil.example/etc/passwd",
    ],
)
def test_only_the_files_of_the_page_exist(serve, path):
    served = serve()
    answer = raw(served, f"GET {path} HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n".encode())
    assert answer.split()[1] in (b"400", b"403", b"404")
    assert b"root:" not in answer
    assert b"import" not in answer
    assert served.log


def test_a_token_is_made_beyond_localhost_and_asked_for(serve):
    served = serve(address="0.0.0.0")
    token = served.url.partition("?token=")[2]
    assert len(token) >= 32
    assert get(served, "/")[0].status == 401
    assert get(served, "/", {"Cookie": f"{access.COOKIE}={token}"})[0].status == 200
    assert serve().url.endswith("/")


def test_token_is_exchanged_for_a_cookie_that_scripts_and_other_sites_do_not_get(serve):
    served = serve(token=TOKEN)
    response, _ = get(served, f"/?token={TOKEN.replace(' ', '%20')}")
    assert response.status == 303
    assert response.headers["Location"] == "/"
    cookie = response.headers["Set-Cookie"]
    assert "HttpOnly" in cookie
    assert "SameSite=Strict" in cookie
    response, body = get(served, "/", {"Cookie": cookie.split(";")[0]})
    assert response.status == 200
    assert b"<html" in body


@pytest.mark.parametrize("path", ["/", "/main.js", "/live", "/?token=wrong", "/?token=", "/?token=%ff%fe"])
@pytest.mark.parametrize("cookie", ["", "wrong", TOKEN[:-1], "caf\u00e9"])
def test_wrong_tokens_are_refused_and_not_logged(serve, path, cookie):
    served = serve(token=TOKEN)
    response, _ = get(served, path, {"Cookie": f"{access.COOKIE}={cookie}"})
    assert response.status == 401
    assert len(served.log) == 1
    assert "wrong" not in served.log[0]


def test_short_tokens_and_taken_ports_are_one_clear_error(serve):
    with pytest.raises(InputError, match="at least 16"):
        serve(token="1234")
    port = urlsplit(serve().url).port
    with pytest.raises(InputError, match=f"port {port}"):
        serve(port=port)
    with pytest.raises(InputError, match="port"):
        serve(port=70000)


# What is refused ---------------------------------------------------------------------------------

MALFORMED = [
    "",
    "{",
    "[]",
    "null",
    "[" * 4000,
    '{"type": "shutdown"}',
    '{"type": "call", "id": 1, "service": "/other_node/shutdown"}',
    '{"type": "call", "id": "1", "service": "frame_source/stop"}',
    '{"type": "call", "id": 1, "service": "frame_source/stop", "more": 1}',
    '{"type": "limit", "quantity": "dx", "low": NaN, "high": 1}',
    '{"type": "limit", "quantity": "dx", "low": 1, "high": 0}',
    '{"type": "limit", "quantity": "dx", "low": "0", "high": 1}',
    '{"type": "limit", "quantity": "dx", "low": 1' + "0" * 400 + ', "high": null}',
    '{"type": "limit", "quantity": "__class__", "low": 0, "high": 1}',
    '{"type": "pictures", "on": 1}',
    "x" * (MAX_MESSAGE + 1),
    "x" * 1_000_000,
    b"\x00\x01\x02\x03",
]


@pytest.mark.parametrize("message", MALFORMED, ids=range(len(MALFORMED)))
def test_malformed_messages_close_the_connection_and_are_logged(serve, message):
    served = serve()

    async def attack():
        async with aiohttp.ClientSession() as session, open_page(session, served) as page:
            await (page.send_bytes if isinstance(message, bytes) else page.send_str)(message)
            while (await page.receive(5)).type in (aiohttp.WSMsgType.TEXT, aiohttp.WSMsgType.BINARY):
                pass
            return page.close_code

    assert asyncio.run(attack()) in (1008, 1009)
    wait_for(lambda: served.log)
    assert len(served.log) == 1
    assert len(served.log[0]) < 400
    assert served.called == []


def test_nothing_disturbs_a_page_that_watches(serve, machine):
    """While a page watches 90 cycles/s, everything else is thrown at the server: it misses no row."""
    served = serve()
    made = poses(machine, 270)
    received: list[int] = []

    async def watch():
        async with aiohttp.ClientSession() as session, open_page(session, served) as page:
            while len(received) < len(made):
                message = await page.receive(5)
                if message.type is aiohttp.WSMsgType.BINARY:
                    received.extend(rows_of(message.data)[:, CYCLE].astype(int).tolist())

    watcher = threading.Thread(target=lambda: asyncio.run(watch()))
    watcher.start()

    def measure():
        for pose in made:
            served.feed.add_pose(pose)
            time.sleep(1 / 90)

    measuring = threading.Thread(target=measure)
    measuring.start()
    head = f"GET / HTTP/1.1\r\nHost: localhost\r\nOrigin: {origin(served)}\r\n"
    answers = [
        raw(served, b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03" + bytes(range(256))),
        raw(served, b"GET / HTTP/9.9\r\n\r\n"),
        raw(served, b"GET " + b"/a" * 100_000 + b" HTTP/1.1\r\nHost: localhost\r\n\r\n"),
        raw(served, head.encode() + b"X-Long: " + b"a" * 1_000_000 + b"\r\n\r\n"),
        raw(served, head.encode() + b"X-Many: a\r\n" * 100_000 + b"\r\n"),
        raw(served, head.encode() + b"Content-Length: -1\r\n\r\n"),
        raw(
            served,
            b"POST / HTTP/1.1\r\nHost: localhost\r\nContent-Length: 99999999999\r\n\r\n" + b"a" * 1_000_000,
        ),
        raw(
            served,
            head.replace("/ ", "/live ").encode() + b"Upgrade: websocket\r\nConnection: Upgrade\r\n"
            b"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n"
            + b"\xff"
            * 5000,
        ),
        raw(
            served,
            head.replace("/ ", "/live ").encode() + b"Upgrade: websocket\r\nConnection: Upgrade\r\n"
            b"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: short\r\n\r\n",
        ),
    ]
    for answer in answers:
        assert b"<html" not in answer
        assert not answer or answer.split()[1] in (b"101", b"400", b"403", b"405", b"413", b"414", b"431")
    for method in ("POST", "PUT", "DELETE", "OPTIONS", "PATCH"):
        assert get(served, "/", method=method)[0].status == 405
    measuring.join()
    watcher.join(timeout=10)
    assert received == list(range(270))
    assert get(served, "/")[0].status == 200
    assert len(served.log) >= 10


def test_a_flood_of_messages_closes_the_connection(serve):
    served = serve()

    async def attack():
        async with aiohttp.ClientSession() as session, open_page(session, served) as page:
            for _ in range(2 * MAX_MESSAGES_PER_SECOND):
                await page.send_json({"type": "pictures", "on": True})
            while (await page.receive(5)).type in (aiohttp.WSMsgType.TEXT, aiohttp.WSMsgType.BINARY):
                pass
            return page.close_code

    assert asyncio.run(attack()) == 1008
    wait_for(lambda: served.feed.watchers == 0)


def test_pages_and_log_lines_are_limited(serve):
    served = serve()

    async def crowd():
        async with aiohttp.ClientSession() as session:
            pages = [await open_page(session, served) for _ in range(MAX_PAGES)]
            with pytest.raises(aiohttp.WSServerHandshakeError, match="503"):
                await open_page(session, served)
            await pages[0].close()
            await asyncio.sleep(0.1)
            await (await open_page(session, served)).close()

    asyncio.run(crowd())
    for _ in range(100):
        get(served, "/nothing")
    assert len(served.log) <= 21


def test_log_lines_cannot_be_forged(serve):
    served = serve()
    raw(served, b"GET /%0a[ERROR]%20all%20is%20lost HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n")
    assert len(served.log) == 1
    assert "\n" not in served.log[0]


def test_stopping_says_goodbye(serve):
    served = serve()

    async def watch():
        async with aiohttp.ClientSession() as session, open_page(session, served) as page:
            threading.Thread(target=served.server.stop).start()
            while (await page.receive(5)).type in (aiohttp.WSMsgType.TEXT, aiohttp.WSMsgType.BINARY):
                pass
            return page.close_code

    assert asyncio.run(watch()) == 1001


def test_a_page_that_cannot_be_sent_anything_is_cut_off_and_the_defect_told(serve):
    served = serve()

    async def watch():
        async with aiohttp.ClientSession() as session, open_page(session, served) as page:
            await page.receive(5)
            served.feed.set_instrument({"rates": float("nan")})  # no JSON
            while (await page.receive(5)).type in (aiohttp.WSMsgType.TEXT, aiohttp.WSMsgType.BINARY):
                pass

    asyncio.run(watch())
    wait_for(lambda: served.log)
    assert "cut off by ValueError" in served.log[0]


# How much it bears -----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ATTACKS)
def test_attacks_are_refused_logged_and_disturb_nobody(name):
    refused, logged, missed = attacked(ATTACKS[name])
    assert refused
    assert 1 <= logged <= 21
    assert missed == 0


def test_connections_that_never_become_a_page_are_closed(serve, monkeypatch):
    monkeypatch.setattr(door, "PATIENCE", 0.3)
    served = serve()
    where = urlsplit(served.url)
    with socket.create_connection((where.hostname, where.port)) as silent:
        silent.settimeout(5)
        assert silent.recv(1) == b""
    wait_for(lambda: served.log)
    assert "no page after" in served.log[0]
    # One that was answered closes without a word, and a page stays.

    async def stay():
        async with aiohttp.ClientSession() as session, open_page(session, served) as page:
            async with session.get(served.url) as response:
                assert response.status == 200
            await asyncio.sleep(0.6)
            await page.send_json({"type": "pictures", "on": True})
            await asyncio.sleep(0.2)
            assert not page.closed
            assert served.feed.watchers == 1

    asyncio.run(stay())
    assert len(served.log) == 1


def test_a_page_that_takes_nothing_is_closed_and_costs_little_meanwhile(serve, machine, monkeypatch):
    monkeypatch.setattr(server, "_SEND_TIMEOUT", 1.0)
    served = serve()
    frame, found, pose = machine.cycle(0)
    picture = replace(make_picture(frame, found, [pose], {}), jpeg=bytes(500_000))
    where = urlsplit(served.url)
    with socket.socket() as deaf:
        deaf.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        deaf.connect((where.hostname, where.port))
        deaf.sendall(upgrade(served))
        deaf.sendall(text_frame('{"type": "pictures", "on": true}'))
        wait_for(lambda: served.feed.watchers == 1)
        tracemalloc.start()
        for number in range(40):  # 20 MB of pictures, 1000 rows
            served.feed.add_picture(picture)
            for k in range(25):
                served.feed.add_pose(replace(pose, cycle=25 * number + k))
            time.sleep(0.02)
        grown = tracemalloc.get_traced_memory()[0]
        tracemalloc.stop()
        assert grown < 4e6
        wait_for(lambda: served.feed.watchers == 0)


def test_a_slow_page_gets_the_newest_picture_and_every_row(serve, machine):
    served = serve()
    frame, found, pose = machine.cycle(0)
    picture = make_picture(frame, found, [pose], {})
    numbers, cycles = [], []
    fed = 0

    def feed():
        nonlocal fed
        for number in range(250):
            overlay = {**picture.overlay, "frame_counter": number}
            served.feed.add_picture(replace(picture, jpeg=bytes(100_000), overlay=overlay))
            served.feed.add_pose(replace(pose, cycle=number))
            fed = number
            time.sleep(0.02)

    async def dawdle():
        async with aiohttp.ClientSession() as session, open_page(session, served) as page:
            await page.send_json({"type": "pictures", "on": True})
            feeding = threading.Thread(target=feed)
            feeding.start()
            while len(cycles) < 250:
                message = await page.receive(5)
                if message.type is not aiohttp.WSMsgType.BINARY:
                    continue
                if message.data[0] == 1:
                    cycles.extend(rows_of(message.data)[:, CYCLE].astype(int).tolist())
                else:
                    size = struct.unpack_from("<4I", message.data)[1]
                    numbers.append((json.loads(message.data[16 : 16 + size])["frame_counter"], fed))
                    await asyncio.sleep(0.2)  # 5 pictures/s of the 25 that would be sent
                    await page.send_json({"type": "seen"})
            feeding.join()

    asyncio.run(dawdle())
    assert cycles == list(range(250))
    assert len(numbers) < 60
    assert max(now - number for number, now in numbers) < 25  # half a second


@pytest.mark.skipif(shutil.which("openssl") is None, reason="a certificate is made by openssl")
def test_the_page_is_served_encrypted(serve, tmp_path):
    certificate, key = tmp_path / "page.pem", tmp_path / "page.key"
    command = [
        "openssl",
        "req",
        "-x509",
        "-newkey",
        "rsa:2048",
        "-nodes",
        "-days",
        "2",
        "-subj",
        "/CN=localhost",
    ]
    subprocess.run(
        [*command, "-addext", "subjectAltName=IP:127.0.0.1", "-out", certificate, "-keyout", key],
        check=True,
        capture_output=True,
    )
    served = serve(certificate=str(certificate), key=str(key), token=TOKEN)
    assert served.url.startswith("https://127.0.0.1:")
    trusted = ssl.create_default_context(cafile=str(certificate))

    async def look():
        jar = aiohttp.CookieJar(unsafe=True)  # which keeps cookies of an address, as browsers do
        async with aiohttp.ClientSession(cookie_jar=jar) as session:
            async with session.get(served.url, ssl=trusted) as response:
                assert b"<html" in await response.read()
                assert "Secure" in response.history[0].headers["Set-Cookie"]
            origin_ = served.url.partition("/?")[0]
            async with session.ws_connect(
                f"{origin_}/live", headers={"Origin": origin_}, ssl=trusted, max_msg_size=0
            ) as page:
                assert json.loads((await page.receive(5)).data)["type"] == "hello"

    asyncio.run(look())
    for wrong in ({"certificate": str(certificate)}, {"certificate": "absent.pem", "key": str(key)},
                  {"certificate": str(key), "key": str(certificate)}):  # fmt: skip
        with pytest.raises(InputError, match="certificate"):
            serve(**wrong)
