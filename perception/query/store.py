"""One memory for many maps: a store holds what prompts need of the instances of each map, and answers across all.

store.json        format_version, and the encoder of all embeddings
maps/KEY.npz      one file per map, named by its path: descriptions, boxes, labels, texts, shapes, sizes

An instance's score is what its own map gives it, so scores of different maps compare, and the ranking is exact: every
instance is scored. Prompts are ranked by things; relations ("mug on the desk"), parts and groups are left to the map.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from perception.errors import InputError
from perception.io.atomic import atomic_file, writing
from perception.io.documents import DAMAGE
from perception.io.map_files import STORE_FACTS, STORED, is_store
from perception.language.base import Encoder
from perception.language.description import InstanceDescription, check_encoder
from perception.language.encoders import make_encoder
from perception.language.printed import Printed
from perception.language.ranking import Ranker, answering
from perception.progress import Progress
from perception.query.hit import Hit
from perception.query.query_map import QueryMap, load_map
from perception.query.requests import TOP, Request
from perception.query.text_ranking import Encoders, described, extents, one_thread, shapes_of
from perception.query.where import Frame, Where
from perception.types import OrientedBox

VERSION = 1
_ROWS = ("embeddings", "palettes", "seen", "shapes", "extents")  # arrays of one row per instance


class StoredHit(Hit):
    """A hit in a store. map, map_id: the map that it lies in; frame, metric: that map's. Its points and colours are
    read from the map when first asked for; InputError if it is gone or another by now."""

    map: Path
    map_id: str
    metric: bool

    def __init__(self, entry: dict[str, Any], score: float, facts: dict[str, Any]) -> None:
        box = OrientedBox.from_json(entry["obb"])
        own = {"instance_id": entry["id"], "score": score, "centroid": np.array(entry["centroid"]), "obb": box}
        own |= {"label": entry["label"], "views": tuple(entry["views"]), "covariance": np.array(entry["covariance"])}
        own |= {"frame": facts["frame"], "distance": None, "part": None, "instances": (), "map": Path(facts["path"])}
        own |= {"map_id": facts["map_id"], "metric": facts["metric"], "_num_points": entry["num_points"]}
        self.__dict__.update(own)  # not `points`, which are read later

    @cached_property
    def _own(self) -> Hit:
        gmap = load_map(self.map)
        if gmap.map_id != self.map_id:
            raise InputError(f"{self.map}: is another map than the store's; run: perception index {self.map} -o STORE")
        return gmap.get(self.instance_id)

    @cached_property
    def points(self) -> np.ndarray:  # type: ignore[override]
        """[P, 3] float32, read from the map."""
        return self._own.points

    @property
    def num_points(self) -> int:
        """P, from the store."""
        return int(self.__dict__["_num_points"])

    def colors(self) -> np.ndarray:  # type: ignore[override]
        """[P, 3] uint8 of the points, read from the map."""
        own = self._own
        return np.zeros((0, 3), np.uint8) if own.colors is None else own.colors()

    def to_json(self) -> dict[str, Any]:
        """The hit as JSON, with its map, frame and unit."""
        about = {"map": str(self.map), "map_id": self.map_id, "frame": self.frame, "metric": self.metric}
        return {**super().to_json(), **about}


class QueryStore(QueryMap):
    """The store at `path`, opened as one map whose instances are those of all its maps; see `query`. What is asked of
    one place or one id is refused: ask the map that a hit names. Raises InputError when the store is damaged."""

    def __init__(self, path: Path, encoders: Encoders | None = None) -> None:
        self.path, self.encoders, self._files = path, encoders, None
        self._facts = _facts(path)
        read = [_read(file) for file in sorted((path / STORED).glob("*.npz"))]
        self.maps: list[dict[str, Any]] = [facts for _, facts in read]
        counts = [len(facts["instances"]) for facts in self.maps]
        self._starts = [0, *np.cumsum(counts[:-1]).tolist()] if counts else [0]
        self._map_of = np.repeat(np.arange(len(counts)), counts)
        self.instances = [entry for facts in self.maps for entry in facts["instances"]]
        self._rows = {name: np.concatenate([arrays[name] for arrays, _ in read]) for name in _ROWS} if read else {}
        self.info = {"num_gaussians": sum(facts["gaussians"] for facts in self.maps)}

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        raise InputError(f"{self.path}: is a store of many maps; ask one of its maps, which each hit names")

    @property
    def map_id(self) -> str:
        """Changes when a map of the store does."""
        return hashlib.sha256("".join(facts["map_id"] for facts in self.maps).encode()).hexdigest()[:12]

    @property
    def frame(self) -> str:
        """Each hit has its own map's."""
        return "of each map"

    @property
    def metric(self) -> bool:
        """Whether all maps are in metres."""
        return all(facts["metric"] for facts in self.maps)

    @property
    def problem(self) -> str | None:
        """Why prompts cannot be answered, one line; None when they can."""
        try:
            _ = self.ranker
        except InputError as error:
            return str(error)
        return None

    @cached_property
    def ranker(self) -> Ranker:  # type: ignore[override]
        """The ranker of all instances; InputError when the encoder is missing or another by now."""
        encoder: Encoder | None = (self.encoders or make_encoder)(self._facts["spec"])
        if encoder is None:
            raise InputError(
                f"{self.path}: its maps were made without an encoder; map again with language.encoder=conse"
            )
        check_encoder(self._facts["encoder"], encoder.identity)
        rows = self._rows
        embeddings = rows.pop("embeddings", np.zeros((0, encoder.dim), np.float32))  # the ranker has its own copy
        descriptions = [
            InstanceDescription(embeddings[i], embeddings[:0], rows["palettes"][i], ["x"] * int(seen))
            for i, seen in enumerate(rows.get("seen", ()))
        ]
        read = any(facts["texts_read"] for facts in self.maps)
        printed = Printed([entry["texts"] for entry in self.instances], self._starts) if read else None
        labels = [entry["label"] for entry in self.instances]
        sizes, starts = rows.get("extents"), self._starts
        return Ranker(descriptions, encoder, labels, lambda: rows["shapes"], printed, sizes, starts)

    def warm(self) -> None:
        """Prepares what the first query needs."""
        if self.problem is None and self.instances:
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
        """The instances of all maps that answer `text`, best first, as `StoredHit`s. InputError as `QueryMap.query`,
        and for `where` and `frame`, which hold in one map."""
        Request(text, top_k, min_score)
        if where is not None or frame is not None:
            raise InputError(f"{self.path}: filters by place and frames hold in one map; ask one of the store's maps")
        if not self.instances:
            return []
        with one_thread():
            chosen = answering(self.ranker.rank(text).hits, min_score)[:top_k]
        return [StoredHit(self.instances[n], score, self.maps[self._map_of[n]]) for n, score in chosen]


