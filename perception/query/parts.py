"""Queries for parts of instances: "handle of the mug", or all parts of one instance."""

from __future__ import annotations

import dataclasses
import re

from perception.errors import InputError
from perception.query.hit import Hit
from perception.query.query_map import QueryMap

_OF = re.compile(r"^(?:the\s+)?(?P<part>.+?)\s+of\s+(?:the\s+|a\s+|an\s+)?(?P<whole>.+)$", re.IGNORECASE)
_WHOLES = 3
"""Number of instances, the best hits for the whole, whose parts are searched."""


class PartsMap:
    """The parts of the instances of the map `opened` (see io.store), queried in the same way as instances."""

    def __init__(self, opened: QueryMap):
        self.opened = opened
        entries = [part for entry in opened.instances for part in entry.get("parts", [])]
        self.entries = sorted(entries, key=lambda part: int(part["id"]))
        self._asked: QueryMap | None = None
        if self.entries and "ids" in opened.parts:
            self._asked = QueryMap.of(
                opened,
                instances=self.entries,
                instance_ids=opened.parts["ids"],
                language=opened.part_language,
                parts={},
            )

    def of(self, instance: int) -> list[Hit]:
        """The parts of instance id `instance`, largest first, scored by the mapper's confidence."""
        self.opened.position(instance)  # raises for an unknown id
        if self._asked is None:
            return []
        hits = [self._hit(n) for n, part in enumerate(self.entries) if part["parent"] == instance]
        return sorted(hits, key=lambda hit: -len(hit.points))

    def query(self, text: str, top_k: int = 3) -> list[Hit]:
        """The parts that match `text`, best first, each with the `parent` it belongs to.

        "X of the Y": the parts of the best hits for Y are ranked by their match with X. X has no presence threshold,
        because its whole Y is present. Any other text is ranked against all parts, with the presence threshold of
        instances: the result is empty when it is not present. Raises InputError as QueryMap.query does.
        """
        if not text.strip():
            raise InputError('query: the text is empty; ask for a part, such as "handle of the mug"')
        if self._asked is None:
            return []
        asked = _OF.match(" ".join(text.split()))
        if asked is None:
            answer = self._asked.ranker.rank(text, None)
            return [self._hit(n, score) for n, score in answer.hits[:top_k]] if answer.present else []
        wholes = [hit.instance_id for hit in self.opened.query(asked["whole"], _WHOLES)]
        ranked = self._asked.ranker.rank(asked["part"], 0.0).hits
        inside = [(n, score) for n, score in ranked if self.entries[n]["parent"] in wholes]
        inside.sort(key=lambda found: wholes.index(self.entries[found[0]]["parent"]))  # stable: best part of best whole
        return [self._hit(n, score) for n, score in inside[:top_k]]

    def _hit(self, position: int, score: float | None = None) -> Hit:
        assert self._asked is not None
        return dataclasses.replace(self._asked.hit(position, score), parent=int(self.entries[position]["parent"]))
