"""The server's answers as pydantic models. The OpenAPI document is made from them; tests check answers with them."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

Count = Annotated[int, Field(ge=0)]
Share = Annotated[float, Field(ge=0, le=1)]
Point = Annotated[list[float], Field(min_length=3, max_length=3)]
Rows = Annotated[list[Point], Field(min_length=3, max_length=3)]


class Answer(BaseModel):
    """No fields but these; a key that may be missing has the default None here and is never null in an answer."""

    model_config = ConfigDict(extra="forbid")


class Problem(Answer):
    """One clear line."""

    error: str
    status: int


class Box(Answer):
    """Rows of `rotation` are the box's axes; `extent` are full side lengths."""

    center: Point
    rotation: Rows
    extent: Point


class Corners(Answer):
    min: Point
    max: Point


class Hit(Answer):
    instance_id: Count
    score: Share
    num_points: Count
    centroid: Point
    obb: Box
    label: str | None
    views: list[str]
    covariance: Rows
    distance: float = Field(default=0.0, description="only with `near`")


class Source(Answer):
    """The one map that made the answer."""

    frame: str
    metric: bool
    map_id: str


class Hits(Source):
    hits: list[Hit]


class Result(Answer):
    text: str
    present: bool
    hits: list[Hit]


class Results(Source):
    results: list[Result]


class Color(Answer):
    name: str
    share: float


class Neighbor(Answer):
    instance_id: Count
    label: str | None
    gap: float


class Description(Hit, Source):
    confidence: float
    aabb: Corners
    colors: list[Color]
    neighbors: list[Neighbor]


class Reload(Answer):
    changed: bool
    map_id: str


class Health(BaseModel):
    """More with the token: counts, queue, latency."""

    status: Literal["ok", "degraded", "closed"]
    problem: str | None = None
    map_id: str = ""
