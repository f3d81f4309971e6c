"""Updates the photo paths of a map after its photos were moved."""

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
    """Records for every view of the map at `path` the photo below `folder` with the same name and size.

    A photo is searched by the view name ("a/0001.jpg"), else by the file name alone if that is unique below `folder`.
    Views without such a photo keep their record. Returns {"linked": count, "missing": names, "differ": names of
    photos of another size}. InputError when no photo is found, or while the map is locked by another writer.
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
