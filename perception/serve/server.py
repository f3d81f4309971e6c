"""`perception serve`: runs the engine, the application and the socket until a signal stops them."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Callable
from pathlib import Path

from perception.errors import missing_extra
from perception.language.base import Encoder
from perception.listening import listen, url_host
from perception.query.engine import QueryEngine
from perception.serve.settings import ServeSettings

_TOTAL_TIMEOUT = 300.0
"""Seconds from a request's header to the end of its answer: 100 MB of points at 3 Mbit/s."""


def serve(
    path: Path,
    settings: ServeSettings,
    say: Callable[[str], None] | None = None,
    encoders: Callable[[str], Encoder | None] | None = None,
) -> None:
    """Serves the map at `path` until SIGINT or SIGTERM; running requests are finished.

    InputError when the map cannot be opened, the port is taken, or the packages of the extra `serve` are missing.
    say: called with the address in one line once requests are accepted; by default it writes to standard error.
    """
    for package in ("fastapi", "uvicorn"):
        if importlib.util.find_spec(package) is None:
            raise missing_extra(package, "serve")
    import uvicorn

    from perception.serve.app import build_app
    from perception.serve.connections import MAX_CONNECTIONS, timed_protocol

    with (
        listen(settings.host, settings.port) as sock,
        QueryEngine(
            path,
            workers=settings.workers,
            queue_size=settings.queue_size,
            timeout=settings.timeout,
            watch=settings.watch or None,
            encoders=encoders,
        ) as engine,
    ):
        (say or _say)(f"serving {path} at http://{url_host(settings.host)}:{sock.getsockname()[1]} (Ctrl-C stops)")
        if (trouble := engine.current.problem) is not None:
            (say or _say)(f"warning: prompts cannot be answered: {trouble}")
        config = uvicorn.Config(
            build_app(engine, settings),
            http=timed_protocol(settings.timeout, _TOTAL_TIMEOUT),
            proxy_headers=False,  # a client could forge them
            log_level="warning",
            lifespan="off",
            server_header=False,
            limit_concurrency=MAX_CONNECTIONS,
            timeout_graceful_shutdown=max(1, round(settings.timeout)),
        )
        uvicorn.Server(config).run(sockets=[sock])


def _say(line: str) -> None:
    sys.stderr.write(line + "\n")
    sys.stderr.flush()
