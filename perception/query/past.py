"""A map as it stood at an earlier visit, or with the things that are gone (see `map.history`), ready for queries."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from perception.language.description import chosen_rows
from perception.map.history import RECORD, is_removed
from perception.map.map import Map, build_index

Spot = dict[str, Any]
"""An entry of instances.json, or one of its `past`."""
_THEN = ("centroid", "obb", "aabb")
_NOT_THEN = {*_THEN, "parts", *(key.rstrip("?") for key in RECORD)}
"""Keys of an entry that are not those of an earlier spot."""


def present(gmap: Map) -> dict[str, Any]:
    """The fields of `gmap` that the removed instances are part of, without them."""
    rows = [n for n, entry in enumerate(gmap.instances) if not is_removed(entry)]
    groups, of = gmap.groups, gmap.groups.get("of")
    if of is not None:  # a group that lost a member is none
        groups = {**groups, "of": of[rows]} if (np.delete(of, rows) < 0).all() else {}
    language = chosen_rows(gmap.language, rows)
    return {"instances": [gmap.instances[n] for n in rows], "language": language, "groups": groups}


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