def index_maps(
    maps: Sequence[Path], store: Path, remove: Sequence[Path] = (), progress: Progress | None = None
) -> dict[str, Any]:
    """Adds or replaces the maps in the store at `store`, which is made if there is none, and removes those of `remove`.

    Each map is exchanged as a whole: a run that is killed leaves the old or the new one, and can be repeated. Returns
    {"added", "replaced", "unchanged", "removed", "maps", "instances"}. InputError, before anything is written, for what
    is no map, for a map without embeddings or of another encoder than the store's, and for a store of another version.
    """
    facts = _facts(store) if is_store(store) else None
    if facts is None and store.exists() and any(store.iterdir()):
        raise InputError(f"{store}: is neither empty nor a store; choose another folder")
    opened = []
    for path in maps:
        gmap = load_map(path)
        _, encoder, spec = described(gmap)
        facts = facts or {"format_version": VERSION, "encoder": encoder, "spec": spec}
        if encoder != facts["encoder"]:
            made = f"has embeddings by '{encoder}', those of {store} are by '{facts['encoder']}'"
            raise InputError(f"{path}: {made}; make them alike: perception upgrade MAP")
        opened.append(gmap)
    gone = [store / STORED / _key(path) for path in remove]
    for path, file in zip(remove, gone, strict=True):
        if not file.is_file():
            raise InputError(f"{path}: is not in {store}; give its path as it was indexed")
    if facts is None:
        raise InputError(f"{store}: no maps given; give those to be indexed")
    counts = {"added": 0, "replaced": 0, "unchanged": 0, "removed": len(gone)}
    (store / STORED).mkdir(parents=True, exist_ok=True)
    with writing(store):
        with atomic_file(store / STORE_FACTS) as aside:
            aside.write_text(json.dumps(facts), encoding="utf-8")
        for done, gmap in enumerate(opened, start=1):
            counts[_put(store, gmap)] += 1
            if progress is not None:
                progress.update("index", done, len(opened))
        for file in gone:
            file.unlink()
    held = [_read(file)[1] for file in (store / STORED).glob("*.npz")]
    return {**counts, "maps": len(held), "instances": sum(len(facts["instances"]) for facts in held)}


