"""Shapes of JSON files, checked when they are read: kinds of values, and a check that names the wrong key.

A shape is {key: shape}, where a key with "?" may be missing, [shape] for a list, or a type. Keys that are not named are
kept as they are.
"""

from __future__ import annotations

import json
import re
from datetime import datetime
from functools import cache
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from annotated_types import Len
from pydantic import AfterValidator, ConfigDict, Field, TypeAdapter, ValidationError, with_config
from pydantic_core import from_json
from typing_extensions import NotRequired, TypedDict

from perception.geometry import check_similarity, scale_of
from perception.io.documents import brief, what_is_wrong

LARGEST = 2**31 - 1
"""Of ids and counts: they are int32 in arrays and clouds."""
FARTHEST = 1e15
"""Of numbers, so that products of a few stay finite."""


def parsed(raw: bytes) -> Any:
    """The value of JSON that this package writes; ValueError for anything else, NaN, and nesting beyond 200 levels.
    Unpaired surrogates, which stand for the bytes of paths that are no UTF-8, are kept."""
    try:
        return from_json(raw, allow_inf_nan=False)
    except ValueError:
        from_json(re.sub(rb"\\(u[dD][89a-fA-F]..|.)", b"?", raw), allow_inf_nan=False)  # all is well but surrogates
        return json.loads(raw)


# ------------------------------------------------------------------ values


def _path(value: Any) -> str:
    if not isinstance(value, str) or "\0" in value:
        raise ValueError("expected a path")
    return value


def _text(value: str) -> str:
    if not value.isprintable() and re.search(r"[\ud800-\udfff]", value):
        raise ValueError("expected text, found half of a surrogate pair")
    return value


def _plain_name(value: str) -> str:
    if Path(value).name != value or "\0" in value:
        raise ValueError("expected the name of a file")
    return value


def _photo_name(value: Any) -> str:
    if (wrong := what_is_wrong(value)) is not None:
        raise ValueError(f"the photo name {wrong}, expected a relative path inside the photo folder")
    return str(value)


def _moment(value: str) -> str:
    try:
        datetime.strptime(value, "%Y-%m-%dT%H:%M:%SZ")
    except ValueError:
        raise ValueError("expected a time in UTC such as 2026-11-25T19:41:58Z") from None
    return value


def _similarity(value: list[list[float]]) -> list[list[float]]:
    check_similarity(value, "the matrix")
    return value


def _pose(value: list[list[float]]) -> list[list[float]]:
    if abs(scale_of(check_similarity(value, "the pose")) - 1) > 1e-3:
        raise ValueError("expected a rigid transform")
    return value


def _intrinsics(value: list[list[float]]) -> list[list[float]]:
    if not (value[0][0] > 0 and value[1][1] > 0 and value[1][0] == 0 and value[2] == [0, 0, 1]):
        raise ValueError("expected focal lengths above 0 and a last row 0 0 1")
    return value


def _direction(value: list[float]) -> list[float]:
    if abs(np.linalg.norm(value) - 1) > 1e-3:
        raise ValueError("expected a vector of length 1")
    return value


Count = Annotated[int, Field(ge=0, le=LARGEST)]
Bytes = Annotated[int, Field(ge=0, le=2**63 - 1)]
Side = Annotated[int, Field(ge=1, le=1 << 20)]
Number = Annotated[float, Field(ge=-FARTHEST, le=FARTHEST)]
Length = Annotated[float, Field(ge=0, le=FARTHEST)]
Positive = Annotated[float, Field(gt=0, le=FARTHEST)]
Share = Annotated[float, Field(ge=0, le=1)]
Text = Annotated[str, AfterValidator(_text)]
Moment = Annotated[str, AfterValidator(_moment)]
PathText = Annotated[Any, AfterValidator(_path)]
FileName = Annotated[str, AfterValidator(_plain_name)]
PhotoName = Annotated[Any, AfterValidator(_photo_name)]
Point = Annotated[list[Number], Len(3, 3)]
Sides = Annotated[list[Length], Len(3, 3)]
Direction = Annotated[Point, AfterValidator(_direction)]
Matrix3 = Annotated[list[Point], Len(3, 3)]
Intrinsics = Annotated[Matrix3, AfterValidator(_intrinsics)]
Matrix4 = Annotated[list[Annotated[list[Number], Len(4, 4)]], Len(4, 4)]
Similarity = Annotated[Matrix4, AfterValidator(_similarity)]
Pose = Annotated[Matrix4, AfterValidator(_pose)]


def typed(shape: Any) -> Any:
    """The type that a shape below describes: {key: shape}, a key with "?" may be missing; [shape]: a list; or a type.
    Typed dictionaries are checked several times faster than models, and a map has many instances."""
    if isinstance(shape, list):
        return list[typed(shape[0])]  # type: ignore[misc]
    if not isinstance(shape, dict):
        return shape
    keys = {key.rstrip("?"): NotRequired[typed(of)] if key[-1] == "?" else typed(of) for key, of in shape.items()}
    config = ConfigDict(extra="allow", strict=True, allow_inf_nan=False)
    return with_config(config)(TypedDict("Entry", keys))  # type: ignore[misc,operator]


@cache
def _adapter(model: Any) -> TypeAdapter[Any]:
    return TypeAdapter(model)


def check(model: Any, value: Any, at: str = "") -> None:
    """ValueError naming the first key of `value` that does not fit `model`, what was found and what is expected.
    at: where in its file `value` is."""
    try:
        _adapter(model).validate_python(value)
    except ValidationError as error:
        first = error.errors(include_url=False, include_context=False)[0]
        key = (at + "".join(f"[{n}]" if isinstance(n, int) else f".{n}" for n in first["loc"])).lstrip(".")
        what = first["msg"].removeprefix("Value error, ").replace("Input should be", "expected")
        found = "" if first["type"] == "missing" else f", found {brief(first['input'])}"
        raise ValueError(f"{key[:200]}: {what[:300]}{found}") from None
