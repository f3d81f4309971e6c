"""A store: the instances of many maps in one folder, which answers prompts with the scores of the instances' own maps.

docs/formats.md lists its files. A file of maps/ holds what `indexing` prepares of one map: `THING` and `RECORD` [I]; of
`ranking.Prepared`: plain, label_rows, label_null and compared (part_0, part_1, …); of `relations.LevelBoxes`, places
[I, 2, 3] and poses [C, 4, 4] (absent where up is not known). It is named by a digest of path and map_id.
"""

from __future__ import annotations

import hashlib
from contextlib import AbstractContextManager
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from perception.errors import InputError
from perception.io.arrays import read_npz
from perception.io.documents import brief, refusing
from perception.io.json_shapes import check, parsed
from perception.language.colors import COLOR_WORDS
from perception.language.description import check_encoder
from perception.language.encoders import make_encoder
from perception.language.negation import negation_in
from perception.language.printed import Printed, quoted_text
from perception.language.shape_words import KINDS
from perception.machine import torch_on_one_thread
from perception.map.checksums import STORE
from perception.map.model import NAMES, STORED, check_arrays
from perception.query.hit import Hit
from perception.query.query_map import QueryMap
from perception.query.ranking import Prepared, Scorer, TextEncoder, least_score
from perception.query.relations import LevelBoxes, gains_of, parse
from perception.query.requests import MAX_TOP, TOP, check_prompt
from perception.query.text_ranking import REMEMBERED, Encoders
from perception.query.where import Frame, Where, tidy
from perception.types import OrientedBox

FORMAT_VERSION = 2  # of the store, and of what ranking prepares: other numbers there need another version here
_COLORS, _SHAPES = ("colors", "f8", len(COLOR_WORDS)), ("shapes", "f8", len(KINDS))
THING = np.dtype([("seen", "?"), ("null", "f8", 2), _COLORS, ("sides", "f8", 3), _SHAPES])
"""Of `ranking.Prepared`, and the scores of `shape_words.KINDS`; NaN where not known."""
_BOX = (("center", "f8", 3), ("rotation", "f8", (3, 3)), ("extent", "f8", 3))
RECORD = np.dtype([("id", "i8"), ("points", "i8"), ("centroid", "f8", 3), *_BOX, ("covariance", "f8", (3, 3))])
"""The fields of a hit; points: their number."""
_RECORDS = {
    "things": (THING, ("null", "colors")),
    "told": (RECORD, ("centroid", "center", "rotation", "extent", "covariance")),
}
"""And the fields that are finite."""
_ARRAYS = {
    "things": ("u", ("I", THING.itemsize)), "told": ("u", ("I", RECORD.itemsize)), "plain": ("f", ("I", "P")),
    "label_rows": ("f", ("L", "D")), "label_null": ("f", ("L", 2)), "names": ("u", ("N",)), "views": ("u", ("V",)),
}  # fmt: skip
_LEVEL = {"places": ("f", ("I", 2, 3)), "poses": ("f", ("C", 4, 4))}
"""Of a map where up is known."""
_TRIES = 5
_OPENED = 8  # maps whose points are kept in memory
_READ = 64  # maps whose names of views are kept as objects, 3 MB for 5000 instances; reading them takes 15 ms


