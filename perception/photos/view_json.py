"""The views of a map as stored in map.json, one JSON object per view, and how their photos are located.

name, K, width, height, camera_from_world, lens, held_out: as in `types.View`. photo: absolute path of the photo.
photo_beside: its path relative to the map's folder. photo_bytes: its size in bytes; a file of another size is not
accepted. The last two may be null. as_stored: true where EXIF rotation is not applied. visit: number of the visit that
took it (see `map.history`), 0 when it is missing.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from annotated_types import Len
from pydantic import AfterValidator, Field, Strict

from perception.errors import InputError
from perception.io.atomic import pointed
from perception.io.json_shapes import (
    Bytes,
    Count,
    Intrinsics,
    Number,
    PathText,
    PhotoName,
    Pose,
    Positive,
    Side,
    Text,
    check,
    typed,
)
from perception.types import DepthImage, Lens, View

MOST_PIXELS = 4 * 10**8
"""Of a view: no photo with more is read."""


def _pixels(view: dict[str, Any]) -> dict[str, Any]:
    if view["width"] * view["height"] > MOST_PIXELS:
        raise ValueError(f"expected at most {MOST_PIXELS} pixels")
    return view


_LENS = Annotated[tuple[Text, list[Number], Side, Side], Strict(False)]
_DEPTH = Annotated[tuple[PathText, Positive, _LENS | None], Strict(False)]
_GAIN = Annotated[list[Annotated[float, Field(gt=0, lt=1e3)]], Len(3, 3)]
_VIEW = {
    "name": PhotoName, "photo": PathText, "K": Intrinsics, "width": Side, "height": Side, "camera_from_world": Pose,
    "lens?": _LENS | None, "held_out?": bool, "photo_beside?": PathText | None, "photo_bytes?": Bytes | None,
    "depth?": _DEPTH | None, "mask?": PathText | None, "gain?": _GAIN | None, "as_stored?": bool, "visit?": Count,
}  # fmt: skip
VIEW: Any = Annotated[typed(_VIEW), AfterValidator(_pixels)]
"""A view in map.json."""


@dataclass(frozen=True)
class StoredView(View):
    """A view with the photo record of a map; the fields are described in the module docstring."""

    photo_beside: str | None = None
    photo_bytes: int | None = None
    visit: int = 0

    @property
    def photo_name(self) -> str:
        """The name among the photos of its visit, before which `perception update` puts the visit."""
        return self.name.partition("/")[2] if self.visit else self.name


def stored_view(view: View, folder: Path, held_out: bool = False, visit: int = 0) -> StoredView:
    """`view` with the record of its photo for the map at `folder`: both paths, and the size (None if missing)."""
    photo = absolute(view.photo)  # links are kept: the user names his photos by them
    record = {"photo": photo, "photo_beside": _relative(photo, folder), "photo_bytes": _bytes(photo), "visit": visit}
    return StoredView(**vars(view) | record | {"held_out": held_out, "depth": None, "mask": None})


def moved_record(view: StoredView, before: Path, after: Path) -> StoredView:
    """The record of a map at `before`, for a map at `after`: the relative photo path is adapted."""
    if view.photo_beside is None or absolute(pointed(before)) == absolute(pointed(after)):
        return view
    return replace(view, photo_beside=_relative(absolute(pointed(before) / view.photo_beside), after))


def locate_photo(view: View, folder: Path | None) -> Path:
    """The path of the photo of `view`: relative to the map, else its absolute path when the map was made.
    folder: of the map, None when it is not on disk. InputError when there is no file, or only one of another size."""
    paths, size = [Path(view.photo)], view.photo_bytes if isinstance(view, StoredView) else None
    if isinstance(view, StoredView) and folder is not None and view.photo_beside is not None:
        paths.insert(0, absolute(pointed(folder) / view.photo_beside))
    sizes = {path: found for path in paths if (found := _bytes(path)) is not None}
    for path, found in sizes.items():
        if size in (None, found):
            return path
    others = [f"{path}: has {found} bytes, the photo of the map had {size}" for path, found in sizes.items()]
    wrong = (others or [f"{paths[0]}: the photo is missing"])[0]
    raise InputError(f"{wrong}; give the folder of the photos: perception relink")


def _bytes(path: Path) -> int | None:
    """The size of a file; None where there is none that can be reached."""
    try:
        return path.stat().st_size if path.is_file() else None
    except OSError:
        return None


def absolute(path: Path) -> Path:
    """`path` absolute and without "..", symbolic links kept."""
    return Path(os.path.abspath(path))  # noqa: PTH100


def _relative(photo: Path, folder: Path) -> str:
    return os.path.relpath(photo, absolute(pointed(folder)))


def view_json(view: View) -> dict[str, Any]:
    """A view as JSON, with the photo record if `view` is a `StoredView`, and its depth, mask and gain if it has any."""
    entry = {
        "name": view.name,
        "photo": str(absolute(view.photo)),
        "K": np.asarray(view.K).tolist(),
        "width": view.width,
        "height": view.height,
        "camera_from_world": np.asarray(view.camera_from_world).tolist(),
        "lens": _lens_json(view.lens),
    }
    if isinstance(view, StoredView):
        entry |= {name: getattr(view, name) for name in ("held_out", "photo_beside", "photo_bytes")}
    others = {
        "held_out": view.held_out,
        "visit": getattr(view, "visit", 0),
        "as_stored": view.as_stored,
        "depth": view.depth and [str(absolute(view.depth.path)), view.depth.scale, _lens_json(view.depth.lens)],
        "gain": view.gain and list(view.gain),
        "mask": view.mask and str(absolute(view.mask)),
    }
    return entry | {name: value for name, value in others.items() if value}


def view_from_json(entry: dict[str, Any]) -> StoredView:
    """The inverse of `view_json`. ValueError for an invalid entry."""
    check(VIEW, entry)
    depth, mask, gain = map(entry.get, ("depth", "mask", "gain"))
    plain = ("name", "width", "height", "held_out", "as_stored", "photo_beside", "photo_bytes", "visit")
    return StoredView(
        photo=Path(entry["photo"]),
        K=np.array(entry["K"], np.float64),
        camera_from_world=np.array(entry["camera_from_world"], np.float64),
        lens=_lens_of(entry.get("lens")),
        depth=None if depth is None else DepthImage(Path(depth[0]), float(depth[1]), _lens_of(depth[2])),
        mask=None if mask is None else Path(mask),
        gain=None if gain is None else (float(gain[0]), float(gain[1]), float(gain[2])),
        **{name: entry[name] for name in plain if name in entry},
    )


def _lens_json(lens: Lens | None) -> list[Any] | None:
    return None if lens is None else [lens.model, list(lens.params), lens.width, lens.height]


def _lens_of(entry: list[Any] | None) -> Lens | None:
    return None if entry is None else Lens(entry[0], tuple(map(float, entry[1])), *entry[2:])


def refuse_other_frame(
    file: Path, data: dict[str, Any], info: dict[str, Any], views: Sequence[View], todo: str
) -> None:
    """InputError where `data` in a file have the `frame_facts` of a map that has had another unit since, or of another
    one. info: of its map.json; views: of the map."""
    now = frame_facts(info, views)
    differ = [key for key, value in now.items() if key in data and data[key] != value]
    if differ:
        found = "another unit than the map has now" if differ != ["frame_id"] else "the frame of another map"
        raise InputError(f"{file}: is in {found}; {todo}")


def frame_facts(info: dict[str, Any], views: Sequence[View]) -> dict[str, Any]:
    """What map.json records of the unit, and `frame_id`: where the map's first visit took its photos, as a hash. No
    correction, update or upgrade of a map changes it."""
    poses = [v.camera_from_world for v in views if not (isinstance(v, StoredView) and v.visit)]
    digest = hashlib.sha256(np.array(poses, np.float64).tobytes()).hexdigest()[:12]
    return {"metric": info.get("metric", False), "scale": info.get("scale"), "frame_id": digest}
