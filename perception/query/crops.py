"""Crops of instances from the photos that show them best."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from perception.errors import InputError
from perception.io.map import Map
from perception.io.map_views import locate_photo
from perception.query.query_map import QueryMap, UnknownInstance
from perception.types import View

MARGIN = 0.15
"""Margin around the bounding box, as a share of its longer side."""


def best_crop(
    gmap: QueryMap, instance_id: int, side: int = 320, folders: Sequence[Path] | None = None
) -> np.ndarray | None:
    """The crop of an instance from its best photo, [h, w, 3] uint8 RGB, longer side at most `side` pixels.

    None when no photo shows the instance or its photo is missing or unreadable. InputError for an unknown id.
    folders: where photos may be read, None = anywhere. An untrusted map may name any file as its photo, so
    UnknownInstance is raised for a photo outside these folders. Symbolic links are resolved first.
    """
    from perception.io.photos import load_photo

    position = gmap.position(instance_id)
    box = gmap.best_view(position)
    if box is None:
        return None
    name, (x0, y0, x1, y1) = box
    view = next((view for view in gmap.views if view.name == name), None)
    if view is None:
        return None
    try:
        photo = load_photo(readable_view(gmap, view, folders), int(gmap.info["config"]["photos"]["max_side"]))
    except UnknownInstance:
        raise
    except (InputError, OSError, ValueError, KeyError):
        return None
    margin = 2 + round(MARGIN * max(x1 - x0, y1 - y0))
    top, left = max(0, y0 - margin), max(0, x0 - margin)
    cut = photo[top : y1 + margin, left : x1 + margin]
    return _shrunk(cut, side) if cut.size else None


def folders_needed(gmap: QueryMap, folders: Sequence[Path]) -> list[Path]:
    """The folders with photos of the map that are neither among `folders` nor below one of them, sorted."""
    needed = set()
    for view in gmap.views:
        with suppress(OSError, ValueError, RuntimeError):
            photo = locate_photo(view, gmap.path).resolve()
            if not _is_below(photo, folders):
                needed.add(photo.parent)
    return sorted(needed)


def _is_below(real: Path, folders: Sequence[Path]) -> bool:
    return any(real.is_relative_to(folder.resolve()) for folder in folders)


def readable_view(gmap: Map, view: View, folders: Sequence[Path] | None) -> View:
    """`view` with the path of its photo, symbolic links resolved if `folders` are given. Raises InputError when the
    photo is missing, UnknownInstance when it is not a file below one of `folders` (None: anywhere)."""
    located = gmap.with_photo(view)
    if folders is None:
        return located
    try:
        real = located.photo.resolve()
        known = _is_below(real, folders) and real.is_file()
    except (OSError, ValueError, RuntimeError):  # an invalid path, or a cycle of symbolic links
        known = False
    if not known:
        raise UnknownInstance(f"{view.name}: this photo is not in the map's folder nor in --photos DIR")
    return replace(located, photo=real)


def _shrunk(picture: np.ndarray, side: int) -> np.ndarray:
    import cv2

    height, width = picture.shape[:2]
    scale = min(1.0, side / max(height, width))
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    return picture if scale == 1 else np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA))