class MapStore:
    """Many maps that answer prompts as one. Each instance has the score that it has in its own map, and answers when it
    does there; parts and groups of instances are not held. What a `QueryMap` can do beside raises InputError.

    All is read at opening, so the store's folder may change meanwhile. Thread-safe. encoders: as of `QueryMap`.
    InputError when the store at `path` is damaged or of an unknown version.
    """

    def __init__(self, path: Path, encoders: Encoders) -> None:
        self.path, self.encoders = path, encoders
        for left in reversed(range(_TRIES)):
            facts, raw = read_store(path)
            try:
                self._maps = _Maps(path, facts["maps"])
                break
            except InputError:
                if not left or read_store(path)[1] == raw:  # else it was replaced meanwhile
                    raise
        self.maps = self._maps.entries
        """The entries of its maps in store.json, sorted by path."""
        self.map_id = hashlib.sha256(raw).hexdigest()[:12]
        """Short identifier, which changes when any of the maps does."""
        self._encoder = facts["encoder"]
        self._chosen = lru_cache(REMEMBERED)(self._answering)
        self._opened = lru_cache(_OPENED)(QueryMap.open)
        self._views = lru_cache(_READ)(self._maps.views)

    def __getattr__(self, name: str) -> Any:
        if hasattr(QueryMap, name):
            raise InputError(f"{self.path}: is a store of many maps, and this needs one map; give one of them")
        raise AttributeError(f"{type(self).__name__} has no attribute '{name}'")

    frame = metric = None
    """Every hit is in the frame of its map, and says whether that is metric."""

    @property
    def counts(self) -> dict[str, int]:
        return {"maps": len(self.maps), "instances": len(self._maps.records)}

    problem: Any = QueryMap.problem
    visits = ()

    def visits_json(self) -> dict[str, Any]:
        """Nothing: the visits of its maps are not held."""
        return {}

    def gone(self, *_: Any, **__: Any) -> list[Hit]:
        """Nothing: what is gone is not held; ask one map for it."""
        return []

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
        text = check_prompt(text, top_k, min_score)
        if where is not None or frame is not None:
            what = "is a store, whose maps have their own frames"
            raise InputError(f"{self.path}: {what}; give where and frame to a map")
        return [self._hit(n, score) for n, score in self._chosen(text, min_score)[:top_k]]

    @cached_property
    def ranker(self) -> Scorer:
        """The scorer of all instances; InputError when the encoder cannot be made."""
        name, identity = self._encoder["name"], self._encoder["identity"]
        try:
            encoder = self.encoders(name)
        except InputError as error:
            raise InputError(f"{self.path / STORE}: encoder.name: {error}") from error
        if encoder is None:
            raise InputError(f"{self.path}: names no encoder; index its maps anew")
        check_encoder(identity, encoder.identity)
        return self._maps.scorer(TextEncoder(encoder))

    # --------------------------------------------------------------- internals

    def _answering(self, text: str, min_score: float | None) -> list[tuple[int, float]]:
        """(index, score) of at most MAX_TOP instances that answer, best first."""
        with torch_on_one_thread():
            scores = self._scores(text)
        best = np.zeros(len(self.maps))
        owner = self._maps.owner
        np.maximum.at(best, owner, scores)
        chosen = np.flatnonzero(scores >= (least_score(best)[owner] if min_score is None else min_score))
        return [(int(n), float(scores[n])) for n in chosen[np.argsort(-scores[chosen], kind="stable")][:MAX_TOP]]

    def _scores(self, text: str) -> np.ndarray:
        """[I]: as `relations.ranked`, map by map: a map that has the text as a label takes it as a name."""
        if (wrong := negation_in(text)) and not any(
            tidy(label or "") == tidy(text) for names in self._maps.names for label in names["labels"]
        ):
            raise InputError(wrong)
        scores, relation = self.ranker.scores(text), parse(text)
        if relation is None or quoted_text(text) is not None:
            return scores
        maps = [
            (own, boxes)
            for own, boxes, names in zip(self._maps.slices, self._maps.boxes, self._maps.names, strict=True)
            if boxes and all(tidy(label or "") != tidy(text) for label in names["labels"])
        ]
        thing = self.ranker.scores(relation.thing, gains_of(self.ranker, maps, relation))
        for own, _ in maps:
            scores[own] = thing[own]
        return scores

    def _hit(self, position: int, score: float) -> Hit:
        record, n = self._maps.records[position].copy(), int(self._maps.owner[position])  # it may be written into
        entry, row = self.maps[n], position - self._maps.slices[n].start
        number = int(record["id"])
        return Hit(
            number,
            score,
            lambda: self._map(entry).index.of(number),  # type: ignore[arg-type]
            record["centroid"],
            OrientedBox(record["center"], record["rotation"], record["extent"]),
            self._maps.names[n]["labels"][row],
            tuple(self._views(n)[row]),
            record["covariance"],
            entry["frame"],
            colors=lambda: self._map(entry).get(number).colors(),  # type: ignore[misc,return-value]
            map=entry["map"],
            map_id=entry["map_id"],
            metric=entry["metric"],
            count=int(record["points"]),
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


class _Maps:
    """The files of a store's maps. entries: of store.json. slices, boxes, names: of each map; owner [I]: the map of
    each instance, and records [I] its `RECORD`; instances follow each other map by map."""

    def __init__(self, path: Path, entries: list[dict[str, Any]]) -> None:
        self.entries, self._path = entries, path / STORE
        self._files = [path / "maps" / entry["file"] for entry in entries]
        for file, entry in zip(self._files, entries, strict=True):  # before memory is taken for so many
            with _reading(self._path):
                if file.is_file() and entry["instances"] * RECORD.itemsize > file.stat().st_size:
                    raise ValueError(f"maps: {file.name} is too small for its {entry['instances']} instances")
        counts = [entry["instances"] for entry in entries]
        self.owner = np.repeat(np.arange(len(counts)), counts)
        stops = np.cumsum(counts).tolist()
        self.slices = [slice(stop - count, stop) for stop, count in zip(stops, counts, strict=True)]
        self._rows: dict[str, np.ndarray] = {}
        self.names, self._views, self.boxes = list[Any](), list[np.ndarray](), list[LevelBoxes | None]()
        labels = list[tuple[np.ndarray, np.ndarray]]()
        for file, own, count in zip(self._files, self.slices, counts, strict=True):
            arrays = read_npz(file, file, "index its map again")
            with _reading(file):
                level = _LEVEL if "places" in arrays else {}
                parts = {name: ("f", ("I", name)) for name in arrays if name.startswith("part_")}
                check_arrays(arrays, {**_ARRAYS, **level, **parts}, I=count)
                for kind, (record, fields) in _RECORDS.items():
                    arrays[kind] = arrays[kind].view(record)
                    if not all(np.isfinite(arrays[kind][name]).all() for name in fields):
                        raise ValueError(f"{kind}: NaN or infinity is among {', '.join(fields)}")
                for name in (*_RECORDS, "plain", *parts):
                    if name not in self._rows:
                        self._rows[name] = np.empty((sum(counts), *arrays[name].shape[1:]), arrays[name].dtype)
                    self._rows[name][own] = arrays[name]
                check(NAMES, names := parsed(arrays["names"].tobytes()))
                if not len(names["labels"]) == count == len(names["texts"] or names["labels"]):
                    raise ValueError(f"names: expected those of {count} instances")
                self.names.append(names)
                self._views.append(arrays["views"])
                labels.append((arrays["label_rows"], arrays["label_null"]))
                places = arrays.get("places")
                self.boxes.append(None if places is None else LevelBoxes(places[:, 0], places[:, 1], arrays["poses"]))
        with _reading(self._path):
            self._things, self.records = (self._rows.pop(name)[:, 0] for name in _RECORDS)
            self._label_rows, self._label_null = (np.concatenate(each) for each in zip(*labels, strict=True))

    def views(self, n: int) -> list[list[str]]:
        """Of each instance of map n, the names of the photos that show it best, best first."""
        with _reading(self._files[n]):
            check(list[list[str]], names := parsed(self._views[n].tobytes()))
            if len(names) != self.entries[n]["instances"]:
                raise ValueError(f"views: expected those of {self.entries[n]['instances']} instances")
        return names

    def scorer(self, encoder: TextEncoder) -> Scorer:
        """Of all instances, each with the scores that it has in its own map."""
        lengths = {f"part_{n}": columns.stop - columns.start for n, (columns, _) in enumerate(encoder.parts)}
        lengths["plain"] = encoder.encoder.dim if len(encoder.canonical) else 0
        with _reading(self._path):
            found = {name: self._rows[name].shape[1] for name in lengths}
            if found != lengths or self._label_rows.shape[1] != encoder.encoder.dim:
                raise ValueError(f"embeddings have lengths {found}, the encoder's {lengths}")
        texts = [text for names in self.names for text in names["texts"] or [[]] * len(names["labels"])]
        prepared = Prepared(
            **{name: self._things[name] for name in ("seen", "null", "colors", "sides")},
            plain=self._rows["plain"],
            compared=[self._rows[f"part_{n}"] for n in range(len(encoder.parts))],
            labels=[label for names in self.names for label in names["labels"]],
            label_rows=self._label_rows,
            label_null=self._label_null,
        )
        reads = np.array([names["texts"] is not None for names in self.names], bool)[self.owner]
        return Scorer(encoder, prepared, lambda: self._things["shapes"], Printed(texts, self.owner), reads)


def read_store(path: Path) -> tuple[dict[str, Any], bytes]:
    """store.json and its bytes; InputError when it is damaged or of another version."""
    file = path / STORE
    with _reading(file):
        raw = file.read_bytes()
        facts = parsed(raw)
        if isinstance(facts, dict) and (version := facts.get("format_version")) != FORMAT_VERSION:
            found = f"format_version is {brief(version)}, this program reads {FORMAT_VERSION}"
            raise InputError(f"{file}: {found}; index the maps into a new store")
        check(STORED, facts)
    return facts, raw


def _reading(file: Path) -> AbstractContextManager[None]:
    return refusing(f"{file}: cannot be read as a store ({{why}}); index the maps into a new store")


def load_map(path: str | Path, encoders: Encoders | None = None) -> QueryMap:
    """Opens a map directory, a million Gaussians in well under a second, or a store of many maps: a `MapStore`, which
    answers `query` as a map does, and raises InputError for all else that needs one map.

    encoders: makes an encoder from its name in the map's config; perception.language.encoders.make_encoder when None.
    Raises InputError when `path` is neither, damaged, or of another format version.

    >>> gmap = load_map("kitchen.gsmap")
    >>> gmap.counts
    {'instances': 9, 'gaussians': 3000}
    >>> gmap.query("red mug", top_k=3)[0].points.shape[1]
    3
    """
    encoders = encoders or make_encoder
    if (Path(path) / STORE).is_file():
        return MapStore(Path(path), encoders)  # type: ignore[return-value]
    return QueryMap.open(Path(path), encoders=encoders)
