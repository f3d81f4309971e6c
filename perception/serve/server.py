"""`perception serve`: runs the engine, the application and the socket until a signal stops them."""

from __future__ import annotations

import asyncio
import importlib.util
from collections.abc import Callable
from pathlib import Path
from typing import Any

from perception.errors import missing_extra
from perception.language.base import Encoder
from perception.progress import say
from perception.serve.engine import QueryEngine
from perception.serve.listening import check_address, listen, url_host
from perception.serve.requests import ServeSettings

MAX_CONNECTIONS = 256
MAX_WAITING = MAX_CONNECTIONS // 2  # largest number of connections whose next header is not complete
_TOTAL_TIMEOUT = 300.0  # seconds from a request's header to the end of its answer: 100 MB of points at 3 Mbit/s


def serve(
    path: Path,
    settings: ServeSettings,
    encoders: Callable[[str], Encoder | None] | None = None,
    build: Callable[[QueryEngine, ServeSettings], Any] | None = None,
    page: str = "",
) -> None:
    """Serves the map at `path` until SIGINT or SIGTERM; running requests are finished.

    build: makes the ASGI application, `app.build_app` when None; page: its path in the address that is printed.
    InputError when the map cannot be opened, the port is taken, others could reach it without a token, or the packages
    of the extra `serve` are missing. The address is written to standard error in one line once requests are accepted.
    """
    for package in ("fastapi", "uvicorn"):
        if importlib.util.find_spec(package) is None:
            raise missing_extra(package, "serve")
    import uvicorn

    check_address(settings.host, settings.port, settings.token)
    if build is None:
        from perception.serve.app import build_app

        build = build_app
    with (
        listen(settings.host, settings.port) as sock,
        QueryEngine(path, encoders=encoders, **settings.of_engine()) as engine,
    ):
        say(f"serving {path} at http://{url_host(settings.host)}:{sock.getsockname()[1]}{page} (Ctrl-C stops)")
        if (trouble := engine.current.problem) is not None:
            say(f"warning: prompts cannot be answered: {trouble}")
        config = uvicorn.Config(
            build(engine, settings),
            http=timed_protocol(settings.timeout, _TOTAL_TIMEOUT),
            proxy_headers=False,  # a client could forge them
            log_level="warning",
            server_header=False,
            limit_concurrency=MAX_CONNECTIONS,
            timeout_graceful_shutdown=max(1, round(settings.timeout)),
        )
        uvicorn.Server(config).run(sockets=[sock])


def timed_protocol(header: float, total: float) -> type[asyncio.Protocol]:
    """The protocol class for uvicorn's setting `http`, with the time-outs of connections that uvicorn lacks.

    header, total: seconds until the next header is complete, and for a whole request. Clients that send incomplete
    headers could occupy all connections: when more than MAX_WAITING wait for a header, the oldest is closed.
    """
    from uvicorn.protocols.http.h11_impl import H11Protocol

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
