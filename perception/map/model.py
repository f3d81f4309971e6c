"""What a map's files may hold: all of map.json, instances.json, store.json and the archives is checked here when it is
read. Ids and counts are 0 … 2³¹ − 1. Keys that are not named here are kept as they are.
"""

from __future__ import annotations

import json
import re
from functools import cache
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from annotated_types import Len
from pydantic import AfterValidator, ConfigDict, Field, Strict, TypeAdapter, ValidationError, with_config
from pydantic_core import from_json
from typing_extensions import NotRequired, TypedDict

from perception.geometry import check_similarity, scale_of
from perception.io.documents import brief, what_is_wrong

LARGEST = 2**31 - 1
"""Of ids and counts: they are int32 in arrays and clouds."""
FARTHEST = 1e15
"""Of numbers, so that products of a few stay finite."""
MOST_PIXELS = 4 * 10**8
"""Of a view: no photo with more is read."""
PREFIX = "language_"
"""Of the arrays of parts.npz and groups.npz that correspond to those of language.npz."""
Arrays = dict[str, np.ndarray]


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


def _pixels(view: dict[str, Any]) -> dict[str, Any]:
    if view["width"] * view["height"] > MOST_PIXELS:
        raise ValueError(f"expected at most {MOST_PIXELS} pixels")
    return view


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


def _typed(shape: Any) -> Any:
    """The type that a shape below describes: {key: shape}, a key with "?" may be missing; [shape]: a list; or a type.
    Typed dictionaries are checked several times faster than models, and a map has many instances."""
    if isinstance(shape, list):
        return list[_typed(shape[0])]  # type: ignore[misc]
    if not isinstance(shape, dict):
        return shape
    keys = {key.rstrip("?"): NotRequired[_typed(of)] if key[-1] == "?" else _typed(of) for key, of in shape.items()}
    config = ConfigDict(extra="allow", strict=True, allow_inf_nan=False)
    return with_config(config)(TypedDict("Entry", keys))  # type: ignore[misc,operator]


_LENS = Annotated[tuple[Text, list[Number], Side, Side], Strict(False)]
_DEPTH = Annotated[tuple[PathText, Positive, _LENS | None], Strict(False)]
_GAIN = Annotated[list[Annotated[float, Field(gt=0, lt=1e3)]], Len(3, 3)]
_VIEW = {
    "name": PhotoName, "photo": PathText, "K": Intrinsics, "width": Side, "height": Side, "camera_from_world": Pose,
    "lens?": _LENS | None, "held_out?": bool, "photo_beside?": PathText | None, "photo_bytes?": Bytes | None,
    "depth?": _DEPTH | None, "mask?": PathText | None, "gain?": _GAIN | None,
}  # fmt: skip
_QUALITY = {
    "psnr?": Number | None, "ssim?": Number | None,
    "views?": dict[str, _typed({"psnr": Number | None, "ssim": Number | None})],  # type: ignore[misc]
    "depth?": {"unit": Text, "median": Number, "tolerance": Number, "close": Number},
}  # fmt: skip
_TRAINING = {
    "iterations?": Count, "seconds?": Length, "pairs?": Length, "profile?": dict[str, Length], "decisions?": list[Text],
    "skipped_gradients?": Count,
}  # fmt: skip
_DEPTH_USE = _typed({"views": Count, "measured": Share})
_SCALE = _typed({"metres_per_unit": Positive, "standard_error": Length | None, "source": PathText})
_GRAVITY = _typed({"direction": Direction, "standard_error_deg": Length, "source": PathText})
VIEW: Any = Annotated[_typed(_VIEW), AfterValidator(_pixels)]
FACTS = _typed({
    "format_version": int, "num_gaussians": Count, "num_instances": Count, "sh_degree": Count,
    "frame?": Text, "metric?": bool, "source?": PathText, "seed?": Bytes,
    "config?": {
        "language?": {"encoder?": Text, "zooms?": Count, "texts?": Text},
        "photos?": {"max_side?": Annotated[int, Field(ge=16, le=65536)]},
    },
    "scene?": {
        "origin?": Point, "input?": PathText, "left_out?": [{"name": PathText, "why": PathText}],
        "warnings?": list[PathText],
    },
    "masks?": {"warnings?": list[PathText]},
    "instances?": {"texts?": Any},
    "quality?": _QUALITY, "training?": _TRAINING, "seconds?": dict[str, Length], "peak_memory_mib?": Length,
    "depth?": _DEPTH_USE | None, "scale?": _SCALE | None, "gravity?": _GRAVITY | None, "map_from_input?": Similarity,
    "files?": dict[FileName, _typed({"bytes": Bytes, "sha256": Text})],  # type: ignore[misc]
    "sha256?": Text, "views?": [VIEW],
})  # fmt: skip
"""map.json. Maps of earlier releases lack some keys."""
_TEXTS = _typed([{"text": Text, "score": Share}])
_PART = {
    "id": Count, "label?": Text | None, "score": Share, "num_gaussians": Count, "centroid": Point,
    "obb": {"center": Point, "rotation": Matrix3, "extent": Sides}, "aabb?": {"min": Point, "max": Point},
    "views?": Count, "texts?": _TEXTS, "hidden?": bool, "parent?": Count,
}  # fmt: skip
INSTANCES, INSTANCE = _typed({"instances": [Any]}), _typed({**_PART, "parts?": [_PART]})
_KNOWN = {key.rstrip("?") for key in (*_PART, "parts")}
_STORED = {"map": PathText, "map_id": Text, "frame": Text, "metric": bool, "instances": Count, "file": FileName}
STORED = _typed({"encoder": {"name": Text, "identity": Text}, "maps": [_STORED]})
"""store.json."""
_READ = _typed([_TEXTS])
NAMES = _typed({"labels": list[Text | None], "texts": _READ | None})
"""Of a map in a store."""


