"""What a map's files may hold: all of map.json, instances.json, store.json and the archives is checked here when it is
read. Ids and counts are 0 … 2³¹ − 1. Keys that are not named here are kept as they are.
"""

from __future__ import annotations

import base64
import json
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, Field

from perception.io.json_shapes import (
    Bytes,
    Count,
    Direction,
    FileName,
    Length,
    Number,
    PathText,
    Point,
    Positive,
    Share,
    Similarity,
    Text,
    check,
    typed,
)  # fmt: skip
from perception.map.history import AABB, OBB, RECORD, VISIT, check_record
from perception.photos.view_json import VIEW

PREFIX = "language_"
"""Of the arrays of parts.npz and groups.npz that correspond to those of language.npz."""
Arrays = dict[str, np.ndarray]


def _encoded(value: str) -> str:
    base64.b64decode(value, validate=True)  # a ValueError for anything else
    return value


Encoded = Annotated[str, AfterValidator(_encoded)]
_QUALITY = {
    "psnr?": Number | None, "ssim?": Number | None,
    "views?": dict[str, typed({"psnr": Number | None, "ssim": Number | None})],  # type: ignore[misc]
    "depth?": {"unit": Text, "median": Number, "tolerance": Number, "close": Number},
}  # fmt: skip
_TRAINING = {
    "iterations?": Count, "seconds?": Length, "pairs?": Length, "profile?": dict[str, Length], "decisions?": list[Text],
    "skipped_gradients?": Count,
}  # fmt: skip
_CORNER = Annotated[list[Number | None], Field(min_length=3, max_length=3)]
_BLOCK = {"box": Annotated[list[_CORNER], Field(min_length=2, max_length=2)]}  # None: infinite
_DEPTH_USE = typed({"views": Count, "measured": Share})
_SCALE = typed({"metres_per_unit": Positive, "standard_error": Length | None, "source": PathText})
_GRAVITY = typed({"direction": Direction, "standard_error_deg": Length, "source": PathText})
FACTS = typed({
    "format_version": int, "num_gaussians": Count, "num_instances": Count, "sh_degree": Count,
    "next_id?": Bytes, "frame?": Text, "metric?": bool, "source?": PathText, "seed?": Bytes,
    "config?": {
        "language?": {"encoder?": PathText, "zooms?": Count, "texts?": Text},
        "photos?": {"max_side?": Annotated[int, Field(ge=16, le=65536)]},
    },
    "scene?": {
        "origin?": Point, "input?": PathText, "left_out?": [{"name": PathText, "why": PathText}],
        "warnings?": list[PathText], "still?": {"photos": Count, "share": Share, "mask": Encoded},
    },
    "masks?": {"warnings?": list[PathText]},
    "instances?": {"texts?": Any},
    "quality?": _QUALITY, "training?": _TRAINING, "seconds?": dict[str, Length], "peak_memory_mib?": Length,
    "blocks?": [_BLOCK], "depth?": _DEPTH_USE | None, "scale?": _SCALE | None, "gravity?": _GRAVITY | None,
    "map_from_input?": Similarity,
    "files?": dict[FileName, typed({"bytes": Bytes, "sha256": Text})],  # type: ignore[misc]
    "sha256?": Text, "views?": [VIEW], "visits?": [VISIT],
})  # fmt: skip
"""map.json. Maps of earlier releases lack some keys."""
_TEXTS = typed([{"text": Text, "score": Share}])
_PART = {
    "id": Count, "label?": Text | None, "score": Share, "num_gaussians": Count, "centroid": Point,
    "obb": OBB, "aabb?": AABB,
    "views?": Count, "texts?": _TEXTS, "hidden?": bool, "parent?": Count,
}  # fmt: skip
INSTANCES, INSTANCE = typed({"instances": [Any]}), typed({**_PART, **RECORD, "parts?": [_PART]})
_KNOWN = {key.rstrip("?") for key in (*_PART, *RECORD, "parts")}
_STORED = {"map": PathText, "map_id": Text, "frame": Text, "metric": bool, "instances": Count, "file": FileName}
STORED = typed({"encoder": {"name": Text, "identity": Text}, "maps": [_STORED]})
"""store.json."""
_READ = typed([_TEXTS])
NAMES = typed({"labels": list[Text | None], "texts": _READ | None})
"""Of a map in a store."""


