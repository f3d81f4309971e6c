"""`perception index`: writes the instances of many maps into a store (`map_store` describes its files)."""

from __future__ import annotations

import hashlib
import json
import os
import re
import zipfile
from collections.abc import Sequence
from datetime import datetime, timezone
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from perception.errors import InputError
from perception.io.atomic import pointed, recover, write_file
from perception.language.encoders import make_encoder
from perception.map.checksums import FACTS, STORE
from perception.map.replace import writing
from perception.progress import QUIET, Progress
from perception.query.map_store import FORMAT_VERSION, RECORD, THING, read_store
from perception.query.query_map import QueryMap
from perception.query.relations import LevelBoxes
from perception.query.text_ranking import Encoders, encoder_name, printed_on

_NAME = re.compile(r"\.?[0-9a-f]{32}\.npz(?P<unfinished>\.new-\d+-\w{8})?")


def index_maps(
    store: Path,
    maps: Sequence[Path],
    remove: Sequence[Path] = (),
    encoders: Encoders | None = None,
    progress: Progress = QUIET,
) -> dict[str, Any]:
    """Brings `maps` into the store at `store`, made if there is none, and takes those of `remove` out of it.

    Maps that the store holds already are replaced if they changed. Returns the counts `added`, `replaced`, `unchanged`
    and `removed`, of the whole store `maps` and `instances`, and `left_out`, in one line each why some of `maps` are as
    the store had them: a folder that is no map, a map without embeddings or of another encoder than the store's. The
    store changes at the end, all at once. What an interrupted run has prepared is used by the next one. InputError, and
    no change, where all of `maps` are left out, for a path to remove that the store does not hold, a folder that is no
    store, and while another process writes the store.

    >>> counts = index_maps(Path("all.store"), [Path("kitchen.gsmap")])
    >>> counts["added"], counts["instances"]
    (1, 9)
    >>> perception.load_map("all.store").query("red mug")[0].map_id == perception.load_map("kitchen.gsmap").map_id
    True
    """
    encoders, store = lru_cache(encoders or make_encoder), pointed(store)
    with writing(store):
        facts = _facts(store)
        entries = {entry["map"]: entry for entry in facts["maps"]}
        counts = dict.fromkeys(("added", "replaced", "unchanged", "removed"), 0)
        for path in remove:
            if entries.pop(os.path.realpath(path), None) is None:
                raise InputError(f"{path}: is not one of the {len(entries)} maps in {store}; nothing was removed")
            counts["removed"] += 1
        paths = list(dict.fromkeys(Path(os.path.realpath(path)) for path in maps))
        left_out = list[str]()
        for n, path in enumerate(paths, start=1):
            before = entries.get(str(path))
            try:
                if not (path / FACTS).is_file():
                    raise InputError(f"{path}: is no map (no {FACTS} inside)")
                gmap = QueryMap.open(path, encoders=encoders)
                if before is None or before["map_id"] != gmap.map_id:
                    entries[str(path)] = _indexed(store, gmap, facts)
            except InputError as error:
                left_out.append(str(error))
            else:
                same = entries[str(path)] is before
                counts["added" if before is None else "unchanged" if same else "replaced"] += 1
            progress.update("maps", n, len(paths))
        if left_out and len(left_out) == len(paths):
            raise InputError(f"{left_out[0]}; the store is as it was")
        if not entries:
            raise InputError(f"{store}: would hold no map; give maps, or delete it")
        facts["maps"] = [entries[path] for path in sorted(entries)]
        write_file(store / STORE, json.dumps(facts, indent=1) + "\n")
        listed = {entry["file"] for entry in facts["maps"]}
        for file in (store / "maps").iterdir():  # of other maps, and of writers that were killed
            if file.name not in listed and _is_ours(file):
                file.unlink(missing_ok=True)
    instances = sum(entry["instances"] for entry in entries.values())
    return {**counts, "maps": len(entries), "instances": instances, "left_out": left_out}


