"""What all servers share: settings, errors and their kinds, `Request` and its answer `Reply`."""

from __future__ import annotations

from concurrent.futures import CancelledError
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import Field

from perception.config import Settings
from perception.errors import InputError
from perception.geometry import scale_of
from perception.query import Frame, Hit, QueryMap, Where
from perception.query.hit import answer_json
from perception.query.requests import TOP, UnknownInstance, check_prompt

MAX_TEXTS = 32
MAX_BYTES = 64 << 10  # largest request in bytes, JSON included; larger ones are rejected before parsing
MAX_PICTURE = 8 << 20  # largest request with a picture in it, which base64 makes a third longer


class EngineSettings(Settings):
    """The settings of a `QueryEngine`, and so of every server."""

    workers: int = Field(2, ge=1, le=64, description="queries answered at the same time")
    queue_size: int = Field(64, ge=1, le=10_000, description="requests that may wait; more are refused")
    timeout: float = Field(10.0, ge=1e-3, le=3600, description="seconds until a request is given up")
    watch: float | None = Field(1.0, ge=0, le=3600, description="seconds between two looks for a new map; 0: never")

    def of_engine(self) -> dict[str, Any]:
        """The engine's own fields by name, for `QueryEngine(path, **…)`."""
        return {name: getattr(self, name) for name in EngineSettings.model_fields}


class ServeSettings(EngineSettings):
    """How one process serves one map over HTTP. `serve` checks host and token."""

    host: str = Field("127.0.0.1", description="where to listen")
    port: int = Field(8765, ge=0, le=65535, description="0: any free one")
    token: str | None = Field(None, description="clients send it as a bearer token; none only on this machine")
    max_body: int = Field(MAX_BYTES, ge=1, description="bytes of a request without a picture")
    photos: Path | None = Field(None, description="folder where the map's photos may be read beside its own")


class OtherMap(InputError):
    """The client's map_id is not that of the current map."""


class UnknownFrame(InputError):
    """No frame of this name is known."""


class NoScale(InputError):
    """Metres were asked of a map whose scale is not known."""


class EngineBusy(RuntimeError):
    """The request queue is full: retry later, or use another server.

    >>> error_kind(EngineBusy("64 questions are waiting already; ask again later"))
    'busy'
    """


class AnswerTimeout(TimeoutError):
    """No answer within the time-out; a request that had not started is dropped.

    >>> error_kind(AnswerTimeout("no answer within 10 s"))
    'timeout'
    """


class EngineClosed(RuntimeError):
    """The engine has been closed.

    >>> error_kind(EngineClosed("kitchen.gsmap: the engine has been closed"))
    'closed'
    """


KINDS: dict[type[BaseException], str] = {
    UnknownInstance: "unknown_instance",  # these four are InputErrors too, so they come before
    OtherMap: "other_map",
    UnknownFrame: "unknown_frame",
    NoScale: "no_scale",
    InputError: "bad_input",
    EngineBusy: "busy",
    TimeoutError: "timeout",
    CancelledError: "timeout",
    EngineClosed: "closed",
}


def error_kind(error: BaseException) -> str:
    """The kind of an error. unknown_instance, other_map: ask again for ids; unknown_frame, no_scale, bad_input: change
    the request; busy, timeout: retry later; closed: use another server; failed: a defect here."""
    return next((kind for known, kind in KINDS.items() if isinstance(error, known)), "failed")


def error_line(error: BaseException | str) -> str:
    """An error's message as one line of valid Unicode."""
    return " ".join(str(error).encode("utf-8", "backslashreplace").decode().split()) or type(error).__name__


def error_json(error: BaseException) -> dict[str, str]:
    """An error in the JSON of a message; HTTP has a status instead of the kind."""
    return {"kind": error_kind(error), "message": error_line(error)}


def source(gmap: QueryMap, frame: Frame | None = None) -> dict[str, Any]:
    """The facts of the map in every answer: the frame of its coordinates, whether they are metres (not in a frame that
    scales those of the map), the map's id. Frame and metres of a store's answer are None, and are given with each hit.
    """
    metric = gmap.metric and (frame is None or abs(scale_of(frame.from_map) - 1) < 1e-6)
    return {"frame": frame.name if frame else gmap.frame, "metric": metric, "map_id": gmap.map_id}


@dataclass(frozen=True)
class Request:
    """One prompt with its filters; its coordinates and those of the reply are in `frame`, None = the map's. at: the
    visit as of which it is answered, None = today.

    InputError for an empty or overlong text, and for numbers out of range.

    >>> Request("red mug", top_k=1, where=Where(max_size=0.6)).text
    'red mug'
    """

    text: str
    top_k: int = TOP
    min_score: float | None = None
    where: Where | None = None
    frame: Frame | None = None
    at: int | None = None

    def __post_init__(self) -> None:
        check_prompt(self.text, self.top_k, self.min_score)

    def answered(self, gmap: QueryMap) -> Reply:
        """The reply of one map."""
        gmap = gmap if self.at is None else gmap.at(self.at)
        hits, gone = (
            tuple(ask(self.text, self.top_k, self.min_score, where=self.where, frame=self.frame))
            for ask in (gmap.query, gmap.gone)
        )
        return Reply(self, hits, **source(gmap, self.frame), gone=gone)


@dataclass(frozen=True)
class Reply:
    """The answer to a request, computed on the map map_id alone. gone: of `QueryMap.gone`. A store's frame and metric
    are None.

    >>> reply = Request("red mug").answered(perception.load_map("kitchen.gsmap"))
    >>> reply.to_json()["present"], reply.frame, reply.metric
    (True, 'map', True)
    """

    request: Request
    hits: tuple[Hit, ...]
    map_id: str
    frame: str
    metric: bool
    gone: tuple[Hit, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """An entry of `results` in the JSON output."""
        return answer_json(self.request.text, self.hits, self.gone)
