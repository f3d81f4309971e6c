"""Parts of instances and groups of instances, which answer a prompt where its words fit them clearly better."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from statistics import NormalDist
from typing import TYPE_CHECKING, Any

import numpy as np

from perception.boxes import oriented_box
from perception.language.description import from_arrays
from perception.language.printed import quoted_text
from perception.language.shape_words import shape_kind
from perception.map.map import language_in
from perception.query.ranking import PRESENT, Ranker
from perception.query.relations import parse

if TYPE_CHECKING:
    from perception.query.hit import Hit
    from perception.query.query_map import QueryMap

CLEAR = 1.2  # least difference of Φ⁻¹(score) to every instance that shares points with the part or the group


class Nodes:
    """The parts and groups of `opened`, each as the map of all of its kind, its position there, and the positions in
    instances.json of its whole or its members."""

    def __init__(self, opened: QueryMap) -> None:
        self._opened = opened
        self._nodes: list[tuple[QueryMap, int, list[int]]] = []
        place = {entry["id"]: n for n, entry in enumerate(opened.instances)}
        parts = [part for entry in opened.instances for part in entry.get("parts", [])]
        if parts and (language := language_in(opened.parts)) and "ids" in opened.parts:
            parts.sort(key=lambda part: int(part["id"]))
            self._add(parts, opened.parts["ids"], language, [[place[part["parent"]]] for part in parts])
        if (language := language_in(opened.groups)) and (opened.group_ids >= 0).any():
            ids, groups = opened.group_ids, range(len(opened.groups["scores"]))
            members = [np.flatnonzero(opened.groups["of"] == g).tolist() for g in groups]
            points = [opened.means[ids == g].astype(np.float64) for g in groups]
            boxes = [{"centroid": x.mean(axis=0), "obb": oriented_box(x, 0.01).to_json()} for x in points]
            entries = [{"id": g, "score": 1.0, **boxes[g]} for g in groups]
            self._add(entries, ids, language, members)

    def _add(
        self, entries: list[dict[str, Any]], ids: np.ndarray, language: dict[str, np.ndarray], related: list[list[int]]
    ) -> None:
        changes = {"instances": entries, "instance_ids": ids, "language": language, "parts": {}, "groups": {}}
        level = type(self._opened).of(self._opened, **changes)
        self._nodes += [(level, n, positions) for n, positions in enumerate(related)]

    @cached_property
    def _ranker(self) -> Ranker:
        """Of the instances, then all parts and groups, so that their scores compare."""
        levels = [level for level, n, _ in self._nodes if n == 0]
        known = [from_arrays(gmap.language)[0] for gmap in (self._opened, *levels)]
        return self._opened.ranker.over([description for group in known for description in group])

    def fitting(self, text: str, hits: list[tuple[int, float]]) -> list[tuple[int, float]]:
        """`hits` of the I instances, best first, with parts and groups (position I + n) in place of the instances that
        they fit clearly better than. Names given by the user and words for shapes, places and prints are left alone."""
        special = shape_kind(text) or parse(text) or quoted_text(text)
        if not self._nodes or special or hits[0][1] == 1.0:
            return hits
        score, normal, count = dict(self._ranker.rank(text).hits), NormalDist(), len(hits)
        z = {n: normal.inv_cdf(min(max(s, 1e-9), 1 - 1e-9)) for n, s in score.items()}
        found, replaced = [], set()
        for n, (_, _, related) in enumerate(self._nodes, start=count):
            if score[n] >= PRESENT and z[n] >= CLEAR + max(z[i] for i in related):
                found.append((n, score[n]))
                replaced.update(related)
        return sorted([*found, *(hit for hit in hits if hit[0] not in replaced)], key=lambda hit: -hit[1])

    def hit(self, node: int, score: float) -> Hit:
        """Part or group number `node` as a Hit of its whole, or of its first member."""
        level, position, related = self._nodes[node]
        ids = [int(self._opened.instances[n]["id"]) for n in related]
        found = level.hit(position, score)
        part = found.instance_id if "parent" in level.instances[position] else None
        return replace(found, instance_id=ids[0], part=part, instances=() if part is not None else tuple(ids))
