"""Opens a map, or a store of many maps, for queries."""

from __future__ import annotations

from pathlib import Path

from perception.map.checksums import STORE
from perception.query.map_store import MapStore
from perception.query.query_map import QueryMap
from perception.query.text_ranking import Encoders


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
    if (Path(path) / STORE).is_file():
        return MapStore(Path(path), encoders)  # type: ignore[return-value]
    return QueryMap.open(Path(path), encoders=encoders)
