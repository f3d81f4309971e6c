"""The JSON request bodies of the HTTP server and the ROS node as pydantic models, and their conversion to query types.

Numbers are finite and at most MAX_NUMBER in absolute value, so that squares and products of lengths stay finite. Texts
are Unicode without lone surrogates. A field that is null counts as absent.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any, TypeVar

import numpy as np
from pydantic import BaseModel, ConfigDict, Discriminator, Field, Tag, ValidationError

from perception.errors import InputError
from perception.query.requests import MAX_TEXT, MAX_TOP, TOP
from perception.query.where import Frame, Where, axis_box
from perception.serve.requests import MAX_TEXTS, Request
from perception.types import OrientedBox

MAX_NUMBER = 1e12  # largest absolute value of a number; it exceeds every coordinate on the earth in millimetres

Number = Annotated[float, Field(ge=-MAX_NUMBER, le=MAX_NUMBER)]
Length = Annotated[float, Field(ge=0, le=MAX_NUMBER)]
Point = Annotated[list[Number], Field(min_length=3, max_length=3)]
Rotation = Annotated[list[Point], Field(min_length=3, max_length=3)]
Matrix = Annotated[list[Annotated[list[Number], Field(min_length=4, max_length=4)]], Field(min_length=4, max_length=4)]
Text = Annotated[str, Field(max_length=MAX_TEXT)]  # with a bound, pydantic also rejects lone surrogates
Visit = Annotated[int, Field(ge=0, lt=10**9)]
Prompt = Annotated[str, Field(min_length=1, max_length=MAX_TEXT)]


# The union member that a value belongs to, so that a validation error names that member only.
_LIST_OR_NESTED = Discriminator(
    lambda value: "nested" if isinstance(value, list) and value and isinstance(value[0], list) else "list"
)
_SINGLE_OR_LIST = Discriminator(lambda value: "list" if isinstance(value, list) else "single")
PointOrPose = Annotated[Annotated[Point, Tag("list")] | Annotated[Matrix, Tag("nested")], _LIST_OR_NESTED]
"""A point [3], or a pose [4, 4] of which only the origin is used."""
Prompts = Annotated[
    Annotated[Prompt, Tag("single")] | Annotated[list[Prompt], Field(min_length=1, max_length=MAX_TEXTS), Tag("list")],
    _SINGLE_OR_LIST,
]
Labels = Annotated[Annotated[Text, Tag("single")] | Annotated[list[Text], Tag("list")], _SINGLE_OR_LIST]


class Body(BaseModel):
    """No further fields, no conversions, no NaN and no infinity."""

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)


class CornersBody(Body):
    """A box along the axes, by its lowest and highest corner."""

    min: Point
    max: Point

    def region(self) -> OrientedBox:
        return axis_box(self.min, self.max)


class BoxBody(Body):
    """A box of any orientation: the rows of `rotation` are its axes, `extent` its full side lengths."""

    center: Point
    extent: Annotated[list[Length], Field(min_length=3, max_length=3)]
    rotation: Rotation | None = None

    def region(self) -> OrientedBox:
        rotation = np.eye(3) if self.rotation is None else np.array(self.rotation)
        return OrientedBox(np.array(self.center), rotation, np.array(self.extent))


AnyRegion = Annotated[
    Annotated[CornersBody, Tag("corners")] | Annotated[BoxBody, Tag("box")],
    Discriminator(
        lambda value: "box" if isinstance(value, dict) and value.keys() & {"center", "extent"} else "corners"
    ),
]


class WhereBody(Body):
    """The fields of `perception.query.Where`."""

    region: AnyRegion | None = None
    share: Annotated[float, Field(gt=0, le=1)] | None = None
    near: PointOrPose | None = None
    within: Length | None = None
    min_size: Length | None = None
    max_size: Length | None = None
    labels: Labels | None = None

    def where(self) -> Where:
        """The filter; InputError when fields do not fit together, such as `within` without `near`."""
        region = None if self.region is None else self.region.region()
        share = 0.5 if self.share is None else self.share
        near = None if self.near is None else np.array(self.near)
        return Where(region, share, near, self.within, self.min_size, self.max_size, self.labels)


class FrameBody(Body):
    """A frame's name and its transform frame_from_map: a rotation, a scale and a translation."""

    name: Prompt
    from_map: Matrix

    def frame(self) -> Frame:
        return Frame(self.name, np.array(self.from_map))


class FramedBody(Body):
    """What all questions share: the frame that question and answer are in, and the visit as of which it is answered."""

    frame: FrameBody | None = None
    at: Visit | None = None

    def query_frame(self) -> Frame | None:
        return None if self.frame is None else self.frame.frame()


class FilteredBody(FramedBody):
    """A question with a filter."""

    where: WhereBody | None = None

    def query_where(self) -> Where | None:
        return None if self.where is None else self.where.where()


class QueryBody(FilteredBody):
    """One prompt or several."""

    text: Prompts
    top_k: Annotated[int, Field(ge=1, le=MAX_TOP)] | None = None
    min_score: Number | None = None

    def requests(self) -> list[Request]:
        """One Request for each prompt."""
        texts = self.text if isinstance(self.text, list) else [self.text]
        where, frame, top_k = self.query_where(), self.query_frame(), self.top_k or TOP
        return [Request(text, top_k, self.min_score, where, frame, self.at) for text in texts]


class FindBody(FilteredBody):
    """All instances that fulfil a filter."""


class NearestBody(FilteredBody):
    """The instances nearest to a point, or to the origin of a pose."""

    near: PointOrPose
    top_k: Annotated[int, Field(ge=1, le=MAX_TOP)] | None = None


class AtBody(FramedBody):
    """The instance that a point lies on."""

    point: Point
    max_distance: Length | None = None


Model = TypeVar("Model", bound=Body)


def parse(model: type[Model], value: Any) -> Model:
    """Validates the decoded JSON `value` as `model`; raises InputError with a one-line message when it does not fit."""
    try:
        return model.model_validate(value)
    except ValidationError as error:
        raise InputError(problem_line(error.errors())) from error


def problem_line(errors: Sequence[Any]) -> str:
    """One of pydantic's errors as a line: field, expected, found. An unknown field takes precedence."""
    first = next((error for error in errors if error["type"] == "extra_forbidden"), errors[0])
    tags = {"body", "query", "list", "nested", "single", "corners", "box"}
    field = ".".join(str(part) for part in first["loc"] if part not in tags)
    expected = str(first["msg"]).removeprefix("Value error, ")
    return f"{field[:80] or 'request'}: {expected[0].lower()}{expected[1:]}, found {repr(first.get('input'))[:60]}"
