"""The checks before every request: host, token, content type, body size, and time to send the body; and the errors:
every failure is one JSON object with a one-line message, {"error": line, "status": code}.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Mapping
from typing import Any

from fastapi import Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from starlette.exceptions import HTTPException

from perception.serve.bodies import problem_line
from perception.serve.listening import Guard
from perception.serve.requests import KINDS, MAX_PICTURE, ServeSettings, error_kind, error_line

_log = logging.getLogger("perception.serve")
_STATUS = {"unknown_instance": 404, "other_map": 409, "busy": 503, "closed": 503, "timeout": 504}
_STATUS |= dict.fromkeys(("unknown_frame", "no_scale", "bad_input"), 400)
"""HTTP status by `error_kind`."""


def problem(status: int, line: str, headers: Mapping[str, str] | None = None) -> JSONResponse:
    return JSONResponse({"error": error_line(line), "status": status}, status, headers)


async def answer_error(request: Request, error: Exception) -> JSONResponse:
    """The response to an exception that a handler raised."""
    status = _STATUS.get(error_kind(error))
    if status is not None:
        return problem(status, str(error), {"Retry-After": "1"} if status == 503 else None)
    if isinstance(error, RequestValidationError):
        return _bad_request(error)
    if isinstance(error, HTTPException):
        if error.status_code == 400:
            return problem(400, "the request is no JSON")
        known = {
            404: f"{request.scope['path'][:200]}: no such page; see /openapi.json",
            405: f"{request.method} is not allowed",
        }
        return problem(error.status_code, known.get(error.status_code, error.detail), error.headers)
    _log.error("%s %s failed", request.method, request.scope["path"], exc_info=error)
    return problem(500, "the server failed on this request; its log says why")


def _bad_request(error: RequestValidationError) -> JSONResponse:
    first = error.errors()[0]
    if first["type"] == "json_invalid":
        return problem(400, f"the request is no JSON ({first['ctx']['error']})")
    if first["loc"] == ("body",) and first["type"] == "missing":
        return problem(400, "the request is empty, expected a JSON object")
    if first["loc"][0] == "path":
        return problem(404, f"instance {first['input'][:20]!r}: expected a whole number")
    return problem(400, problem_line(error.errors()))


HANDLERS: dict[Any, Any] = dict.fromkeys((RequestValidationError, *KINDS, HTTPException, Exception), answer_error)


OPEN = {"/openapi.json", "/health"}  # paths that need no token; without one, /health returns its status only
LARGER = {"/localise": MAX_PICTURE, "/mcp": MAX_PICTURE}  # paths whose requests hold pictures, and their largest
_MAX_DROPPED = 2 * MAX_PICTURE
_HEADERS = [
    (b"x-content-type-options", b"nosniff"),
    (b"cache-control", b"no-store"),
    (b"content-security-policy", b"default-src 'none'; frame-ancestors 'none'"),
]

Message = dict[str, Any]


class HttpGuard:
    """ASGI middleware. Sets scope["state"]["trusted"]: whether the client sent the token, or none is required.

    Without a token the Host header must name this machine, and a POST must have the JSON content type. Pages of other
    origins may send that only after a preflight request, which is never granted.
    """

    def __init__(self, app: Any, settings: ServeSettings) -> None:
        self.app, self.settings, self.guard = app, settings, Guard(settings.host, settings.token)

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        headers = {name.decode("latin-1").lower(): value.decode("latin-1") for name, value in scope["headers"]}
        kind, _, shown = headers.get("authorization", "").partition(" ")
        trusted = self.guard.trusts(shown.strip() if kind.lower() == "bearer" else "")
        scope.setdefault("state", {})["trusted"] = trusted
        refusal = self._refusal(scope, headers, trusted)
        if refusal is None and scope["method"] in ("POST", "PUT", "PATCH"):
            most = max(self.settings.max_body, LARGER.get(scope["path"], 0))
            refusal, receive = await self._body(receive, most)
        if refusal is not None:
            await refusal(scope, receive, _with_headers(send))
            return
        await self.app(scope, receive, _with_headers(send))

    def _refusal(self, scope: Any, headers: dict[str, str], trusted: bool) -> Any:
        name = headers.get("host", "")
        if self.guard.token is None and not self.guard.names_this_machine(name):
            return problem(403, f"Host '{name[:80]}' is not this machine; ask for 127.0.0.1 or localhost")
        if not trusted and scope["path"] not in OPEN:
            why = "the token is wrong" if "authorization" in headers else "a token is needed"
            return problem(401, f"{why}; send it as 'Authorization: Bearer TOKEN'", {"WWW-Authenticate": "Bearer"})
        if scope["method"] == "POST" and headers.get("content-type", "").split(";")[0].strip() != "application/json":
            found = headers.get("content-type", "none")[:80]
            return problem(415, f"Content-Type is '{found}', expected application/json")
        return None

    async def _body(self, receive: Any, most: int) -> tuple[Any, Any]:
        """Reads the body within its limits; (rejection, receive) or (None, a receive that returns the body again).

        An oversized body is read and dropped up to _MAX_DROPPED bytes, because a client that is still sending when the
        connection closes does not receive the response.
        """
        kept, size = bytearray(), 0
        deadline = time.monotonic() + self.settings.timeout
        more = True
        while more and size <= _MAX_DROPPED:
            try:
                message = await asyncio.wait_for(receive(), max(0.01, deadline - time.monotonic()))
            except (TimeoutError, asyncio.TimeoutError):
                reason = f"the request did not arrive within {self.settings.timeout:g} s"
                return problem(408, reason, {"Connection": "close"}), receive
            if message["type"] == "http.disconnect":
                return problem(400, "the request was cut short"), receive
            part = message.get("body", b"")
            size += len(part)
            if size <= most:
                kept += part
            more = bool(message.get("more_body"))
        if size > most:
            reason = f"the request has more than {most} bytes, the most that is read"
            return problem(413, reason, {"Connection": "close"}), receive
        return None, _replay(bytes(kept), receive)


def _replay(body: bytes, receive: Any) -> Any:
    """A `receive` that returns the whole body first."""
    waiting = [{"type": "http.request", "body": body, "more_body": False}]

    async def again() -> Message:
        return waiting.pop() if waiting else await receive()

    return again


def _with_headers(send: Any) -> Any:
    async def sending(message: Message) -> None:
        if message["type"] == "http.response.start":
            message = {**message, "headers": [*message.get("headers", []), *_HEADERS]}
        await send(message)

    return sending
