"""Crops of instances from the photos that show them best, for servers: a received map may name any file of this machine
as its photo, so only photos in the map's own folder are read, and in a folder that the user allows.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from perception.errors import InputError
from perception.map.map import MAX_SIDE, Map
from perception.photos.view_json import StoredView, absolute, locate_photo
from perception.pictures import cut_out
from perception.query.query_map import QueryMap
from perception.types import View

OUTSIDE = "photos outside the map's folder are not shown; --photos DIR shows those in DIR"
"""What a server answers for a map that names such photos."""


class PhotoOutside(InputError):
    """The photo is in no folder where photos may be read."""


def best_crop(gmap: QueryMap, instance_id: int, side: int = 320, photos: Path | None = None) -> np.ndarray | None:
    """The crop of an instance from its best photo, [h, w, 3] uint8 RGB, longer side at most `side` pixels.

    None when no photo shows the instance or its photo is missing or unreadable. photos: a folder where photos may be
    read beside the map's own. InputError for an unknown id, PhotoOutside for a photo elsewhere (`readable_view`).
    """
    from perception.photos.decode import load_photo

    best = gmap.best_view(instance_id)
    if best is None:
        return None
    view, box = best
    try:
        photo = load_photo(readable_view(gmap, view, photos), gmap.setting("photos", "max_side", MAX_SIDE))
    except PhotoOutside:
        raise
    except (InputError, OSError, ValueError, KeyError, TypeError):
        return None
    return cut_out(photo, box, side)


def readable_view(gmap: Map, view: View, photos: Path | None = None) -> View:
    """`view` with the real path of its photo. Raises InputError when the photo is missing or has changed, PhotoOutside
    when it is neither in the map's folder nor in `photos`, links followed; nothing is read elsewhere."""
    allowed = _allowed(gmap, view, photos)
    if not allowed:
        raise PhotoOutside(f"{view.name}: {OUTSIDE}")
    view = replace(view, photo_beside=None) if isinstance(view, StoredView) else view
    for file in allowed[:-1]:
        with suppress(InputError):  # missing, or another file
            return replace(view, photo=locate_photo(replace(view, photo=file), None))
    return gmap.with_photo(replace(view, photo=allowed[-1]))


def photos_outside(gmap: Map, photos: Path | None = None) -> str | None:
    """One line when photos of the map are not shown because of where they are; else None."""
    return None if all(_allowed(gmap, view, photos) for view in gmap.views) else f"{gmap.path}: {OUTSIDE}"


def _allowed(gmap: Map, view: View, photos: Path | None) -> list[Path]:
    """The real paths that the map states for a photo, of those in its folder or in `photos`, by name and by links."""
    folders = [folder for folder in (gmap.path, photos) if folder is not None]
    beside = getattr(view, "photo_beside", None)
    files = [*([] if beside is None or gmap.path is None else [gmap.path / beside]), view.photo]
    real = [folder.resolve() for folder in folders]
    allowed = []
    for file in files:
        with suppress(OSError, ValueError, RuntimeError):  # an invalid path, or a cycle of symbolic links
            if any(absolute(file).is_relative_to(folder) for folder in (*map(absolute, folders), *real)):
                allowed.append(file.resolve())
    return [file for file in allowed if any(file.is_relative_to(folder) for folder in real)]
