"""Shapes of JSON files (`typed`), checked when they are read: kinds of values, and a check that names the wrong key."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
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

LARGEST = 2**31 - 1  # of ids and counts: they are int32 in arrays and clouds
FARTHEST = 1e15  # of numbers, so that products of a few stay finite


def parsed(raw: bytes) -> Any:
    """The value of JSON that this package writes; ValueError for anything else, NaN, and nesting beyond 200 levels.
    Unpaired surrogates, which stand for the bytes of paths that are no UTF-8, are kept."""
    try:
        return from_json(raw, allow_inf_nan=False)
    except ValueError:
        from_json(re.sub(rb"\\(u[dD][89a-fA-F]..|.)", b"?", raw), allow_inf_nan=False)  # all is well but surrogates
        return json.loads(raw)


# ------------------------------------------------------------------ values


def _expecting(what: str, good: Callable[[Any], object]) -> AfterValidator:
    """A check that a value is `good`; what: its kind, for the message."""

    def checked(value: Any) -> Any:
        if not good(value):
            raise ValueError(f"expected {what}")
        return value

    return AfterValidator(checked)


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


def _is_intrinsics(K: list[list[float]]) -> bool:
    return K[0][0] > 0 and K[1][1] > 0 and K[1][0] == 0 and K[2] == [0, 0, 1]


Count = Annotated[int, Field(ge=0, le=LARGEST)]
Bytes = Annotated[int, Field(ge=0, le=2**63 - 1)]
Side = Annotated[int, Field(ge=1, le=1 << 20)]
Number = Annotated[float, Field(ge=-FARTHEST, le=FARTHEST)]
Length = Annotated[float, Field(ge=0, le=FARTHEST)]
Positive = Annotated[float, Field(gt=0, le=FARTHEST)]
Share = Annotated[float, Field(ge=0, le=1)]
_SURROGATE = re.compile(r"[\ud800-\udfff]")
Text = Annotated[str, _expecting("text, found half of a surrogate pair", lambda text: not _SURROGATE.search(text))]
Moment = Annotated[str, AfterValidator(_moment)]
PathText = Annotated[Any, _expecting("a path", lambda value: isinstance(value, str) and "\0" not in value)]
FileName = Annotated[str, _expecting("the name of a file", lambda name: Path(name).name == name and "\0" not in name)]
PhotoName = Annotated[Any, AfterValidator(_photo_name)]
Point = Annotated[list[Number], Len(3, 3)]
Sides = Annotated[list[Length], Len(3, 3)]
Direction = Annotated[Point, _expecting("a vector of length 1", lambda v: abs(np.linalg.norm(v) - 1) <= 1e-3)]
Matrix3 = Annotated[list[Point], Len(3, 3)]
Intrinsics = Annotated[Matrix3, _expecting("focal lengths above 0 and a last row 0 0 1", _is_intrinsics)]
Matrix4 = Annotated[list[Annotated[list[Number], Len(4, 4)]], Len(4, 4)]
Similarity = Annotated[Matrix4, AfterValidator(lambda value: check_similarity(value, "the matrix"))]
Pose = Annotated[Similarity, _expecting("a rigid transform", lambda matrix: abs(scale_of(matrix) - 1) <= 1e-3)]


def typed(shape: Any) -> Any:
    """The type that a shape describes: {key: shape}, where a key with "?" may be missing and others are kept as they
    are; [shape]: a list; or a type. Typed dictionaries are checked several times faster than models, and a map has many
    instances."""
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
