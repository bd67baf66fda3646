"""The web server of the live page: one page, one WebSocket, nothing else.

Protocol of the WebSocket. Numbers are SI. To the page, text is JSON with a ``type``: ``hello``, ``state``,
``events``, ``result`` of a call; binary is a block of little-endian uint32 words and what they announce:

    1, epoch, rows n, columns m, then n x m float64: rows of the history, every one of them
    2, bytes of JSON j, bytes of JPEG, 0, then the JSON padded with blanks to j, then the JPEG

From the page, text only, at most MAX_MESSAGE bytes: ``call`` a service (some with a number), set a ``limit``,
``remove_limit``, ``pictures`` wanted or not, and ``seen`` once a picture is drawn. Anything else closes the
connection.

What waits for a page is bounded: rows wait in the history that all pages share; of pictures and states only
the newest is ever sent, a picture when the one before has been seen, so that a slow line shows fewer and not
older ones; and a page that takes nothing for _SEND_TIMEOUT is closed.
"""

from __future__ import annotations

import asyncio
import json
import logging
import math
import os
import socket
import struct
import threading
import time
from collections import deque
from collections.abc import Awaitable, Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager, suppress
from importlib import resources
from typing import Any

from aiohttp import WSMsgType, web

from mems6dof_ros.errors import InputError
from mems6dof_ros.monitor import access
from mems6dof_ros.monitor.alarms import QUANTITIES, Limit
from mems6dof_ros.monitor.door import Door
from mems6dof_ros.monitor.feed import Feed
from mems6dof_ros.monitor.history import COLUMNS
from mems6dof_ros.monitor.picture import Picture

MAX_PAGES = 8
MAX_MESSAGE = 4096
MAX_MESSAGES_PER_SECOND = 50
#: Between two batches to a page, s: as often as it draws, slower than the cycles.
_TICK = 0.1
_ROWS_PER_BATCH = 2000
_SEND_TIMEOUT = 10.0
#: Bytes that the kernel may hold for a page: on a slow line, more of them would be seconds of the past.
_SEND_BUFFER = 2**18
_CALL_TIMEOUT = 5.0
_REFUSALS_LOGGED = 20
_REFUSALS_PERIOD = 10.0

_TYPES = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".svg": "image/svg+xml",
    ".LICENSE": "text/plain; charset=utf-8",
}

#: Calls a service by its name, with a number or None; the result is (success, message).
Caller = Callable[[str, "float | None"], "Future[tuple[bool, str]]"]


class _Refused(Exception):
    """A message of a page that is not understood or not allowed."""


