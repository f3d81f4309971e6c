"""Access control of the viewer: checks every HTTP request and websocket handshake before viser handles it.

viser accepts all of them. Three checks reject other clients: the Host header names this machine, a websocket's Origin
is the page that this server sent, and the browser sends the token (see `listening.Guard`). The token is in the printed
address and is kept as a cookie.
"""

from __future__ import annotations

import contextlib
import functools
import io
import re
import socket
import threading
from http import HTTPStatus
from typing import Any
from urllib.parse import parse_qs, quote, unquote

from perception.errors import InputError
from perception.serve.listening import Guard, is_local

_HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "X-Frame-Options": "DENY",
    # viser's page is one inline script that compiles WebAssembly and starts workers from blobs. Inline event handlers
    # (onerror=…) and connections to other servers are what injected HTML would need; the page itself needs neither.
    "Content-Security-Policy": "default-src 'none'; script-src 'unsafe-inline' 'unsafe-eval' blob: data:; "
    "script-src-attr 'none'; style-src 'unsafe-inline'; img-src 'self' data: blob:; font-src data:; "
    "worker-src blob: data:; connect-src 'self' ws://{host} wss://{host} data: blob:; "
    "frame-ancestors 'none'; base-uri 'none'; form-action 'none'",
}
_HOST = re.compile(r"([\w.-]+|\[[0-9a-fA-F:.]+\])(:\d{1,5})?", re.ASCII)
_patching = threading.Lock()


def refusal(guard: Guard, request: Any) -> Any:
    """The `websockets` Response that ends this request, or None when viser may answer it."""
    host, origins = _only(request, "Host") or "", request.headers.get_all("Origin")
    if not _HOST.fullmatch(host) or (is_local(guard.host) and not guard.names_this_machine(host)):
        return _answer(HTTPStatus.FORBIDDEN, "the Host header does not name this machine")
    if any(origin.partition("://")[2].lower() != host.lower() for origin in origins):
        return _answer(HTTPStatus.FORBIDDEN, "a page of another origin may not connect")
    cookie = f"perception_{host.rpartition(':')[2] if host[-1] != ']' and ':' in host else 80}"
    query = request.path.partition("?")[2]
    shown = parse_qs(query).get("token", [])
    if shown and guard.trusts(shown[0]):
        kept = f"{cookie}={quote(shown[0], safe='')}; HttpOnly; SameSite=Lax; Path=/"
        return _answer(HTTPStatus.SEE_OTHER, "", {"Location": "/", "Set-Cookie": kept})
    sent = [pair.strip().partition("=") for header in request.headers.get_all("Cookie") for pair in header.split(";")]
    if not any(guard.trusts(unquote(value)) for name, _, value in sent if name == cookie):
        return _answer(HTTPStatus.FORBIDDEN, "open the address with the token that perception view printed")
    if query:
        # viser's page connects to any server given by ?websocket=… and executes the messages from there.
        return _answer(HTTPStatus.SEE_OTHER, "", {"Location": "/"})
    return None


def _only(request: Any, name: str) -> str | None:
    """The value of a header that occurs exactly once, else None."""
    values = request.headers.get_all(name)
    return values[0] if len(values) == 1 else None


def _answer(status: HTTPStatus, line: str, headers: dict[str, str] | None = None) -> Any:
    from websockets.datastructures import Headers
    from websockets.http11 import Response

    body = (line + "\n").encode()
    fields = {"Content-Type": "text/plain; charset=utf-8", "Content-Length": str(len(body)), "Connection": "close"}
    return Response(status, status.phrase, Headers(**fields, **(headers or {})), body)


def guarded_server(guard: Guard, sock: socket.socket, **settings: Any) -> Any:
    """A viser.ViserServer that listens on `sock` and asks `guard` before it answers. settings: of ViserServer.

    viser 1.1 has no such hook. It starts its server by `websockets.asyncio.server.serve`, which has two documented
    arguments: `process_request` is called with each request before a handshake, and `sock` is the socket to listen on.
    This function is replaced while viser starts. Raises InputError when viser starts its server in another way.
    """
    import viser
    import websockets.asyncio.server as ws

    original, seen = ws.serve, threading.Event()

    @functools.wraps(original)
    def serve(handler: Any, host: Any, port: Any, *, process_request: Any = None, **rest: Any) -> Any:
        seen.set()

        def check(connection: Any, request: Any) -> Any:
            answer = refusal(guard, request)
            if answer is None and process_request is not None:
                answer = process_request(connection, request)
            for name, value in _HEADERS.items() if answer is not None else ():
                answer.headers[name] = value.format(host=_only(request, "Host") or "")
            return answer

        return original(handler, None, None, sock=sock, process_request=check, **rest)

    with _patching, contextlib.redirect_stdout(io.StringIO()):  # viser prints on stdout, which is reserved for --json
        ws.serve = serve  # type: ignore[assignment,misc]
        try:
            server = viser.ViserServer(**settings)
        finally:
            ws.serve = original  # type: ignore[misc]
        if not seen.is_set():
            server.stop()
            raise InputError(f"viser {viser.__version__}: its server cannot be guarded; install viser 1.1")
    return server