# ------------------------------------------------------------------ checks


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


def check_facts(value: Any) -> None:
    """ValueError unless `value`, of map.json, fits the model and can be written again."""
    check(FACTS, value)
    json.dumps(value, allow_nan=False)  # 1e999 is read as infinity


def check_instances(value: Any, facts: dict[str, Any]) -> None:
    """ValueError unless `value`, of instances.json, fits the model and `facts`, of map.json."""
    check(INSTANCES, value)
    entries, seen = value["instances"], set()
    for n, whole in enumerate(entries):
        check(INSTANCE, whole, f"instances[{n}]")  # each alone: what is checked is copied, and 20,000 copies cost time
        for entry in (whole, *whole.get("parts", ())):
            if entry["id"] in seen:
                raise ValueError(f"id: {entry['id']} occurs twice")
            seen.add(entry["id"])
            if entry["num_gaussians"] > facts["num_gaussians"]:
                raise ValueError(f"num_gaussians: instance {entry['id']} has more than the map")
            if entry is not whole and entry.get("parent") != whole["id"]:
                raise ValueError(f"parent: that of part {entry['id']} is not {whole['id']}")
            if not entry.keys() <= _KNOWN:
                json.dumps({name: entry[name] for name in entry.keys() - _KNOWN}, allow_nan=False)
    if len(entries) != facts["num_instances"]:
        raise ValueError(f"instances: {len(entries)} are there, num_instances in map.json is {facts['num_instances']}")


_LANGUAGE = {
    "encoder": ("U", ()), "embeddings": ("f", ("I", "D")), "palettes": ("f", ("I", "P", 4)),
    "view_counts": ("i", ("I",)), "view_names": ("U", ("V",)), "view_boxes": ("i", ("V", 4)),
    "view_embeddings": ("f", ("V", "D")),
}  # fmt: skip
"""Kind and shape of the arrays of language.npz; a letter stands for the same number everywhere."""


def _check_arrays(arrays: Arrays, expected: dict[str, tuple[str, tuple[Any, ...]]], **sizes: int) -> None:
    for name, (kind, shape) in expected.items():
        if name not in arrays:
            raise ValueError(f"{name}: is missing")
        array, wanted = arrays[name], [sizes.get(side, side) for side in shape]
        sides = zip(shape, array.shape, strict=False)
        fits = array.ndim == len(shape) and all(
            sizes.setdefault(s, n) == n if isinstance(s, str) else s == n for s, n in sides
        )
        if array.dtype.kind != kind or not fits:
            raise ValueError(f"{name}: is {array.dtype} of shape {list(array.shape)}, expected {kind} of {wanted}")
        if kind == "f" and not np.isfinite(array).all():
            raise ValueError(f"{name}: holds NaN or infinity")


def _check_language(arrays: Arrays, rows: int) -> None:
    _check_arrays(arrays, _LANGUAGE, I=rows)
    counts, views = arrays["view_counts"], len(arrays["view_names"])
    if (counts < 0).any() or (counts > views).any() or counts.sum() != views:
        raise ValueError(f"view_counts: they are not the counts of {views} view_names")


def check_archive(name: str, arrays: Arrays, instances: list[dict[str, Any]], gaussians: int) -> None:
    """ValueError unless the arrays of `name`.npz (language, parts or groups), if any, fit the instances and the number
    of Gaussians."""
    if not arrays:
        return None
    if name == "language":
        return _check_language(arrays, len(instances))
    language = {key.removeprefix(PREFIX): array for key, array in arrays.items() if key.startswith(PREFIX)}
    if name == "parts":
        parts = [part["id"] for entry in instances for part in entry.get("parts", [])]
        _check_arrays(arrays, {"ids": ("i", ("N",))}, N=gaussians)
        check_ids(arrays["ids"], parts)
        rows = len(parts)
    else:
        _check_arrays(arrays, {"of": ("i", ("I",)), "scores": ("f", ("G",))}, I=len(instances))
        rows = len(arrays["scores"])
        if set(np.unique(arrays["of"]).tolist()) - {-1} != set(range(rows)):
            raise ValueError(f"of: it does not number the groups of {rows} scores")
    if language:
        _check_language(language, rows)
    return None


def check_ids(ids: np.ndarray, known: list[int]) -> None:
    """ValueError unless each of `ids` is one of `known`, or −1."""
    wrong = ids[~np.isin(ids, np.array([-1, *known], np.int64))]
    if len(wrong):
        raise ValueError(f"ids: {wrong[0]} is none of the {len(known)} in instances.json")
