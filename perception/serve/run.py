"""`perception serve`: the engine, the application and the socket, together until told to stop."""

from __future__ import annotations

import errno
import importlib.util
import socket
import sys
from collections.abc import Callable
from pathlib import Path

from perception.errors import InputError, missing_extra
from perception.language.base import Encoder
from perception.query.engine import QueryEngine
from perception.serve.settings import ServeSettings

_MOST_CONNECTIONS = 256


def serve(
    path: Path,
    settings: ServeSettings,
    say: Callable[[str], None] | None = None,
    encoders: Callable[[str], Encoder | None] | None = None,
) -> None:
    """Serves the map at `path` until SIGINT or SIGTERM, finishing what is being answered.

    InputError when the map cannot be opened, the port is taken, or the packages of the extra `serve` are missing.
    say: told the address in one line once requests are accepted; by default standard error.
    """
    for package in ("starlette", "uvicorn"):
        if importlib.util.find_spec(package) is None:
            raise missing_extra(package, "serve")
    import uvicorn

    from perception.serve.app import build_app

    with (
        listening(settings) as sock,
        QueryEngine(
            path,
            workers=settings.workers,
            queue_size=settings.queue_size,
            timeout=settings.timeout,
            watch=settings.watch or None,
            encoders=encoders,
        ) as engine,
    ):
        host = f"[{settings.host}]" if ":" in settings.host else settings.host
        (say or _say)(f"serving {path} at http://{host}:{sock.getsockname()[1]} (Ctrl-C stops)")
        if (trouble := engine.current.problem) is not None:
            (say or _say)(f"warning: prompts cannot be answered: {trouble}")
        config = uvicorn.Config(
            build_app(engine, settings),
            log_level="warning",
            lifespan="off",
            server_header=False,
            limit_concurrency=_MOST_CONNECTIONS,
            timeout_graceful_shutdown=max(1, round(settings.timeout)),
        )
        uvicorn.Server(config).run(sockets=[sock])


def listening(settings: ServeSettings) -> socket.socket:
    """A socket bound and listening, so that a taken port is told before the map is opened."""
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(
            settings.host, settings.port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
    except OSError as error:
        raise InputError(f"--host {settings.host}: is no address of this machine ({error.strerror})") from error
    sock = socket.socket(family, kind, protocol)
    try:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # a restart must not wait for old connections
        sock.bind(address)
        sock.listen(_MOST_CONNECTIONS)
    except OSError as error:
        sock.close()
        raise InputError(_why(error, settings)) from error
    return sock


def _why(error: OSError, settings: ServeSettings) -> str:
    if error.errno == errno.EADDRINUSE:
        return f"--port {settings.port}: is in use on {settings.host}; stop that server or choose another port"
    if error.errno == errno.EADDRNOTAVAIL:
        return f"--host {settings.host}: is no address of this machine"
    return f"--host {settings.host} --port {settings.port}: cannot listen there ({error.strerror})"


def _say(line: str) -> None:
    sys.stderr.write(line + "\n")
    sys.stderr.flush()
