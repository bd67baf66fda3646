"""Who has connected and not become a page: few at a time, and none for long.

The server underneath waits for a request as long as it takes, so that somebody who opens thousands of
connections, or sends a byte every minute, would take every file descriptor of the process.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any

#: Connections that may be without a page at a time. One more closes the oldest, so that a flood keeps
#: nobody out: an honest request is answered within milliseconds.
MOST = 64
#: s that a connection may last without becoming a page; the whole page loads in less, also far away.
PATIENCE = 30.0


class Door:
    """Makes the protocol of each new connection with ``serve``; ``refused`` hears whom it closed, and why."""

    def __init__(self, serve: Callable[[], Any], refused: Callable[[str], None]) -> None:
        self._serve = serve
        self._refused = refused
        self._waiting: dict[asyncio.BaseTransport, asyncio.TimerHandle] = {}
        self._answered: set[asyncio.BaseTransport] = set()

    def newcomer(self) -> asyncio.Protocol:
        """The protocol factory of a server."""
        return _Newcomer(self._serve(), self._enter)

    def answered(self, transport: asyncio.BaseTransport) -> None:
        """A whole request has come: when its time is over, the connection closes without a word."""
        if transport in self._waiting:
            self._answered.add(transport)

    def settled(self, transport: asyncio.BaseTransport) -> None:
        """The connection has become a page, which may stay."""
        if timer := self._waiting.pop(transport, None):
            timer.cancel()
        self._answered.discard(transport)

    def _enter(self, transport: asyncio.Transport) -> None:
        for other in [other for other in self._waiting if other.is_closing()]:
            self.settled(other)
        if len(self._waiting) >= MOST:
            self._expel(next(iter(self._waiting)), f"more than {MOST} at a time")
        loop = asyncio.get_running_loop()
        self._waiting[transport] = loop.call_later(
            PATIENCE, self._expel, transport, f"no page after {PATIENCE:.0f} s"
        )

    def _expel(self, transport: Any, why: str) -> None:
        answered = transport in self._answered
        self.settled(transport)
        if transport.is_closing():
            return
        if not answered:
            name = transport.get_extra_info("peername")
            self._refused(f"a connection from {name[0] if name else '?'}: {why}")
        transport.abort()


class _Newcomer(asyncio.Protocol):
    """Announces the connection, then leaves it to ``protocol``."""

    def __init__(self, protocol: asyncio.Protocol, enter: Callable[[asyncio.Transport], None]) -> None:
        self._protocol = protocol
        self._enter = enter

    def connection_made(self, transport: Any) -> None:
        self._enter(transport)
        transport.set_protocol(self._protocol)
        self._protocol.connection_made(transport)
