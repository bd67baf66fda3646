"""What others may try on the live page, each a program of a few lines: for tests and `validate monitor`."""

from __future__ import annotations

import asyncio
import contextlib
import json
import resource
import socket
import struct
from collections.abc import Awaitable, Callable, Mapping
from urllib.parse import urlsplit

import aiohttp

Attack = Callable[[str], Awaitable[bool]]

_PATHS = (
    "/../../../../etc/passwd",
    "/..%2f..%2f..%2fetc%2fpasswd",
    "/%2e%2e/%2e%2e/etc/passwd",
    "/vendor/..%5c..%5cserver.py",
    "//etc/passwd",
    "/server.py",
    "/main.js%00.html",
    "http://evil.example/etc/passwd",
)
_MESSAGES = (
    "{",
    "[" * 4000,
    '{"type": "shutdown"}',
    '{"type": "call", "id": 1, "service": "/other_node/shutdown"}',
    '{"type": "limit", "quantity": "dx", "low": NaN, "high": 1}',
    "x" * 1_000_000,
    b"\x00\x01\x02\x03",
)
#: Opening handshake of a WebSocket, to be filled with what the attack is about.
_UPGRADE = (
    "GET /live HTTP/1.1\r\nHost: {host}\r\nOrigin: http://{host}\r\nUpgrade: websocket\r\n"
    "Connection: Upgrade\r\nSec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n"
)


def _where(url: str) -> tuple[str, int]:
    parts = urlsplit(url)
    return str(parts.hostname), int(parts.port or 80)


async def _say(url: str, *pieces: bytes, patience: float = 5.0) -> bytes:
    """Send raw bytes and return what comes back until the server closes or ``patience`` s have passed."""
    reader, writer = await asyncio.open_connection(*_where(url))
    answer = b""
    with contextlib.suppress(ConnectionError, asyncio.TimeoutError):
        for piece in pieces:
            writer.write(piece)
            await asyncio.wait_for(writer.drain(), patience)
        while data := await asyncio.wait_for(reader.read(65536), patience):
            answer += data
    writer.close()
    return answer


def _get(path: str, host: str, *headers: str) -> bytes:
    lines = [f"GET {path} HTTP/1.1", f"Host: {host}", *headers, "Connection: close", "", ""]
    return "\r\n".join(lines).encode()


def _refused(answer: bytes) -> bool:
    """An answer that gives nothing away: none at all, or an error."""
    return not answer or answer.split()[1][:1] in (b"4", b"5")


async def other_host(url: str) -> bool:
    """A page of another site whose name has come to mean this machine (DNS rebinding)."""
    names = ("evil.example", f"evil.example:{_where(url)[1]}", "127.0.0.1.evil.example")
    return all([_refused(await _say(url, _get("/", name))) for name in names])


async def other_origin(url: str) -> bool:
    """A page of another site that asks on behalf of whoever has it open."""
    host = urlsplit(url).netloc
    origins = ("http://evil.example", "null", "http://localhost", "file://")
    refused = [_refused(await _say(url, _get("/", host, f"Origin: {origin}"))) for origin in origins]
    upgrade = _UPGRADE.format(host=host).replace(f"Origin: http://{host}", "Origin: http://evil.example")
    return all(refused) and _refused(await _say(url, upgrade.encode()))


async def other_paths(url: str) -> bool:
    """Files that are not the page's."""
    host = urlsplit(url).netloc
    answers = [await _say(url, _get(path, host)) for path in _PATHS]
    return all(_refused(answer) and b"root:" not in answer and b"import" not in answer for answer in answers)


async def wrong_token(url: str) -> bool:
    """Guesses at a server that asks for a token."""
    host = urlsplit(url).netloc
    paths = ("/", "/main.js", "/live", "/?token=wrong", "/?token=", "/?token=%ff%fe")
    cookies = ("", "Cookie: mems6dof_monitor=wrong")
    answers = [await _say(url, _get(path, host, cookie)) for path in paths for cookie in cookies if cookie]
    return all(b" 401 " in answer.partition(b"\r\n")[0] for answer in answers)


async def oversized(url: str) -> bool:
    """Requests larger than any that the page makes."""
    host = urlsplit(url).netloc
    head = f"Host: {host}\r\n".encode()
    return all(
        [
            _refused(await _say(url, b"GET " + b"/a" * 100_000 + b" HTTP/1.1\r\n" + head + b"\r\n")),
            _refused(await _say(url, b"GET / HTTP/1.1\r\n" + head + b"X: " + b"a" * 1_000_000 + b"\r\n\r\n")),
            _refused(await _say(url, b"GET / HTTP/1.1\r\n" + head + b"X: a\r\n" * 100_000 + b"\r\n")),
            _refused(
                await _say(
                    url,
                    b"POST / HTTP/1.1\r\n" + head + b"Content-Length: 99999999999\r\n\r\n",
                    b"a" * 1_000_000,
                )
            ),
        ]
    )