def _put(store: Path, gmap: QueryMap) -> str:
    """Writes what the store holds of a map; whether it was "added", "replaced" or "unchanged"."""
    assert gmap.path is not None  # opened from there
    file = store / STORED / _key(gmap.path)
    before = _read(file)[1]["map_id"] if file.is_file() else None
    if before == gmap.map_id:
        return "unchanged"
    descriptions, _, _ = described(gmap)
    entries = []
    for n, entry in enumerate(gmap.instances):
        hit = gmap.hit(n)
        kept = {name: entry.get(name) for name in ("id", "label", "centroid", "obb", "score")}
        kept |= {"texts": entry.get("texts", []), "views": list(hit.views), "covariance": hit.covariance.tolist()}
        entries.append({**kept, "num_points": hit.num_points})
    facts = {
        "path": str(gmap.path.resolve()),
        "map_id": gmap.map_id,
        "frame": gmap.frame,
        "metric": gmap.metric,
        "gaussians": int(gmap.info.get("num_gaussians", 0)),
        "texts_read": gmap.info.get("instances", {}).get("texts") is not None,
        "instances": entries,
    }
    sizes = extents(gmap) if gmap.metric else np.full((len(entries), 3), np.nan)
    with atomic_file(file) as aside, aside.open("wb") as stream:
        np.savez(
            stream,
            facts=np.array(json.dumps(facts)),
            embeddings=gmap.language["embeddings"],
            palettes=gmap.language["palettes"],
            seen=np.array([d.seen for d in descriptions], bool),
            shapes=shapes_of(gmap),
            extents=sizes,
        )
    return "added" if before is None else "replaced"


def _key(path: Path) -> str:
    return hashlib.sha256(str(path.resolve()).encode()).hexdigest()[:16] + ".npz"


def _facts(store: Path) -> dict[str, Any]:
    try:
        facts: dict[str, Any] = json.loads((store / STORE_FACTS).read_text(encoding="utf-8"))
        version = facts["format_version"], facts["encoder"], facts["spec"]
    except DAMAGE as error:
        raise InputError(f"{store / STORE_FACTS}: is damaged; index the maps again into a new folder") from error
    if version[0] != VERSION:
        raise InputError(
            f"{store}: is a store of version {version[0]}, this program reads {VERSION}; index the maps again"
        )
    return facts


def _read(file: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """The arrays and facts that a store holds of one map."""
    try:
        with np.load(file) as stored:
            arrays = {name: stored[name] for name in _ROWS}
            facts = json.loads(str(stored["facts"]))
        if {len(array) for array in arrays.values()} != {len(facts["instances"])}:
            raise ValueError("rows do not fit the instances")
    except DAMAGE as error:
        raise InputError(f"{file}: is damaged; delete it, and index its map again") from error
    return arrays, facts
