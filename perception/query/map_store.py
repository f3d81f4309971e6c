"""A store: the instances of many maps in one folder, which answers prompts with the scores of the instances' own maps.
docs/formats.md lists its files; a file of maps/ holds the arrays of `Ranker.prepared`, told [I] of `TOLD`, and places
[I, 2, 3] and poses [C, 4, 4] of `Places` (absent where up is not known). It is named by a digest of path and map_id.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import fields
from functools import cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from perception.errors import InputError
from perception.io.arrays import read_npz
from perception.io.documents import brief
from perception.io.json_shapes import check, parsed
from perception.language.description import check_encoder
from perception.language.encoders import make_encoder
from perception.language.printed import Printed, quoted_text
from perception.machine import torch_on_one_thread
from perception.map.checksums import STORE
from perception.map.map import Map
from perception.map.model import NAMES, STORED
from perception.query.hit import Hit
from perception.query.query_map import QueryMap
from perception.query.ranking import THING, Ranker, least_score
from perception.query.relations import WEIGHT, Places, parse, standing
from perception.query.requests import MAX_TOP, TOP, Request
from perception.query.text_ranking import REMEMBERED
from perception.query.where import Frame, Where, tidy
from perception.types import OrientedBox

FORMAT_VERSION = 1
"""Of the store, and of what ranking prepares: other numbers there need another version here."""
TOLD = np.dtype(
    [
        *(("id", "i8"), ("points", "i8"), ("centroid", "f8", 3), ("center", "f8", 3), ("rotation", "f8", (3, 3))),
        *(("extent", "f8", 3), ("covariance", "f8", (3, 3))),
    ]
)
"""What a hit tells of an instance; points: their number."""
_RECORDS = {"things": THING, "told": TOLD}
_RAGGED = ("label_rows", "label_null", "places", "poses", "names", "views")
_TRIES = 5
_OPENED = 8  # maps whose points are kept in memory


class MapStore(QueryMap):
    """Many maps that answer prompts as one. Each instance has the score that it has in its own map, and answers when it
    does there; parts and groups of instances are not held. Whatever else a map can do raises InputError.

    All is read at opening, so the store's folder may change meanwhile. Thread-safe.
    """

    path: Path
    _facts: dict[str, Any]
    _store_id: str
    _chosen: Callable[[str, float | None], list[tuple[int, float]]]
    _opened: Any

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            if name in {field.name for field in fields(Map)}:
                raise InputError(f"{self.path}: is a store of many maps, and this needs one map; give one of them")
            raise AttributeError(f"{type(self).__name__} has no attribute '{name}'")

    @classmethod
    def open(cls, path: Path) -> MapStore:
        """The store at `path`; InputError when it is damaged or of an unknown version."""
        made = cls.__new__(cls)
        made.path = Path(path)
        for left in reversed(range(_TRIES)):
            made._facts, raw = read_store(made.path)
            made._store_id = hashlib.sha256(raw).hexdigest()[:12]
            try:
                made._read()
                break
            except InputError:
                if not left or read_store(made.path)[1] == raw:  # else it was replaced meanwhile
                    raise
        made._chosen = lru_cache(REMEMBERED)(made._answering)
        made._opened = lru_cache(_OPENED)(QueryMap.open)
        return made

    @property
    def maps(self) -> list[dict[str, Any]]:
        """The entries of its maps in store.json, sorted by path."""
        return list(self._facts["maps"])

    @property
    def map_id(self) -> str:
        """Short identifier, which changes when any of the maps does."""
        return self._store_id

    @property
    def frame(self) -> None:  # type: ignore[override]
        """None: every hit is in the frame of its map."""

    @property
    def metric(self) -> None:  # type: ignore[override]
        """None: every hit says whether its map is metric."""

    @property
    def counts(self) -> dict[str, int]:
        return {"maps": len(self.maps), "instances": len(self._told)}

    def warm(self) -> None:
        if self.problem is None:
            self.query("thing")

    def query(
        self,
        text: str,
        top_k: int = TOP,
        min_score: float | None = None,
        *,
        where: Where | None = None,
        frame: Frame | None = None,
    ) -> list[Hit]:
        """The instances that answer `text` in their own maps, best first, at most top_k, in the frames of their maps.
        `min_score`: all with this score instead. Raises InputError as `QueryMap.query`, and for `where` and `frame`."""
        Request(text, top_k, min_score)
        if where is not None or frame is not None:
            raise InputError(
                f"{self.path}: is a store, whose maps have their own frames; give where and frame to a map"
            )
        return [self._hit(n, score) for n, score in self._chosen(text, min_score)[:top_k]]

    @cached_property
    def ranker(self) -> Ranker:  # type: ignore[override]
        name, identity = self._facts["encoder"]["name"], self._facts["encoder"]["identity"]
        try:
            encoder = (self.encoders or make_encoder)(name)
        except InputError as error:
            raise InputError(f"{self.path / STORE}: encoder.name: {error}") from error
        if encoder is None:
            raise InputError(f"{self.path}: names no encoder; index its maps anew")
        check_encoder(identity, encoder.identity)
        texts = [text for names in self._names for text in names["texts"] or [[]] * len(names["labels"])]
        labels = [label for names in self._names for label in names["labels"]]
        reads = np.array([names["texts"] is not None for names in self._names], bool)[self._groups]
        return Ranker.joined(encoder, self._arrays, labels, Printed(texts, self._groups), reads)

    # --------------------------------------------------------------- internals

    def _answering(self, text: str, min_score: float | None) -> list[tuple[int, float]]:
        """(index, score) of at most MAX_TOP instances that answer, best first."""
        with torch_on_one_thread():
            scores = self._scores(text)
        best = np.zeros(len(self.maps))
        np.maximum.at(best, self._groups, scores)
        found = np.flatnonzero(scores >= (least_score(best)[self._groups] if min_score is None else min_score))
        return [(int(n), float(scores[n])) for n in found[np.argsort(-scores[found], kind="stable")][:MAX_TOP]]

    def _scores(self, text: str) -> np.ndarray:
        """[I]: as `relations.ranked`, map by map: a map that has the text as a label takes it as a name."""
        scores, relation = self.ranker.scores(text), parse(text)
        if relation is None or quoted_text(text) is not None:
            return scores
        named = [any(tidy(label or "") == tidy(text) for label in names["labels"]) for names in self._names]
        maps = [
            (own, places)
            for own, places, n in zip(self._slices, self._places_of, named, strict=True)
            if not n and places
        ]
        thing = self.ranker.scores(relation.thing, WEIGHT * standing(self.ranker, maps, relation))
        for own, _ in maps:
            scores[own] = thing[own]
        return scores

    def _hit(self, position: int, score: float) -> Hit:
        told, n = self._told[position], int(self._groups[position])
        entry, place = self.maps[n], position - self._slices[n].start
        number = int(told["id"])
        return Hit(
            number,
            score,
            lambda: self._map(entry).index.of(number),  # type: ignore[arg-type]
            told["centroid"],
            OrientedBox(told["center"], told["rotation"], told["extent"]),
            self._names[n]["labels"][place],
            tuple(json.loads(self._photos[n].tobytes())[place]),
            told["covariance"],
            entry["frame"],
            colors=lambda: self._map(entry).colors_of(number),
            map=entry["map"],
            map_id=entry["map_id"],
            metric=entry["metric"],
            count=int(told["points"]),
        )

    def _map(self, entry: dict[str, Any]) -> QueryMap:
        path = Path(entry["map"])
        if not path.exists():
            raise InputError(f"{path}: the map is gone, and with it the points of its instances; put it back")
        gmap = self._opened(path)
        if gmap.map_id != entry["map_id"]:
            self._opened.cache_clear()
            raise InputError(f"{path}: has changed since {self.path} was made; run: perception index MAP -o STORE")
        return gmap

    def _read(self) -> None:
        """Reads all arrays; those with a row per instance are put after each other."""
        for entry in self.maps:  # before memory is taken for so many
            file = self.path / "maps" / entry["file"]
            if file.is_file() and entry["instances"] * TOLD.itemsize > file.stat().st_size:
                found = f"maps: {file.name} is too small for its {entry['instances']} instances"
                raise _damaged(self.path / STORE, ValueError(found))
        counts = [entry["instances"] for entry in self.maps]
        self._groups = np.repeat(np.arange(len(counts)), counts)
        stops = np.cumsum(counts).tolist()
        self._slices = [slice(stop - count, stop) for stop, count in zip(stops, counts, strict=True)]
        rows: dict[str, np.ndarray] = {}
        ragged: dict[str, list[Any]] = {name: [] for name in _RAGGED}
        for own, entry in zip(self._slices, self.maps, strict=True):
            file = self.path / "maps" / entry["file"]
            arrays = read_npz(file, file, "index its map again")
            try:
                for name, many in ragged.items():
                    many.append(arrays.pop(name, None))
                for name, array in arrays.items():
                    if len(array) != entry["instances"]:
                        raise ValueError(f"{name}: {len(array)} rows, {STORE} says {entry['instances']} instances")
                    if name not in rows:
                        rows[name] = np.empty((sum(counts), *array.shape[1:]), array.dtype)
                    rows[name][own] = array
            except (ValueError, TypeError, KeyError) as error:
                raise _damaged(file, error) from error
        try:
            records = {name: rows.pop(name).view(kind)[:, 0] for name, kind in _RECORDS.items()}
            self._told = records["told"]
            labels = {name: np.concatenate(ragged[name]) for name in ("label_rows", "label_null")}
            self._arrays = {**rows, **labels, "things": records["things"]}
            self._names = [parsed(names.tobytes()) for names in ragged["names"]]
            for names, count in zip(self._names, counts, strict=True):
                check(NAMES, names)
                if not len(names["labels"]) == count == len(names["texts"] or names["labels"]):
                    raise ValueError(f"names: expected those of {count} instances")
        except (ValueError, TypeError, KeyError, AttributeError) as error:
            raise _damaged(self.path / STORE, error) from error
        self._photos, poses = ragged["views"], ragged["poses"]
        self._places_of = [
            p if p is None else Places(p[:, 0], p[:, 1], c) for p, c in zip(ragged["places"], poses, strict=True)
        ]


def read_store(path: Path) -> tuple[dict[str, Any], bytes]:
    """store.json and its bytes; InputError when it is damaged or of another version."""
    file = path / STORE
    try:
        raw = file.read_bytes()
        facts = parsed(raw)
        if isinstance(facts, dict) and (version := facts.get("format_version")) != FORMAT_VERSION:
            found = f"format_version is {brief(version)}, this program reads {FORMAT_VERSION}"
            raise InputError(f"{file}: {found}; index the maps into a new store")
        check(STORED, facts)
    except InputError:
        raise
    except (OSError, ValueError) as error:
        raise _damaged(file, error) from error
    return facts, raw


def _damaged(file: Path, error: Exception) -> InputError:
    return InputError(f"{file}: cannot be read as a store ({error}); index the maps into a new store")
