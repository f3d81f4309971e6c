"""An instance of which a part went becomes two: what stays keeps its id, and what went is judged as one of its own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from perception.boxes import instance_entry
from perception.changes.evidence import GONE, LOOKED, WEIGHTS, Signs, signs_of
from perception.changes.parting import local_sums, smoothed_odds
from perception.language.description import chosen_rows
from perception.map.history import is_removed, joined_record
from perception.map.map import Map
from perception.visits.visit import Visit

LEAST = 0.03
"""Share of the Gaussians of an instance that must go, and that must stay, for it to be two: a mug is 8 % of a desk."""
JUDGED = 0.5
"""Share of them that photos must look at."""


def parted(visit: Visit) -> Visit:
    """The visit of a map whose instances are two where a part went and the photos show the rest as it was, also with
    masks that have its outline rather than that of both."""
    gmap, parts = visit.gmap, _contradicted(visit)
    if not parts:
        return visit
    first, count = gmap.next_id, len(parts)
    whole = _signs(visit, list(parts))
    split = _signs(replace(visit, gmap=with_parted(gmap, parts)), [*parts, *range(first, first + count)])
    tried = zip(parts, whole, split[:count], split[count:], strict=True)
    true = [i for i, old, rest, part in tried if rest.outline > old.outline and _stands(rest) and _went(part, rest)]
    return replace(visit, gmap=with_parted(gmap, {i: parts[i] for i in true})) if true else visit


def _stands(rest: Signs) -> bool:
    return rest.photos >= LOOKED and rest.score * rest.log_odds > -GONE


def _went(part: Signs, rest: Signs) -> bool:
    """Whether the photos contradict a part and rays pass through it, as they do not through the rest: what has another
    colour may stand in other light. Of what is hardly measured, such as a door, a few rays tell nothing."""
    through = part.measured * (part.through - np.nan_to_num(rest.through))
    return part.photos >= LOOKED and part.score * part.log_odds < GONE and through > WEIGHTS["through"][1]


def _signs(visit: Visit, ids: Sequence[int]) -> list[Signs]:
    entries = {entry["id"]: entry for entry in visit.gmap.instances}
    depths = np.array([min(entries[i]["obb"]["extent"]) for i in ids])
    signs = signs_of(visit.before, ids, np.ones(len(ids)), depths)
    return [replace(each, score=float(entries[i]["score"])) for i, each in zip(ids, signs, strict=True)]


def _contradicted(visit: Visit) -> dict[int, np.ndarray]:
    """By the ids of instances: the rows of the map that the photos contradict, of those in which the others stand."""
    from scipy.spatial import cKDTree

    gmap, gaussians = visit.gmap, visit.gaussians
    shape = gaussians.means.double().numpy(), gaussians.scales.max(dim=1).values.numpy()
    sums, found = local_sums(visit.before, *shape, visit.ids), {}
    for i in (entry["id"] for entry in gmap.instances if not is_removed(entry)):
        rows, own = np.flatnonzero(gmap.instance_ids == i), np.flatnonzero(visit.ids == i)
        least = max(LEAST * len(rows), visit.run.config.instances.min_cluster_size)
        if len(rows) < 2 * least or len(own) < JUDGED * len(rows):
            continue
        odds = smoothed_odds(shape[0][own], sums[own])
        judged = np.isfinite(odds)
        if judged.sum() < JUDGED * len(rows):
            continue
        nearest = cKDTree(shape[0][own[judged]]).query(gmap.means[rows])[1]
        went = odds[judged][nearest] < 0
        if least <= went.sum() <= len(rows) - least:
            found[i] = rows[went]
    return found


def with_parted(gmap: Map, parts: dict[int, np.ndarray]) -> Map:
    """The map with new instances after the others, one for each of the `parts`: rows of the instance whose id it has,
    of which it has the words."""
    ids, new, order = gmap.instance_ids.copy(), list[dict[str, Any]](), [entry["id"] for entry in gmap.instances]
    again = [order.index(i) for i in parts]
    for number, (n, rows) in enumerate(zip(again, parts.values(), strict=True), gmap.next_id):
        entry, points, weights = gmap.instances[n], gmap.means[rows], gmap.opacities[rows]
        known = entry["score"], entry.get("views", 0)
        made = instance_entry(number, points.astype(np.float64), weights.astype(np.float64), *known)
        new.append(made | joined_record([entry]))
        ids[rows] = number
    groups = dict(gmap.groups)
    if groups:
        groups["of"] = np.append(groups["of"], groups["of"][again]).astype(np.int32)
    language = chosen_rows(gmap.language, [*range(len(order)), *again])
    return replace(gmap, instance_ids=ids, instances=[*gmap.instances, *new], language=language, groups=groups)
