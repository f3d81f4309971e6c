"""The server's errors: every failure is one JSON object with a one-line message, {"error": line, "status": code}."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any

from fastapi import Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from starlette.exceptions import HTTPException

from perception.errors import InputError
from perception.query.bodies import problem_line
from perception.query.engine import AnswerTimeout, EngineBusy, EngineClosed
from perception.query.query_map import UnknownInstance

_log = logging.getLogger("perception.serve")


class OtherMap(Exception):
    """The client's map_id is not that of the current map."""


def problem(status: int, line: str, headers: Mapping[str, str] | None = None) -> JSONResponse:
    """An error response as JSON."""
    text = " ".join(line.encode("utf-8", "backslashreplace").decode().split())
    return JSONResponse({"error": text, "status": status}, status, headers)


async def answer_error(request: Request, error: Exception) -> JSONResponse:
    """The response to an exception that a handler raised."""
    if isinstance(error, UnknownInstance):
        return problem(404, str(error))
    if isinstance(error, InputError):
        return problem(400, str(error))
    if isinstance(error, RequestValidationError):
        return _bad_request(error)
    if isinstance(error, OtherMap):
        return problem(409, str(error))
    if isinstance(error, (EngineBusy, EngineClosed)):
        return problem(503, str(error), {"Retry-After": "1"})
    if isinstance(error, AnswerTimeout):
        return problem(504, str(error))
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


_OURS = (InputError, OtherMap, EngineBusy, EngineClosed, AnswerTimeout)
HANDLERS: dict[Any, Any] = dict.fromkeys((RequestValidationError, *_OURS, HTTPException, Exception), answer_error)
