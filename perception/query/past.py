"""A map as it stood at an earlier visit, or with the things that are gone (see `map.history`), ready for queries."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from perception.language.description import chosen_rows
from perception.map.history import RECORD, is_removed
from perception.map.map import Map, build_index, language_in, prefixed

Spot = dict[str, Any]  # an entry of instances.json, or one of its `past`
_THEN = ("centroid", "obb", "aabb")
_NOT_THEN = {*_THEN, "parts", *(key.rstrip("?") for key in RECORD)}
"""Keys of an entry that are not those of an earlier spot."""


def present(gmap: Map) -> dict[str, Any]:
    """The fields of `gmap` that the removed instances are part of, without them."""
    rows = [n for n, entry in enumerate(gmap.instances) if not is_removed(entry)]
    language = chosen_rows(gmap.language, rows)
    return {"instances": [gmap.instances[n] for n in rows], "language": language, "groups": _whole(gmap.groups, rows)}


def _whole(groups: dict[str, np.ndarray], rows: list[int]) -> dict[str, np.ndarray]:
    """The groups of which all members are among `rows` of the instances, which are those that are left."""
    if not groups:
        return {}
    of, lost = groups["of"][rows], np.delete(groups["of"], rows)
    kept = np.setdiff1d(of[of >= 0], lost)
    number = np.full(len(groups["scores"]) + 1, -1, np.int32)  # its last entry is that of −1
    number[kept] = np.arange(len(kept))
    language = prefixed(chosen_rows(language_in(groups), kept))
    return {"of": number[of], "scores": groups["scores"][kept], **language} if len(kept) else {}


def scene(gmap: Map, spot_of: Callable[[Spot], Spot | None]) -> dict[str, Any]:
    """The fields of `gmap`, and its index, with every instance at `spot_of` its entry, without those where that is
    None; without parts and groups."""
    spots = [spot_of(entry) for entry in gmap.instances]
    rows = [n for n, spot in enumerate(spots) if spot is not None]
    past = gmap.past or {"ids": np.zeros(0), "until": np.zeros(0), "means": np.zeros((0, 3), np.float32)}
    entries, points = [], [np.zeros((0, 3), np.float32)]
    for n in rows:
        entry, spot = gmap.instances[n], spots[n] or {}
        if "until" in spot:
            points.append(past["means"][(past["ids"] == entry["id"]) & (past["until"] == spot["until"])])
        else:
            points.append(gmap.index.of(entry["id"]))
        kept = {key: value for key, value in entry.items() if key not in _NOT_THEN}
        then = {key: spot[key] for key in _THEN if key in spot}
        entries.append({**kept, **then, "num_gaussians": len(points[-1])})
    ids = np.repeat([entry["id"] for entry in entries], [entry["num_gaussians"] for entry in entries])
    index = build_index(np.concatenate(points), ids.astype(np.int64))
    language = chosen_rows(gmap.language, rows)
    return {"instances": entries, "language": language, "parts": {}, "groups": {}, "index": index}
