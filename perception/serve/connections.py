"""Time-outs of connections, which uvicorn lacks: until a request's header is complete, and for the whole request.

A client that opens connections and sends incomplete headers could occupy all allowed connections. So when more than
MAX_WAITING connections wait for a header, the one that has waited longest is closed.
"""

from __future__ import annotations

import asyncio
from typing import Any

from uvicorn.protocols.http.h11_impl import H11Protocol

MAX_CONNECTIONS = 256
MAX_WAITING = MAX_CONNECTIONS // 2
"""Largest number of connections whose next header is not complete."""


def timed_protocol(header: float, total: float) -> type[asyncio.Protocol]:
    """The protocol class for uvicorn's setting `http`. header, total: seconds until the next header is complete, and
    for a whole request."""
    waiting: dict[asyncio.Protocol, None] = {}  # in the order in which they began to wait

    class Timed(H11Protocol):
        timer: asyncio.TimerHandle | None = None

        def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
            super().connection_made(transport)
            self._wait()

        def handle_events(self) -> None:
            before = self.cycle
            super().handle_events()
            if self.cycle is not before:  # a header is complete
                self._start(total)

        def on_response_complete(self) -> None:
            answered = self.cycle
            super().on_response_complete()
            if self.cycle is answered:  # else the next request had come already
                self._wait()

        def connection_lost(self, exc: Exception | None) -> None:
            self._stop()
            super().connection_lost(exc)

        def _wait(self) -> None:
            self._start(header)
            waiting[self] = None
            if len(waiting) > MAX_WAITING:
                oldest: Any = next(iter(waiting))
                del waiting[oldest]
                oldest.transport.abort()

        def _start(self, seconds: float) -> None:
            self._stop()
            self.timer = self.loop.call_later(seconds, self.transport.abort)

        def _stop(self) -> None:
            waiting.pop(self, None)
            if self.timer is not None:
                self.timer.cancel()

    return Timed
