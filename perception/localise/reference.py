"""The map's side of localisation: features of its photos, or of renders where a photo is gone, with points in space."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np

from perception.errors import InputError
from perception.localise.keypoints import Described, described, tolerance, triangulated
from perception.machine import refuse_full_disk
from perception.map.map import MAX_SIDE, Map
from perception.photos.decode import scaled_K, scaled_size, why_left_out
from perception.photos.views import view_lens
from perception.posed.bundle_adjustment import Poses
from perception.posed.pose_refinement import agreeing, poses_of
from perception.progress import Progress
from perception.sfm.database import build_features
from perception.sfm.options import ReadOptions
from perception.sfm.tracks import features_of, grouped
from perception.types import View

Locate = Callable[[View], View]
"""The view with the path of its photo; InputError when it is not at hand."""


@dataclass(frozen=True)
class Reference:
    """views: of the map, with the pictures that were used. rendered: names of those without a photo. described: their
    features; its pairs agree with the poses. point [F]: of each feature, −1 = none. points [P, 3] in the map's frame.
    """

    views: list[View]
    rendered: list[str]
    described: Described
    poses: Poses
    point: np.ndarray
    points: np.ndarray


def open_reference(gmap: Map, locate: Locate, progress: Progress) -> Reference:
    """Reads or renders the pictures of all views of a map, and triangulates their matched features with the map's poses
    held. InputError for a map without views."""
    if not gmap.views:
        raise InputError(f"{gmap.path}: holds no views, so photos cannot be localised in it; map it from photos")
    with TemporaryDirectory(prefix="perception-localise-") as folder:
        refuse_full_disk(Path(folder).parent)
        views, rendered = _pictures(gmap, locate, Path(folder), progress)
        lenses, masks = [view_lens(view) for view in views], [view.mask for view in views]
        options = ReadOptions(Path(folder), progress=progress)
        photos, stored = [view.photo for view in views], [view.as_stored for view in views]
        store = build_features(photos, list(lenses), options, masks, posed=True, as_stored=stored)
        features = features_of(views, store)
        poses = poses_of(views)
        if len(features.pairs):
            features = replace(features, pairs=features.pairs[agreeing(features, poses)])
        found = described(features, store)
    most = tolerance(max(max(lens.width, lens.height) for lens in lenses))
    rows, number, points = triangulated(features, *grouped(features, features.pairs), poses, most)
    point = np.full(len(features.view), -1, np.int64)
    point[rows] = number
    return Reference(views, rendered, found, poses, point, points)


def _pictures(gmap: Map, locate: Locate, folder: Path, progress: Progress) -> tuple[list[View], list[str]]:
    """The views with their photos, or with renders in `folder`, and the names of the latter."""
    views, rendered = list[View](), list[str]()
    for number, view in enumerate(gmap.views):
        try:
            found = locate(view)
            if why := why_left_out(found.photo):
                raise InputError(why)
            views.append(_at_hand(found))
        except InputError:
            views.append(_rendered(gmap, view, folder / f"render-{number}.png"))
            rendered.append(view.name)
            progress.update("localise: rendering views without a photo", number + 1, len(gmap.views))
    return views, rendered


def _at_hand(view: View) -> View:
    """The view without a depth image or mask that is gone."""
    depth = view.depth if view.depth is not None and view.depth.path.is_file() else None
    return replace(view, depth=depth, mask=view.mask if view.mask is not None and view.mask.is_file() else None)


def _rendered(gmap: Map, view: View, file: Path) -> View:
    """The view with the map's own picture of it, written to `file`, at the size the map was trained at."""
    import torch

    from perception.gaussians.model import as_gaussians
    from perception.gaussians.views import rgb_image

    width, height = scaled_size(view, gmap.setting("photos", "max_side", MAX_SIDE))
    K = scaled_K(view, width, height)
    pose, camera = (torch.from_numpy(np.asarray(matrix, np.float32)) for matrix in (view.camera_from_world, K))
    write_rgb(file, rgb_image(as_gaussians(gmap), pose, camera, width, height))
    return View(view.name, file, K, width, height, view.camera_from_world)


def write_rgb(file: Path, picture: np.ndarray) -> Path:
    """Writes [h, w, 3] uint8 RGB as PNG. InputError for another array."""
    if picture.dtype != np.uint8 or picture.ndim != 3 or picture.shape[2] != 3 or picture.size == 0:
        raise InputError(f"photo: found {picture.dtype} {list(picture.shape)}, expected uint8 [h, w, 3] RGB")
    file.write_bytes(cv2.imencode(".png", np.ascontiguousarray(picture[..., ::-1]))[1].tobytes())
    return file
