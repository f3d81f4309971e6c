"""Crops of instances from the photos that show them best."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from perception.errors import InputError
from perception.map.map import MAX_SIDE, Map
from perception.query.query_map import QueryMap
from perception.query.requests import UnknownInstance
from perception.types import View

MARGIN = 0.15
"""Margin around the bounding box, as a share of its longer side."""


def best_crop(gmap: QueryMap, instance_id: int, side: int = 320, inside: Path | None = None) -> np.ndarray | None:
    """The crop of an instance from its best photo, [h, w, 3] uint8 RGB, longer side at most `side` pixels.

    None when no photo shows the instance or its photo is missing or unreadable. InputError for an unknown id.
    inside: the folder where photos may be read, None = anywhere. An untrusted map may name any file as its photo, so
    UnknownInstance is raised for a photo outside this folder. Symbolic links are resolved first.
    """
    from perception.photos.decode import load_photo

    found = gmap.best_view(instance_id)
    if found is None:
        return None
    try:
        photo = load_photo(readable_view(gmap, found[0], inside), gmap.setting("photos", "max_side", MAX_SIDE))
    except UnknownInstance:
        raise
    except (InputError, OSError, ValueError, KeyError):
        return None
    return cut_out(photo, found[1], side)


def cut_out(picture: np.ndarray, box: tuple[int, int, int, int], side: int) -> np.ndarray | None:
    """The box (x0, y0, x1, y1) of a picture [H, W, 3] with a margin, longer side at most `side`; None outside of it."""
    x0, y0, x1, y1 = box
    margin = 2 + round(MARGIN * max(x1 - x0, y1 - y0))
    top, left = max(0, y0 - margin), max(0, x0 - margin)
    cut = picture[top : y1 + margin, left : x1 + margin]
    if not cut.size:
        return None
    height, width = cut.shape[:2]
    scale = min(1.0, side / max(height, width))
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    return cut if scale == 1 else np.asarray(cv2.resize(cut, size, interpolation=cv2.INTER_AREA))


def readable_view(gmap: Map, view: View, inside: Path | None) -> View:
    """`view` with the path of its photo, symbolic links resolved if `inside` is given. Raises InputError when the
    photo is missing, UnknownInstance when it is not a file below `inside` (None: anywhere)."""
    located = gmap.with_photo(view)
    if inside is None:
        return located
    try:
        real = located.photo.resolve()
        known = real.is_relative_to(inside.resolve()) and real.is_file()
    except (OSError, ValueError, RuntimeError):  # an invalid path, or a cycle of symbolic links
        known = False
    if not known:
        raise UnknownInstance(f"{view.name}: this photo is not in the map's folder")
    return replace(located, photo=real)
