"""Parts of instances and groups of instances, which answer a prompt where it fits them clearly better."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np

from perception.geometry import sums_by
from perception.language.description import from_arrays
from perception.language.printed import quoted_text
from perception.language.shape_words import shape_kind
from perception.map.map import Map, language_in
from perception.query.hit import Hit
from perception.query.instance_set import InstanceSet
from perception.query.ranking import PRESENT, Ranker, evidence_of
from perception.query.relations import parse
from perception.query.text_ranking import REMEMBERED
from perception.query.where import Where

CLEAR = 1.2  # least difference of `evidence_of` to every instance that shares points with the part or the group


@dataclass(frozen=True)
class Node:
    """Entry `row` of all parts or all groups of a map. instances: ids of the instance that it is part of, or of its
    members; rows: these in instances.json."""

    kind: InstanceSet
    row: int
    is_part: bool
    rows: list[int]
    instances: tuple[int, ...]

    def hit(self, score: float, where: Where) -> Hit:
        """As a Hit of its instance, or of its first member, with its distance if `where.near` is given."""
        hit = self.kind.measured(self.row, where, score)
        part = hit.instance_id if self.is_part else None
        return replace(hit, instance_id=self.instances[0], part=part, instances=() if self.is_part else self.instances)


Candidate = tuple[int | Node, float]  # a row of instances.json, or a node, and its score


class Nodes:
    """The parts and groups of a map that have embeddings. wholes, ranker: the map's instances, and returns theirs."""

    def __init__(self, gmap: Map, wholes: InstanceSet, ranker: Callable[[], Ranker]) -> None:
        self._gmap, self._wholes, self._ranker_of_instances = gmap, wholes, ranker
        self._scored = lru_cache(REMEMBERED)(self._scores)
        row_of = {entry["id"]: n for n, entry in enumerate(gmap.instances)}
        self._kinds: list[InstanceSet] = []
        self._nodes: list[Node] = []
        parts = [part for entry in gmap.instances for part in entry.get("parts", [])]
        language = language_in(gmap.parts)
        if parts and language and language["embeddings"].any() and "ids" in gmap.parts:
            parts.sort(key=lambda part: int(part["id"]))
            kind = InstanceSet(gmap, parts, language, gmap.parts["ids"])
            self._add(kind, True, [[row_of[part["parent"]]] for part in parts])
        if (language := language_in(gmap.groups)) and (gmap.group_ids >= 0).any():
            ids, groups = gmap.group_ids, range(len(gmap.groups["scores"]))
            weights = gmap.opacities.astype(np.float64)
            sums = sums_by(ids + 1, np.c_[gmap.means, np.ones(len(ids))], len(groups) + 1, weights)[1:]
            centroids = sums[:, :3] / np.maximum(sums[:, 3:], 1e-12)
            kind = InstanceSet(gmap, [{"id": g, "score": 1.0, "centroid": centroids[g]} for g in groups], language, ids)
            self._add(kind, False, [np.flatnonzero(gmap.groups["of"] == g).tolist() for g in groups])

    def _add(self, kind: InstanceSet, is_part: bool, related: list[list[int]]) -> None:
        ids = [int(entry["id"]) for entry in self._gmap.instances]
        self._kinds.append(kind)
        self._nodes += [Node(kind, n, is_part, rows, tuple(ids[i] for i in rows)) for n, rows in enumerate(related)]

    @cached_property
    def _ranker(self) -> Ranker:
        """Of the instances, then all nodes, so that their scores compare."""
        groups = [from_arrays(language)[0] for language in (self._gmap.language, *(k.language for k in self._kinds))]
        return Ranker([description for group in groups for description in group], self._ranker_of_instances().encoder)

    def _scores(self, text: str) -> tuple[np.ndarray, np.ndarray]:
        """Scores of the instances, then all nodes, for a prompt, and their `evidence_of`."""
        scores = self._ranker.scores(text)
        return scores, evidence_of(scores)

    def fitting(self, text: str, hits: list[tuple[int, float]], where: Where) -> list[Candidate]:
        """`hits` of all instances, best first, with the nodes that fit clearly better instead of the instances that
        they share points with; parts only if the encoder knows more than whole objects. Labels of the user and texts on
        shapes, relations and prints are left alone. Only nodes that fulfil `where`, with the labels of their instances,
        which is in the map's frame."""
        special = shape_kind(text) or parse(text) or quoted_text(text)
        if not self._nodes or not hits or special or hits[0][1] == 1.0:
            return list(hits)
        scores, z = self._scored(text)
        chosen, replaced = list[Candidate](), set[int]()
        wholes = self._ranker.encoder.reading.wholes
        for n, node in enumerate(self._nodes, start=len(hits)):
            if node.is_part and wholes:
                continue
            clear = scores[n] >= PRESENT and z[n] >= CLEAR + z[node.rows].max()
            labelled = all(self._wholes.has_label(i, where.labels) for i in node.rows)
            if clear and labelled and node.kind.fulfils(node.row, replace(where, labels=None)):
                chosen.append((node, float(scores[n])))
                replaced.update(node.rows)
        return sorted([*chosen, *(hit for hit in hits if hit[0] not in replaced)], key=lambda hit: -hit[1])
