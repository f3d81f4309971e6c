"""Tells a map where its photos lie now."""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path, PurePosixPath
from typing import Any

from perception.errors import InputError
from perception.io.checksums import FACTS
from perception.io.map_files import MapFiles
from perception.io.map_lock import writing
from perception.io.map_views import stored_view, view_from_json, view_json
from perception.io.store import write_facts


def relink(path: Path, folder: Path) -> dict[str, Any]:
    """Records for every view of the map at `path` that photo below `folder` which has its name and its size.

    A view is looked for under its name ("a/0001.jpg"), else by its file name alone where that is unique below `folder`.
    Views without such a photo keep what was recorded. Returns {"linked": count, "missing": names, "differ": names of
    photos of another size}. InputError when no photo is found, and while another writer is at this map.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: is no folder; give the one that holds the photos of {path}")
    by_name: dict[str, list[Path]] = defaultdict(list)
    for file in sorted(folder.rglob("*")):
        by_name[file.name].append(file)
    with writing(path):
        files = MapFiles(path)
        entries, linked, missing, differ = [], 0, [], []
        for entry, view in zip(files.facts.get("views", []), files.read("views"), strict=True):
            alike = by_name[PurePosixPath(view.name).name]
            found = next((f for f in (folder / view.name, *(alike if len(alike) == 1 else [])) if f.is_file()), None)
            if found is None:
                missing.append(view.name)
            elif view.photo_bytes not in (None, found.stat().st_size):
                differ.append(view.name)
            else:
                linked += 1
                record = view_json(stored_view(view_from_json({**entry, "photo": str(found)}), path))
                entry = {**entry, **{key: record[key] for key in ("photo", "photo_beside", "photo_bytes")}}
            entries.append(entry)
        if linked == 0:
            other = f", {len(differ)} have another size than the photos of the map" if differ else ""
            raise InputError(f"{folder}: holds none of the {len(entries)} photos of {path}{other}; give their folder")
        write_facts(path / FACTS, {**files.facts, "views": entries})
    return {"linked": linked, "missing": missing, "differ": differ}