def _facts(store: Path) -> dict[str, Any]:
    """What store.json holds, or will hold in a new store."""
    maps = store / "maps"
    if (store / STORE).is_file():
        return read_store(store)[0]
    recover(store / STORE)
    if store.exists() and not (store.is_dir() and all(item == maps for item in store.iterdir())):
        raise InputError(f"{store}: is no store, and something lies there; give a new folder with -o")
    if os.path.lexists(maps) and not (maps.is_dir() and all(map(_is_ours, maps.iterdir()))):
        raise InputError(f"{maps}: holds what is not of a store; give a new folder with -o")
    return {"format_version": FORMAT_VERSION, "encoder": None, "maps": []}


def _is_ours(file: Path) -> bool:
    """Whether a file in the folder maps/ was written here, completely or not: by its name, and by what it holds."""
    name = _NAME.fullmatch(file.name)
    if name is None or file.is_symlink() or not file.is_file():
        return False
    if name["unfinished"]:
        return True
    try:
        with zipfile.ZipFile(file) as archive:
            return "told.npy" in archive.namelist()
    except (OSError, zipfile.BadZipFile):
        return False


def _indexed(store: Path, gmap: QueryMap, facts: dict[str, Any]) -> dict[str, Any]:
    """Writes the file of a map, unless it is there; returns its entry for `facts`, whose encoder is set or compared."""
    path = Path(str(gmap.path))
    if (problem := gmap.problem) is not None:
        raise InputError(problem if str(path) in problem else f"{path}: {problem}")
    identity = str(gmap.language["encoder"])
    known = facts["encoder"] = facts["encoder"] or {"name": encoder_name(gmap), "identity": identity}
    if known["identity"] != identity:
        made = f"its embeddings were made by '{identity}', those of {store} by '{known['identity']}'"
        raise InputError(f"{path}: {made}; run: perception upgrade MAP, or give another store")
    key = json.dumps([str(path), gmap.map_id, identity, FORMAT_VERSION])
    file = hashlib.sha256(key.encode()).hexdigest()[:32] + ".npz"
    if not (store / "maps" / file).is_file():
        arrays: dict[str, Any] = _arrays(gmap)
        write_file(store / "maps" / file, lambda stream: np.savez(stream, **arrays))
    written = datetime.fromtimestamp((path / FACTS).stat().st_mtime, timezone.utc).isoformat(timespec="seconds")
    entry = {"map": str(path), "map_id": gmap.map_id, "frame": gmap.frame, "metric": gmap.metric, "written": written}
    return {**entry, "instances": len(gmap.instances), "file": file}


def _arrays(gmap: QueryMap) -> dict[str, np.ndarray]:
    ranker, boxes, count = gmap.ranker, LevelBoxes.of(gmap), len(gmap.instances)
    prepared, things, records = ranker.prepared, np.zeros(count, THING), np.zeros(count, RECORD)
    for name in ("seen", "null", "colors", "sides"):
        things[name] = getattr(prepared, name)
    things["shapes"] = np.nan if ranker.shapes is None else ranker.shapes
    views = []
    for n in range(count):
        hit = gmap.hit(n)
        box = hit.obb.center, hit.obb.rotation, hit.obb.extent
        records[n] = (hit.instance_id, len(hit.points), hit.centroid, *box, hit.covariance)
        views.append(hit.views)
    texts = None if printed_on(gmap) is None else [entry.get("texts", []) for entry in gmap.instances]
    names = {"labels": [entry.get("label") for entry in gmap.instances], "texts": texts}
    level = {} if boxes is None else {"places": np.stack([boxes.lows, boxes.highs], axis=1), "poses": boxes.poses}
    plain = prepared.plain if len(ranker.encoder.canonical) else prepared.plain[:, :0]
    parts = {f"part_{n}": rows for n, rows in enumerate(prepared.compared)}
    labels = {"label_rows": prepared.label_rows, "label_null": prepared.label_null}
    return {
        **{"things": _rows(things), "told": _rows(records), "names": _text(names), "views": _text(views)},
        **{**parts, "plain": plain, **labels, **level},
    }


def _rows(records: np.ndarray) -> np.ndarray:
    """[I, bytes] uint8."""
    return np.frombuffer(records.tobytes(), np.uint8).reshape(len(records), records.dtype.itemsize)


def _text(value: Any) -> np.ndarray:
    """JSON as UTF-8, [bytes] uint8."""
    return np.frombuffer(json.dumps(value).encode(), np.uint8)