# ------------------------------------------------------------------ checks


def check_facts(value: Any) -> None:
    """ValueError unless `value`, of map.json, fits the model and can be written again."""
    check(FACTS, value)
    json.dumps(value, allow_nan=False)  # 1e999 is read as infinity
    visits = len(value.get("visits") or [0])
    for n, view in enumerate(value.get("views", ())):
        if view.get("visit", 0) >= visits:
            raise ValueError(f"views[{n}].visit: is {view['visit']}, the map has {visits} visits")


def check_instances(value: Any, facts: dict[str, Any]) -> None:
    """ValueError unless `value`, of instances.json, fits the model and `facts`, of map.json."""
    check(INSTANCES, value)
    entries, seen, visits = value["instances"], set(), len(facts.get("visits") or [0])
    for n, instance in enumerate(entries):
        # Each alone: what is checked is copied, and 20,000 copies cost time.
        check(INSTANCE, instance, f"instances[{n}]")
        check_record(instance, visits)
        for entry in (instance, *instance.get("parts", ())):
            if entry["id"] in seen:
                raise ValueError(f"id: {entry['id']} occurs twice")
            seen.add(entry["id"])
            if entry["num_gaussians"] > facts["num_gaussians"]:
                raise ValueError(f"num_gaussians: instance {entry['id']} has more than the map")
            if entry is not instance and entry.get("parent") != instance["id"]:
                raise ValueError(f"parent: that of part {entry['id']} is not {instance['id']}")
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
_LOOKS = {
    "quats": ("f", ("M", 4)), "log_scales": ("f", ("M", 3)), "opacity_logits": ("f", ("M",)), "colors": ("f", ("M", 3)),
}  # fmt: skip
"""Those of past.npz that say what things looked like; all or none."""


def check_arrays(arrays: Arrays, expected: dict[str, tuple[str, tuple[Any, ...]]], **sizes: int) -> None:
    """ValueError unless the arrays are there with these kinds and shapes, finite. sizes: of letters that are known."""
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
    check_arrays(arrays, _LANGUAGE, I=rows)
    counts, views = arrays["view_counts"], len(arrays["view_names"])
    if (counts < 0).any() or (counts > views).any() or counts.sum() != views:
        raise ValueError(f"view_counts: they are not the counts of {views} view_names")


def check_archive(name: str, arrays: Arrays, instances: list[dict[str, Any]], gaussians: int) -> None:
    """ValueError unless the arrays of `name`.npz (language, parts, groups or past), if any, fit the instances and the
    number of Gaussians."""
    if not arrays:
        return None
    if name == "past":
        expected = {"means": ("f", ("M", 3)), "ids": ("i", ("M",)), "until": ("i", ("M",))}
        looks = _LOOKS if any(name in arrays for name in _LOOKS) else {}
        check_arrays(arrays, {**expected, **looks})
        spots = {(entry["id"], spot["until"]) for entry in instances for spot in entry.get("past", ())}
        for pair in zip(*(np.unique(np.stack([arrays["ids"], arrays["until"]]), axis=1).tolist()), strict=True):
            if pair not in spots:
                raise ValueError(f"ids: instance {pair[0]} has no past until visit {pair[1]} in instances.json")
        return None
    if name == "language":
        return _check_language(arrays, len(instances))
    language = {key.removeprefix(PREFIX): array for key, array in arrays.items() if key.startswith(PREFIX)}
    if name == "parts":
        parts = [part["id"] for entry in instances for part in entry.get("parts", [])]
        check_arrays(arrays, {"ids": ("i", ("N",))}, N=gaussians)
        check_ids(arrays["ids"], parts)
        rows = len(parts)
    else:
        check_arrays(arrays, {"of": ("i", ("I",)), "scores": ("f", ("G",))}, I=len(instances))
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