class MonitorServer:
    """Serves the page from a thread of its own.

    ``call`` is asked to call one of the services that the feed's state lists. Without a token, only
    loopback addresses are served; for others one is made. ``certificate`` and its ``key``: PEM files; with
    them, https is spoken instead of http. ``log`` hears of every refusal.
    """

    def __init__(
        self,
        feed: Feed,
        call: Caller,
        *,
        address: str = "127.0.0.1",
        port: int = 0,
        token: str = "",
        certificate: str = "",
        key: str = "",
        log: Callable[[str], None] = print,
    ) -> None:
        if not 0 <= port <= 65535:
            raise InputError("port", str(port), "0 (any free one) to 65535")
        self._encryption = access.encryption(certificate, key)
        self._feed = feed
        self._call = call
        self._address = address
        self._port = port
        self._token = access.choose_token(address, token)
        self._log = log
        self._files = dict(_page_files())
        self._pages: set[web.WebSocketResponse] = set()
        self._refusals: deque[float] = deque(maxlen=_REFUSALS_LOGGED)
        self._refusals_hidden = 0
        self._stopping = asyncio.Event()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._thread = threading.Thread(target=self._run, name="monitor", daemon=True)
        self._url: Future[str] = Future()

    def start(self) -> str:
        """Begin to serve; returns the address to open. InputError where the address cannot be used."""
        self._thread.start()
        return self._url.result()

    def stop(self) -> None:
        """Close every page and the port."""
        if self._loop and self._thread.is_alive():
            with suppress(RuntimeError):  # the loop has just been closed: it ends by itself
                self._loop.call_soon_threadsafe(self._stopping.set)
            self._thread.join(timeout=5)

    def _run(self) -> None:
        with _heard(self._note_refusal, self._log):
            asyncio.run(self._serve())

    async def _serve(self) -> None:
        app = web.Application(middlewares=[self._guard], client_max_size=MAX_MESSAGE)
        app.router.add_get("/live", self._live)
        app.router.add_get("/{path:.*}", self._file)
        app.on_response_prepare.append(_add_security_headers)
        runner = web.AppRunner(app, access_log=None, shutdown_timeout=1.0)
        await runner.setup()
        assert runner.server is not None
        self._door = Door(runner.server, self._note_refusal)
        self._loop = asyncio.get_running_loop()
        try:
            listening = await self._loop.create_server(
                self._door.newcomer, self._address, self._port, ssl=self._encryption
            )
        except OSError as error:
            await runner.cleanup()
            where = f"address {self._address}, port {self._port}"
            # asyncio wraps the reason in a sentence of its own, so the plain one comes from the number.
            number = error.errno or 0
            reason = os.strerror(number).lower() if number > 0 else str(error)
            self._url.set_exception(InputError(where, reason, "an address and port free here"))
            return
        host, port, *_ = listening.sockets[0].getsockname()
        scheme = "https" if self._encryption else "http"
        self._url.set_result(access.page_url(scheme, host, port, self._token))
        await self._stopping.wait()
        listening.close()
        for page in list(self._pages):
            await page.close(code=1001, message=b"the monitor stops")
        await runner.cleanup()

    # Requests -----------------------------------------------------------------------------------

    @web.middleware
    async def _guard(
        self, request: web.Request, handler: Callable[[web.Request], Awaitable[web.StreamResponse]]
    ) -> web.StreamResponse:
        """Let in who may talk to the page, see ``access``; say no to everybody else, and log it."""
        if request.transport is not None:
            self._door.answered(request.transport)
        try:
            if not access.host_allowed(request.host):
                raise web.HTTPForbidden(text="This host name is not served.\n")
            origin = request.headers.get("Origin")
            if origin is not None and not access.origin_allowed(origin, request.host):
                raise web.HTTPForbidden(text="Requests from other origins are refused.\n")
            if self._token:
                given = request.query.get("token")
                if given is not None and request.path == "/" and access.token_matches(given, self._token):
                    return self._admit()
                if not access.token_matches(request.cookies.get(access.COOKIE, ""), self._token):
                    raise web.HTTPUnauthorized(
                        text="Open the address that the monitor printed, token included.\n"
                    )
            return await handler(request)
        except web.HTTPException as refusal:
            if refusal.status >= 400:
                self._log_refusal(request, f"{refusal.status} {refusal.reason}")
            raise

    def _admit(self) -> web.Response:
        """Exchange the token in the address, which is seen and kept in histories, for a cookie."""
        response = web.Response(status=303, headers={"Location": "/"})
        secure = self._encryption is not None
        response.set_cookie(
            access.COOKIE, self._token, httponly=True, samesite="Strict", path="/", secure=secure
        )
        return response

    async def _file(self, request: web.Request) -> web.Response:
        """A file of the page. They are looked up by name, no path is ever made from a request."""
        if request.path not in self._files:
            raise web.HTTPNotFound(text="Nothing of that name.\n")
        content_type, body = self._files[request.path]
        return web.Response(body=body, headers={"Content-Type": content_type})

    async def _live(self, request: web.Request) -> web.StreamResponse:
        if "Origin" not in request.headers:
            raise web.HTTPForbidden(text="Only the page itself may connect.\n")
        if len(self._pages) >= MAX_PAGES:
            raise web.HTTPServiceUnavailable(text=f"{MAX_PAGES} pages are open already.\n")
        page_socket = web.WebSocketResponse(max_msg_size=MAX_MESSAGE, compress=False, heartbeat=20.0)
        await page_socket.prepare(request)
        assert request.transport is not None
        self._door.settled(request.transport)
        request.transport.get_extra_info("socket").setsockopt(
            socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER
        )
        self._pages.add(page_socket)

        page = _Page(self._feed, page_socket, self._call)
        sender = asyncio.create_task(page.send())
        sender.add_done_callback(lambda sender: self._sent(request, sender))
        try:
            await page.receive()
        except _Refused as refusal:
            self._log_refusal(request, str(refusal))
            await page_socket.close(code=1008, message=str(refusal).encode()[:120])
        finally:
            self._pages.discard(page_socket)
            page.leave()
            sender.cancel()
            with suppress(asyncio.CancelledError, Exception):  # told by _sent
                await sender
        return page_socket

    def _sent(self, request: web.Request, sender: asyncio.Task[None]) -> None:
        """Cut off a page that will be sent nothing more: it must not stand still as if nothing happened."""
        if sender.cancelled() or (error := sender.exception()) is None:
            return
        if isinstance(error, asyncio.TimeoutError):
            self._log_refusal(request, f"takes nothing for {_SEND_TIMEOUT:.0f} s")
        elif not isinstance(error, ConnectionError):
            self._log(f"a page is cut off by {error!r}")
        if request.transport is not None:
            request.transport.abort()  # it would not take a goodbye either

    def _log_refusal(self, request: web.Request, reason: str) -> None:
        # Never the query: it may hold a token.
        self._note_refusal(f"{request.method} {_shown(request.path)} from {request.remote}: {reason}")

    def _note_refusal(self, what: str) -> None:
        """One line for a refusal; whoever floods the page does not flood the log."""
        now = time.monotonic()
        if len(self._refusals) == _REFUSALS_LOGGED and now - self._refusals[0] < _REFUSALS_PERIOD:
            self._refusals_hidden += 1
            return
        hidden, self._refusals_hidden = self._refusals_hidden, 0
        self._refusals.append(now)
        more = f" ({hidden} refusals before it not logged)" if hidden else ""
        self._log(f"refused {what}{more}")


