"""`Request`, a prompt with its filters, and `Reply`, its answer."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from perception.errors import InputError
from perception.query.where import Frame, Where

if TYPE_CHECKING:
    from perception.query.hit import Hit
    from perception.query.query_map import QueryMap

MAX_TEXT = 1000
"""Largest number of characters in a prompt. No encoder reads more; the bound limits the work of a server."""
TOP, MAX_TOP = 20, 1000  # hits of a prompt: unless told otherwise, and at most
MAX_TEXTS = 32


@dataclass(frozen=True)
class Request:
    """One prompt with its filters; its coordinates and those of the reply are in `frame`, None = the map's."""

    text: str
    top_k: int = TOP
    min_score: float | None = None
    where: Where | None = None
    frame: Frame | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.text, str):
            raise InputError(f"query: the text is {type(self.text).__name__}, expected a text")
        if not self.text.strip():
            raise InputError('query: the text is empty; ask for a thing, such as "red mug"')
        if len(self.text) > MAX_TEXT:
            raise InputError(f"query: the text has {len(self.text)} characters, expected at most {MAX_TEXT}")
        if isinstance(self.top_k, bool) or not isinstance(self.top_k, (int, np.integer)):
            raise InputError(f"query: top_k is {self.top_k!r}, expected a whole number")
        if not 1 <= self.top_k <= MAX_TOP:
            raise InputError(f"query: top_k is {self.top_k}, expected at least 1 and at most {MAX_TOP}")
        score = self.min_score
        if score is not None and (isinstance(score, bool) or not isinstance(score, (int, float, np.number))):
            raise InputError(f"query: min_score is {score!r}, expected a number or none")
        if score is not None and not np.isfinite(score):
            raise InputError(f"query: min_score is {score}, expected a finite number")

    def answered(self, gmap: QueryMap, since: float) -> Reply:
        """The reply of one map; since: `time.monotonic()` when the request came."""
        hits = gmap.query(self.text, self.top_k, self.min_score, where=self.where, frame=self.frame)
        frame = self.frame.name if self.frame else gmap.frame
        return Reply(self, tuple(hits), gmap.map_id, frame, gmap.metric, time.monotonic() - since)


@dataclass(frozen=True)
class Reply:
    """The answer to a request, computed on the map map_id alone. seconds: from submission to answer."""

    request: Request
    hits: tuple[Hit, ...]
    map_id: str
    frame: str
    metric: bool
    seconds: float

    def to_json(self) -> dict[str, Any]:
        """An entry of `results` in the JSON output."""
        return {"text": self.request.text, "present": bool(self.hits), "hits": [hit.to_json() for hit in self.hits]}
