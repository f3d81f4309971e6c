"""Conversion of prompts (plain text or JSON) into requests, and of errors into JSON."""

from __future__ import annotations

import json
from concurrent.futures import CancelledError
from dataclasses import dataclass
from typing import Any

from perception.errors import InputError
from perception.query import AnswerTimeout, EngineBusy, EngineClosed, Request
from perception.query.bodies import QueryBody, parse

MAX_BYTES = 64 * 1024
"""Largest prompt in bytes, JSON included; larger ones are rejected before parsing."""
_SHOWN = 80


@dataclass(frozen=True)
class Question:
    """One prompt. identity: an id chosen by the client, returned with the answer. points: the service returns points
    instead of the JSON."""

    request: Request
    identity: str | None = None
    points: bool = False


def read_questions(data: str) -> list[Question]:
    """The questions in a prompt: one for a plain text, one per text of a JSON object. InputError when malformed."""
    size = len(data.encode("utf-8", "surrogatepass"))
    if size > MAX_BYTES:
        raise InputError(f"prompt: has {size} bytes, expected at most {MAX_BYTES}")
    if not data.lstrip().startswith("{"):
        return [Question(Request(data))]
    try:
        value = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise InputError(f"prompt: begins like JSON but is none ({error})") from error
    identity, want = value.pop("id", None), value.pop("want", "hits")
    if identity is not None and not (isinstance(identity, str) and len(identity) <= 200):
        raise InputError("prompt: id is to be a text of at most 200 characters")
    if want not in ("hits", "points"):
        raise InputError(f"prompt: want is {str(want)[:_SHOWN]!r}, expected hits or points")
    return [Question(request, identity, want == "points") for request in parse(QueryBody, value).requests()]


def identity_of(data: str) -> str | None:
    """The id of a rejected prompt, when it can be parsed, so that the client can match the error; else None."""
    if len(data) > MAX_BYTES:
        return None
    try:
        identity = json.loads(data).get("id")
    except (ValueError, AttributeError, RecursionError):
        return None
    return identity if isinstance(identity, str) and len(identity) <= 200 else None


def error_json(error: BaseException, text: str, identity: str | None) -> dict[str, Any]:
    """The JSON that is sent instead of an answer; kind: bad_input, busy, timeout, closed or failed."""
    return {
        "id": identity,
        "text": text if len(text) <= _SHOWN else text[:_SHOWN] + "…",
        "error": {"kind": error_kind(error), "message": " ".join(str(error).split()) or type(error).__name__},
    }


def error_kind(error: BaseException) -> str:
    """bad_input: change the request; busy, timeout: retry later; closed: use another node; failed: a defect here."""
    kinds: tuple[tuple[type[BaseException], str], ...] = (
        (InputError, "bad_input"),
        (EngineBusy, "busy"),
        (AnswerTimeout, "timeout"),
        (EngineClosed, "closed"),
        (CancelledError, "timeout"),
    )
    return next((name for kind, name in kinds if isinstance(error, kind)), "failed")