class _Page:
    """One open page: what it has been sent, and what it asks for."""

    def __init__(self, feed: Feed, socket: web.WebSocketResponse, call: Caller) -> None:
        self._feed = feed
        self._socket = socket
        self._call = call
        self._wants_pictures = False
        self._unseen = False  # a picture is on its way
        self._received: deque[float] = deque(maxlen=MAX_MESSAGES_PER_SECOND)

    def leave(self) -> None:
        self._set_pictures(False)

    # To the page --------------------------------------------------------------------------------

    async def send(self) -> None:
        """Send what is new, every tick, until the page is closed or too slow to take it."""
        hello = {
            "type": "hello",
            "columns": COLUMNS,
            "limitable": QUANTITIES,
            "capacity": self._feed.history.capacity,
        }
        await self._send_json(hello)
        next_row, last_event, last_picture, last_state = 0, 0, 0, ""
        while not self._socket.closed:
            started = time.monotonic()
            while True:
                epoch, next_row, rows = self._feed.history.since(next_row, _ROWS_PER_BATCH)
                if len(rows):
                    head = struct.pack("<4I", 1, epoch, *rows.shape)
                    await self._send(self._socket.send_bytes(head + rows.astype("<f8").tobytes()))
                if len(rows) < _ROWS_PER_BATCH:
                    break
            if events := self._feed.events(last_event):
                last_event = events[-1]["number"]
                await self._send_json({"type": "events", "events": events})
            state = json.dumps({"type": "state", **self._feed.state()}, allow_nan=False)
            if state != last_state:
                last_state = state
                await self._send(self._socket.send_str(state))
            number, picture = self._feed.picture()
            if picture and number != last_picture and self._wants_pictures and not self._unseen:
                last_picture, self._unseen = number, True
                await self._send(self._socket.send_bytes(_pack_picture(picture)))
            await asyncio.sleep(max(_TICK - (time.monotonic() - started), 0.001))

    async def _send_json(self, message: dict[str, Any]) -> None:
        await self._send(self._socket.send_str(json.dumps(message, allow_nan=False)))

    async def _send(self, sending: Awaitable[None]) -> None:
        """Raises TimeoutError where the page takes nothing for long; its rows would be lost to it anyway."""
        await asyncio.wait_for(sending, _SEND_TIMEOUT)

    # From the page ------------------------------------------------------------------------------

    async def receive(self) -> None:
        """Do what the page asks until it goes; raises _Refused for what is no proper request."""
        async for message in self._socket:
            now = time.monotonic()
            if len(self._received) == MAX_MESSAGES_PER_SECOND and now - self._received[0] < 1:
                raise _Refused(f"more than {MAX_MESSAGES_PER_SECOND} messages in a second")
            self._received.append(now)
            if message.type is not WSMsgType.TEXT:
                raise _Refused(f"a message that is not text ({message.type.name.lower()})")
            await self._obey(_parse(message.data))
        if self._socket.close_code not in (None, 1000, 1001, 1005, 1006):
            raise _Refused(
                f"closed with code {self._socket.close_code}: {self._socket.exception() or 'see RFC 6455'}"
            )

    async def _obey(self, request: dict[str, Any]) -> None:
        match request:
            case {"type": "call", "id": int(number), "service": str(service), **rest} if not rest:
                await self._call_service(number, service, None)
            case {"type": "call", "id": int(number), "service": str(service), "value": value, **rest} if (
                not rest
            ):
                await self._call_service(number, service, _number(value))
            case {"type": "limit", "quantity": str(quantity), "low": low, "high": high, **rest} if not rest:
                try:
                    self._feed.set_limit(Limit(quantity, _bound(low, -math.inf), _bound(high, math.inf)))
                except InputError as error:
                    raise _Refused(_shown(str(error))) from error
            case {"type": "remove_limit", "quantity": str(quantity), **rest} if not rest:
                self._feed.remove_limit(quantity)
            case {"type": "pictures", "on": bool(on), **rest} if not rest:
                self._set_pictures(on)
            case {"type": "seen", **rest} if not rest:
                self._unseen = False
            case _:
                raise _Refused(f"not a request: {_shown(json.dumps(request))}")

    async def _call_service(self, number: int, service: str, value: float | None) -> None:
        if service not in self._feed.state().get("services", {}):
            raise _Refused(f"no service {_shown(service)}")
        try:
            success, text = await asyncio.wait_for(
                asyncio.wrap_future(self._call(service, value)), _CALL_TIMEOUT
            )
        except asyncio.TimeoutError:
            success, text = False, f"no answer within {_CALL_TIMEOUT:.0f} s"
        self._feed.tell(
            "info" if success else "warning", f"{service}: {text or ('done' if success else 'failed')}"
        )
        await self._send_json({"type": "result", "id": number, "success": success, "message": text})

    def _set_pictures(self, on: bool) -> None:
        self._feed.watchers += int(on) - int(self._wants_pictures)
        self._wants_pictures, self._unseen = on, False


