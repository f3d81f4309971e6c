"""Feature tracks of posed photos, from the verified matches of a COLMAP database, with the sensor's depth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from perception.photos.depth import load_depth
from perception.photos.lens import camera_from_lens, load_pycolmap
from perception.photos.views import view_lens
from perception.sfm.database import FeatureStore, verified_matches
from perception.types import View

FLAT = 0.03
"""Largest relative difference of depths around a feature: at an edge its depth is not known."""

MOST_POINTS = 20_000


@dataclass(frozen=True)
class Features:
    """F features of all photos. view [F]: index. rays [F, 2]: x/z, y/z in camera axes. focal [F]: pixels per ray unit.
    depth [F]: measured along the optical axis in scene units, 0 = none. pairs [M, 2]: matches that agree with one
    motion of the camera, whatever the given poses, in fixed order."""

    view: np.ndarray
    rays: np.ndarray
    focal: np.ndarray
    depth: np.ndarray
    pairs: np.ndarray


@dataclass(frozen=True)
class Tracks:
    """O observations of P points, sorted by point, no two in one view: view, point [O] indices; rest as Features."""

    view: np.ndarray
    point: np.ndarray
    rays: np.ndarray
    focal: np.ndarray
    depth: np.ndarray

    @property
    def size(self) -> int:
        """P, the number of points."""
        return int(self.point[-1]) + 1 if len(self.point) else 0


def features_of(views: list[View], store: FeatureStore) -> Features:
    """The matched features of `views` in `store`, which was made of the same photos in the same order."""
    with load_pycolmap().Database.open(store.database) as db:
        images = [db.read_image_with_name(name).image_id for name in store.names]
        keypoints = [np.asarray(db.read_keypoints(image), np.float64)[:, :2] for image in images]
    starts = dict(zip(images, np.cumsum([0, *map(len, keypoints)]), strict=False))
    matches = [np.empty((0, 2), np.int64)]
    for (a, b), found in verified_matches(store.database).items():
        matches.append(np.add(found, (starts[a], starts[b]), dtype=np.int64).reshape(-1, 2))
    pairs = np.concatenate(matches)
    view = np.repeat(np.arange(len(views)), [len(found) for found in keypoints])
    rays, focal, depth = (np.concatenate(part) for part in zip(*map(_measured, views, keypoints), strict=True))
    return Features(view, rays, focal, depth, pairs[np.isfinite(rays).all(1)[pairs].all(1)])


def _measured(view: View, keypoints: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """rays [F, 2], focal lengths [F] and depths [F] of the keypoints [F, 2] of a photo."""
    rays = np.asarray(camera_from_lens(view_lens(view)).cam_from_img(keypoints), np.float64).reshape(-1, 2)
    focal = np.full(len(rays), np.sqrt(view.K[0, 0] * view.K[1, 1]))
    depth = np.zeros(len(rays))
    if view.depth is not None:
        image = load_depth(view, view.width, view.height)
        pixel = np.nan_to_num(rays, nan=-1e9) * (view.K[0, 0], view.K[1, 1]) + view.K[:2, 2]
        inside = ((pixel >= 1) & (pixel < (view.width - 1, view.height - 1))).all(1)
        x, y = pixel[inside].astype(np.int64).T
        around = np.stack([image[y + dy, x + dx] for dy in (-1, 0, 1) for dx in (-1, 0, 1)])
        flat = (around.min(0) > 0) & (np.ptp(around, axis=0) <= FLAT * around.min(0))
        depth[inside] = np.where(flat, around[4], 0.0)
    return rays, focal, depth


def tracks_of(features: Features, pairs: np.ndarray) -> Tracks:
    """The tracks of the matches `pairs`, as `grouped` finds them."""
    return observed(features, *grouped(features, pairs))


def observed(features: Features, rows: np.ndarray, point: np.ndarray) -> Tracks:
    """The features `rows` [O] as observations of `point` [O], which ascends."""
    values = (getattr(features, name)[rows] for name in ("rays", "focal", "depth"))
    return Tracks(features.view[rows], point, *values)


def grouped(features: Features, pairs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Connected components of the matches `pairs`: features [O] and the component [O] of each, which ascends from 0.
    A view in which a component has two features is left out of it."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    view = features.view
    links = coo_matrix((np.ones(len(pairs), np.int8), pairs.T), shape=(len(view), len(view)))
    component = connected_components(links, directed=False)[1].astype(np.int64)
    _, group, count = np.unique(component * (view.max(initial=0) + 1) + view, return_inverse=True, return_counts=True)
    single = count[group] == 1
    single &= np.bincount(component, single)[component] >= 2
    kept = np.flatnonzero(single)
    kept = kept[np.argsort(component[kept], kind="stable")]
    return kept, np.unique(component[kept], return_inverse=True)[1]


def tracks_of_model(model: Any, views: list[View], names: dict[int, str], most: int = MOST_POINTS) -> Tracks:
    """At most `most` of the tracks of a COLMAP model, without depth. names: image id to name of the view."""
    number = {view.name: index for index, view in enumerate(views)}
    ids = sorted(model.points3D)
    rank = {point: row for row, point in enumerate(ids[:: max(1, -(-len(ids) // most))])}
    parts = [(np.empty((0, 2), np.int64), np.empty((0, 3)))]
    for image_id, name in names.items():
        if name not in number:
            continue
        image, camera = model.images[image_id], model.images[image_id].camera
        seen = [point for point in image.get_observation_points2D() if point.point3D_id in rank]
        found = np.array([point.xy for point in seen], np.float64).reshape(-1, 2)
        rays = np.asarray(camera.cam_from_img(found), np.float64).reshape(-1, 2)
        index = np.array([(rank[point.point3D_id], number[name]) for point in seen], np.int64).reshape(-1, 2)
        good = np.isfinite(rays).all(axis=1)
        parts.append((index[good], np.c_[rays, np.full(len(rays), camera.mean_focal_length())][good]))
    index, values = (np.concatenate(part) for part in zip(*parts, strict=True))
    order = np.unique(index, axis=0, return_index=True)[1]  # sorted by point, then by view, each once
    point = np.unique(index[order, 0], return_inverse=True)[1]
    return Tracks(index[order, 1], point, values[order, :2], values[order, 2], np.zeros(len(order)))
