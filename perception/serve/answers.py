"""The answers of the tools of `perception mcp`, as pydantic models: their JSON schemas are what clients read."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, Field

from perception.map.history import State

Vector = Annotated[list[float], Field(min_length=3, max_length=3)]


class Answer(BaseModel):
    map_id: str
    frame: str = Field(description="frame of all coordinates")
    metric: bool = Field(description="whether lengths are metres")
    unit: str
    confidence: float | None = Field(description="in [0, 1], of the first instance or the least sure; null: none found")


class Instance(BaseModel):
    """label: given by the user; names: guesses, best first; score: in [0, 1], for a text how well it matches, else that
    it is one thing; part, instances: what of it, or beside it, answers the text better; state: by the newest visit;
    last_seen, since: visits that saw it last, and first found it here or missed it; was: where it stood before; stood:
    what held a thing that is gone."""

    instance_id: int
    label: str | None
    names: list[str]
    score: float
    num_points: int
    centroid: Vector
    obb: dict[str, Any] = Field(description="center, rotation (its rows are the axes), extent (full side lengths)")
    distance: float | None = Field(None, description="from the point to the nearest point")
    part: int | None = None
    instances: list[int] = []
    state: State | None = None
    last_seen: int | None = None
    since: int | None = None
    was: Vector | None = None
    stood: dict[str, Any] | None = None


class InstancesAnswer(Answer):
    hits: list[Instance]
    gone: list[Instance] = Field([], description="what answers too and is not there any more, where it stood last")
    visits: list[dict[str, Any]] = Field([], description="number, time (UTC) of each visit, if there were several")


class ChangesAnswer(Answer):
    since: int = Field(description="the visit that today is compared with")
    changes: list[dict[str, Any]] = Field(
        description="of each thing: state (moved, removed, added, unchanged; unseen: nobody looked), instance_id, "
        "label, names, confidence, old_centroid, new_centroid, transform (new_from_old), last_seen (a visit); "
        "axis: its turn about this is not known"
    )
    visits: list[dict[str, Any]]


class DescribeAnswer(Answer, Instance):
    aabb: dict[str, Vector]
    colors: dict[str, float] = Field(description="shares by name")
    texts: list[str] = Field(description="printed on it")
    neighbors: list[dict[str, Any]] = Field(description="instance_id, label, gap between the nearest points")
    relations: list[dict[str, str]] = Field(description="of the scene graph: thing, relation (on, in, …), other")
    picture: Literal["photo", "render"] | None = Field(description="of what the picture is; null: there is none")
    note: str | None = Field(None, description="why the picture is no photo")


class MeasureAnswer(Answer):
    distance: float = Field(description="between the nearest points")
    center_distance: float
    nearest_points: list[Vector] = Field(description="one of a, one of b")


class PoseAnswer(Answer):
    position: Vector = Field(description="on the floor")
    yaw: float = Field(description="of x about z, radians")
    pose: list[list[float]] = Field(description="[4, 4] frame_from_robot: origin on the floor, x to the instance, z up")
    distance: float = Field(description="level, from the position to the nearest point")
    seen: float = Field(description="share of the lines of sight that nothing blocks")