def _parse(text: str) -> dict[str, Any]:
    try:
        request = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise _Refused(f"not JSON: {_shown(text)}") from error
    if not isinstance(request, dict):
        raise _Refused(f"not a JSON object: {_shown(text)}")
    return request


def _bound(value: object, default: float) -> float:
    return default if value is None else _number(value)


def _number(value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < 1e300:
        raise _Refused(f"a number of {_shown(str(value))}")
    return float(value)


def _pack_picture(picture: Picture) -> bytes:
    overlay = json.dumps(picture.overlay, allow_nan=False).encode()
    return struct.pack("<4I", 2, len(overlay), len(picture.jpeg), 0) + overlay + picture.jpeg


def _shown(text: str) -> str:
    """Text of unknown origin, fit for a log: escaped and short."""
    return repr(text if len(text) <= 80 else text[:80] + "...")


def _page_files() -> Iterator[tuple[str, tuple[str, bytes]]]:
    page = resources.files("mems6dof_ros.monitor") / "page"
    for folder, prefix in ((page, "/"), (page / "vendor", "/vendor/")):
        for file in folder.iterdir():
            suffix = "." + file.name.rpartition(".")[2]
            if file.is_file() and suffix in _TYPES:
                content = (_TYPES[suffix], file.read_bytes())
                yield prefix + file.name, content
                if prefix + file.name == "/index.html":
                    yield "/", content


async def _add_security_headers(_: web.Request, response: web.StreamResponse) -> None:
    response.headers.update(access.SECURITY_HEADERS)


@contextmanager
def _heard(refused: Callable[[str], None], log: Callable[[str], None]) -> Iterator[None]:
    """Hand on what aiohttp has to say: malformed requests to ``refused``, defects to ``log``."""
    malformed = "Error handling request"

    class Handler(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            text = record.getMessage()
            if record.exc_info and record.exc_info[1]:
                text += f": {_shown(str(record.exc_info[1]))}"
            if text.startswith(malformed):
                refused(f"a request{text.removeprefix(malformed)}")
            else:
                log(text)

    logger = logging.getLogger("aiohttp.server")
    before = logger.level, logger.propagate
    handler = Handler()
    logger.addHandler(handler)
    # Malformed methods are told as details only, the other malformed requests as errors.
    logger.level, logger.propagate = logging.DEBUG, False
    try:
        yield
    finally:
        logger.removeHandler(handler)
        logger.level, logger.propagate = before