async def malformed(url: str) -> bool:
    """What is not HTTP."""
    greetings = (
        b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03" + bytes(range(256)),
        b"GET / HTTP/9.9\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: localhost\r\nContent-Length: -1\r\n\r\n",
        b"\x00" * 1000 + b"\r\n\r\n",
    )
    return all([_refused(await _say(url, greeting)) for greeting in greetings])


async def malformed_messages(url: str) -> bool:
    """A page that asks for what there is not."""
    closed = []
    async with aiohttp.ClientSession() as session:
        for message in _MESSAGES:
            async with session.ws_connect(
                f"{url}live", headers={"Origin": url.rstrip("/")}, max_msg_size=0
            ) as page:
                if isinstance(message, bytes):
                    await page.send_bytes(message)
                else:
                    await page.send_str(message)
                while (await page.receive(5)).type in (aiohttp.WSMsgType.TEXT, aiohttp.WSMsgType.BINARY):
                    pass
                closed.append(page.close_code)
    return all(code in (1008, 1009) for code in closed)


async def oversized_frames(url: str) -> bool:
    """WebSocket frames that announce more than anybody has: 2^62 bytes, and fragments without an end."""
    upgrade = _UPGRADE.format(host=urlsplit(url).netloc).encode()
    mask = b"\x00\x00\x00\x00"
    announced = b"\x81\xff" + struct.pack(">Q", 2**62) + mask + b"{" * 10_000
    fragment = b"\xfe" + struct.pack(">H", 4000) + mask + b"x" * 4000
    fragments = b"\x01" + fragment + (b"\x00" + fragment) * 50
    answers = [await _say(url, upgrade + frames) for frames in (announced, fragments, b"\xff" * 5000)]
    return all(b"\x88" in answer for answer in answers)  # a frame that says goodbye


async def thousands_of_sockets(url: str) -> bool:
    """As many connections as this process may have, without a word; then an honest request."""
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(most, 4000), most))
    sockets = []
    try:
        for _ in range(3000):
            connection = socket.socket()
            sockets.append(connection)
            connection.setblocking(False)
            with contextlib.suppress(BlockingIOError):
                connection.connect(_where(url))
            if len(sockets) % 50 == 0:
                await asyncio.sleep(0.01)  # a backlog that overflows would only be slow
        host = urlsplit(url).netloc
        return b"<html" in await _say(url, _get("/", host))
    finally:
        for connection in sockets:
            connection.close()


async def slow_requests(url: str) -> bool:
    """A hundred requests at one byte a second (slow loris), while an honest one is answered."""
    host = urlsplit(url).netloc
    request = _get("/", host).rstrip()
    writers = [(await asyncio.open_connection(*_where(url)))[1] for _ in range(100)]
    for count in range(3):
        for writer in writers:
            with contextlib.suppress(ConnectionError):
                writer.write(request[count : count + 1])
        await asyncio.sleep(1.0)
    answered = b"<html" in await _say(url, _get("/", host))
    for writer in writers:
        writer.close()
    return answered


async def flood(url: str) -> bool:
    """A page that asks without pause."""
    async with (
        aiohttp.ClientSession() as session,
        session.ws_connect(f"{url}live", headers={"Origin": url.rstrip("/")}, max_msg_size=0) as page,
    ):
        with contextlib.suppress(ConnectionError, aiohttp.ClientError):
            for _ in range(500):
                await page.send_str(json.dumps({"type": "pictures", "on": True}))
        while (await page.receive(5)).type in (aiohttp.WSMsgType.TEXT, aiohttp.WSMsgType.BINARY):
            pass
        return page.close_code == 1008


#: By name; each gets the address of a page and returns whether it was refused. ``wrong_token`` is for a
#: server that asks for one.
ATTACKS: Mapping[str, Attack] = {
    "other host name (DNS rebinding)": other_host,
    "other origin": other_origin,
    "path traversal": other_paths,
    "oversized requests": oversized,
    "malformed requests": malformed,
    "malformed messages": malformed_messages,
    "oversized WebSocket frames": oversized_frames,
    "flood of messages": flood,
    "slow requests (slow loris), 100": slow_requests,
    "3000 sockets": thousands_of_sockets,
}
