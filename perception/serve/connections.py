"""Time-outs of connections, which uvicorn lacks: until a request's header is complete, and for the whole request.

A client that opens connections and sends incomplete headers could occupy all allowed connections. So when more than
MAX_WAITING connections wait for a header, the one that has waited longest is closed.
"""

from __future__ import annotations

import asyncio
from collections import OrderedDict
from typing import Any

from uvicorn.protocols.http.h11_impl import H11Protocol

MAX_CONNECTIONS = 256
MAX_WAITING = MAX_CONNECTIONS // 2
"""Largest number of connections whose next header is not complete."""


class Connections:
    """The connections of a server, by their peer's address. header, total: seconds until the next header is complete,
    and for a whole request.

    `protocol_class` reports when connections open and close, `watched` when a request begins and ends: uvicorn calls
    the application after the header is complete.
    """

    def __init__(self, header: float, total: float) -> None:
        self._header, self._total = header, total
        self._timers: dict[Any, asyncio.TimerHandle] = {}
        self._transports: dict[Any, asyncio.Transport] = {}
        self._waiting: OrderedDict[Any, None] = OrderedDict()

    def protocol_class(self) -> type[asyncio.Protocol]:
        """The protocol class for uvicorn's setting `http`."""
        connections = self

        class Timed(H11Protocol):
            peer: Any = ()

            def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
                self.peer = tuple((transport.get_extra_info("peername") or ())[:2])  # as in scope["client"]
                connections._transports[self.peer] = transport
                connections._wait(self.peer)
                super().connection_made(transport)

            def connection_lost(self, exc: Exception | None) -> None:
                connections._transports.pop(self.peer, None)
                connections._start(self.peer, 0.0)
                super().connection_lost(exc)

        return Timed

    def watched(self, app: Any) -> Any:
        """The ASGI application `app`, wrapped to report each request."""

        async def watching(scope: Any, receive: Any, send: Any) -> None:
            peer = tuple(scope.get("client") or ())
            self._start(peer, self._total)
            try:
                await app(scope, receive, send)
            finally:
                self._wait(peer)

        return watching

    def _wait(self, peer: Any) -> None:
        self._start(peer, self._header)
        if peer in self._transports:
            self._waiting[peer] = None
            if len(self._waiting) > MAX_WAITING:
                self._abort(next(iter(self._waiting)))

    def _start(self, peer: Any, seconds: float) -> None:
        """Restarts the connection's timer; there is none for a connection that is closed."""
        self._waiting.pop(peer, None)
        if (timer := self._timers.pop(peer, None)) is not None:
            timer.cancel()
        if peer in self._transports:
            self._timers[peer] = asyncio.get_running_loop().call_later(seconds, self._abort, peer)

    def _abort(self, peer: Any) -> None:
        self._waiting.pop(peer, None)
        self._transports[peer].abort()
