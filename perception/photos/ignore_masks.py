"""Masks of pixels to ignore (people, the robot's own arm): black (0) is ignored, everything else is used.

As in COLMAP and nerfstudio. They keep pixels out of features, label images, losses and scores.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np

from perception.errors import InputError
from perception.photos.decode import nearest, photo_size, read_picture, warp_labels
from perception.photos.lens import same_aspect
from perception.photos.named_files import NamedFiles
from perception.types import Scene, View

LEAST_USED = 1e-3
"""Share of the pixels from which a photo says something: fewer may all be lost when it is made smaller."""


def mask_of(folder: Path | None, name: str) -> Path | None:
    """The mask of photo `name` in `folder`: "a/1.png" or "a/1.jpg.png" for "a/1.jpg"; None without one."""
    if folder is None or not folder.is_dir():
        return None
    names = (str(Path(name).with_suffix(".png")), f"{name}.png")
    exact = next((folder / name for name in names if (folder / name).is_file()), None)
    return exact or next(filter(None, map(_files_in(folder, folder.stat().st_mtime_ns).find, names)), None)


@lru_cache(maxsize=4)
def _files_in(folder: Path, changed: int) -> NamedFiles:
    """The files of a folder that was `changed` then: listed once, not for each photo without a mask."""
    return NamedFiles(folder)


def read_mask(path: Path, width: int, height: int) -> np.ndarray:
    """[height, width] uint8, 255 = used, 0 = ignored; a mask of another resolution is sampled at the nearest pixel.
    Ignored are pixels that are black in all channels, or transparent. InputError for a file that is missing, no image,
    or of another aspect ratio."""
    image = read_picture(path, path, "mask; expected a PNG in which black (0) pixels are ignored")
    channels = image.reshape(*image.shape[:2], -1)
    used: np.ndarray = np.any(channels[..., :3] > 0, axis=2)
    if channels.shape[2] in (2, 4):
        used &= channels[..., -1] > 0
    rows, columns = used.shape
    if not same_aspect((columns, rows), (width, height)):
        raise InputError(f"{path}: the mask is {columns}×{rows}, its photo {width}×{height}; expected the same shape")
    return nearest(used, width, height).astype(np.uint8) * 255


def load_weight(view: View, width: int, height: int) -> np.ndarray | None:
    """Weight [height, width] float32 of the pixels of the view's pinhole: 1 = used, 0 = ignored; None without mask."""
    if view.mask is None:
        return None
    return (warp_labels(view, read_mask(view.mask, *view.photo_size), width, height) > 0).astype(np.float32)


def stage_masks(
    folder: Path,
    photos: list[Path],
    names: list[str],
    masks: list[Path | None],
    as_stored: Sequence[bool] | None = None,
) -> None:
    """Writes the masks into the new `folder` as COLMAP names them ("NAME.png"), white for photos without a mask.
    as_stored: as of `stage_photos`."""
    folder.mkdir()
    for photo, name, mask, stored in zip(photos, names, masks, as_stored or [False] * len(photos), strict=True):
        width, height = photo_size(photo, stored)
        used = np.full((height, width), 255, np.uint8) if mask is None else read_mask(mask, width, height)
        (folder / f"{name}.png").write_bytes(cv2.imencode(".png", used)[1].tobytes())


def with_checked_masks(scene: Scene, folder: Path | None) -> Scene:
    """The scene without the photos of which their masks leave under LEAST_USED, and a note on what is ignored.
    folder: of masks, as the user named it. InputError when it holds none for these photos, a mask is unreadable, or
    nothing is left."""
    masked = [view for view in scene.views if view.mask is not None]
    if folder is not None and not masked:
        raise InputError(
            f"{folder}: holds no mask for any of the {len(scene.views)} photos; expected a PNG of the same stem, such "
            f"as {Path(scene.views[0].name).with_suffix('.png')}, in which black (0) pixels are ignored"
        )
    if not masked:
        return scene
    weights = ((view.name, load_weight(view, view.width, view.height)) for view in masked)
    used = {name: float(weight.mean()) for name, weight in weights if weight is not None}
    views = [view for view in scene.views if used.get(view.name, 1.0) >= LEAST_USED]
    if not views:
        raise InputError(f"{masked[0].mask}: this and all other masks are black (0 = ignored); are they inverted?")
    black = [view for view in masked if used[view.name] < LEAST_USED]
    what = {view.name: f"all but {used[view.name]:.1g} of the" if used[view.name] else "all" for view in black}
    out = [{"name": view.name, "why": f"{view.mask}: ignores {what[view.name]} pixels"} for view in black]
    share = 1.0 - float(np.mean(list(used.values())))
    note = f"masks: {share:.1%} of the pixels of {len(masked)} of {len(scene.views)} photos are ignored"
    facts = {"notes": [*scene.report.get("notes", []), note], "left_out": [*scene.report.get("left_out", []), *out]}
    return replace(scene, views=views, report={**scene.report, **facts})
