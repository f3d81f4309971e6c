"""Poses of a photo between which its matches leave the choice, and those that the photos refute.

Where parts of a scene repeat, e.g. opposite walls, some matches give a photo one pose and others another, and the
wrong ones may be more. What does not repeat looks alike at the right pose only.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from perception.photos.lens import load_pycolmap
from perception.sfm.appearance import SURE, Looks, Photo, loaded, looks_better
from perception.sfm.consistency import EPIPOLAR_TOLERANCE
from perception.sfm.database import FeatureStore, verified_matches
from perception.sfm.pairs import stored_features

POINTS, FEWEST, ALONE = 30, 5, 8
"""Least number of points of a model by which a photo is posed, and by which a pair counts; partners whose points are
tried alone."""
HALF, ALIKE = 0.5, 0.75
"""Least share of a pair's points that agree with a pose, and least likeness where the model has a photo; and where it
is new. Right poses read 0.5 to 1.9, wrong ones up to 0.7."""
Pairs = set[tuple[int, int]]
Links = dict[int, tuple[np.ndarray, np.ndarray]]
"""By partner: pixels [N, 2] of a photo's features that match the partner's, and the ids [N] of the partner's points."""


def settled(model: Any, store: FeatureStore, known: Pairs, seed: int) -> tuple[Any, Pairs]:
    """A model without points of new photos, each where it looks clearly more like those of a pycolmap model than at its
    other poses; and the verified pairs that put these or the model's own photos at such others.
    known: pairs that do. They propose no poses, and what they match is not compared, either."""
    pycolmap = load_pycolmap()
    links, every, pairs = _links(model, store), set(model.reg_image_ids()), Pairs()
    placed, looks = pycolmap.Reconstruction(), Looks.of(model, store.image_root, every)
    with pycolmap.Database.open(store.database) as db:
        images = {image: db.read_image(image) for image in links}
        cameras = {each.camera_id: db.read_camera(each.camera_id) for each in images.values()}
    cameras |= {number: model.cameras[number] for number in cameras if number in model.cameras}
    for image, mine in sorted(links.items()):
        proposed = {i: each for i, each in mine.items() if (min(i, image), max(i, image)) not in known}
        camera, own = cameras[images[image].camera_id], [looks.photos[image]] if image in every else []
        found = [*own, *_poses(camera, proposed, own, looks.xyz, seed)]
        if len(found) < 2:
            continue
        gray = own[0].gray if own else loaded(store.image_root / images[image].name)
        found = [replace(each, gray=gray, points=_fitting(each, mine, looks.xyz)) for each in found]
        best = _clear(found, looks, every - {image}, HALF if own else ALIKE)
        if best is None or (own and best is not found[0]):
            continue
        wrong = set(proposed) - _agreeing(best, proposed, looks.xyz)
        pairs |= {(min(image, partner), max(image, partner)) for partner in wrong}
        if not own:
            if camera.camera_id not in placed.cameras:
                placed.add_camera_with_trivial_rig(camera)
            plain = pycolmap.Image(name=images[image].name, camera_id=camera.camera_id, image_id=image)
            placed.add_image_with_trivial_frame(plain, pycolmap.Rigid3d(best.pose))
    return placed, pairs


def _clear(found: list[Photo], looks: Looks, others: set[int], least: float) -> Photo | None:
    """The pose that looks clearly better than the others, if there is one and it looks right."""
    alike = [looks.likeness([each], others) for each in found]
    best = max(range(len(found)), key=lambda k: alike[k][0] / (alike[k][1] + SURE))
    clear = all(looks_better(alike[best], each) for k, each in enumerate(alike) if k != best)
    return found[best] if clear and alike[best][0] > least * alike[best][1] else None


def _links(model: Any, store: FeatureStore) -> dict[int, Links]:
    """Of each photo with features, its matches with points of registered photos."""
    features = {image: model.images[image].points2D for image in model.reg_image_ids()}
    points = {i: np.array([p.point3D_id if p.has_point3D() else -1 for p in at]) for i, at in features.items()}
    with load_pycolmap().Database.open(store.database) as db:
        ids = [db.read_image_with_name(name).image_id for name in store.names]
    pixels = {i: each[0] for i, each in zip(ids, stored_features(store.database, store.names), strict=True)}
    links: dict[int, Links] = {}
    for pair, found in verified_matches(store.database).items():
        for side in (0, 1) if len(found) else ():
            image, partner = pair[side], pair[1 - side]
            if partner in points:
                there = points[partner][found[:, 1 - side]]
                if (there >= 0).sum() >= FEWEST:
                    links.setdefault(image, {})[partner] = pixels[image][found[there >= 0, side]], there[there >= 0]
    return links


def _poses(camera: Any, links: Links, own: list[Photo], xyz: dict[int, np.ndarray], seed: int) -> list[Photo]:
    """Where the matches of `links` put a photo besides its `own` pose: that with most points, then those of partners
    that agree with none before."""
    pycolmap, found = load_pycolmap(), list[Photo]()
    known = set[int]().union(*(_agreeing(each, links, xyz) for each in own))
    left = {i: each for i, each in links.items() if i not in known}
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac.max_error = _most(camera)
    options.ransac.random_seed = seed
    while left:
        largest = sorted(left, key=lambda i: (-len(left[i][1]), i))[:ALONE]
        tried = []
        for some in (sorted(left), *([i] for i in largest)):
            pixels, ids = (np.concatenate([left[i][k] for i in some]) for k in (0, 1))
            points = np.array([xyz[i] for i in ids.tolist()])
            made = pycolmap.estimate_and_refine_absolute_pose(pixels, points, camera, options)
            if made is not None:
                tried.append(Photo(np.zeros((1, 1)), camera, made["cam_from_world"].matrix(), {}))
        counts = [sum(_fits(each, *left[i], xyz).sum() for i in left) for each in tried]
        best = tried[int(np.argmax(counts))] if max(counts, default=0) >= POINTS else None
        agree = _agreeing(best, left, xyz) if best else set[int]()
        if best is None or not agree:
            break
        found.append(best)
        left = {i: each for i, each in left.items() if i not in agree}
    return found


def _fitting(photo: Photo, links: Links, xyz: dict[int, np.ndarray]) -> dict[int, np.ndarray]:
    """The points of a photo, and the others of `links` that lie where it shows them."""
    fits = [(ids[ok], at[ok]) for at, ids in links.values() if (ok := _fits(photo, at, ids, xyz)).any()]
    return photo.points | {n: pixel for ids, at in fits for n, pixel in zip(ids.tolist(), at, strict=True)}


def _agreeing(photo: Photo, links: Links, xyz: dict[int, np.ndarray]) -> set[int]:
    """Partners of whose points at least HALF lie where the photo shows them."""
    return {i for i, each in links.items() if _fits(photo, *each, xyz).mean() >= HALF}


def _fits(photo: Photo, pixels: np.ndarray, ids: np.ndarray, xyz: dict[int, np.ndarray]) -> np.ndarray:
    """Which points [N] lie at `pixels`."""
    points = np.array([xyz[i] for i in ids.tolist()]).reshape(-1, 3) @ photo.pose[:, :3].T + photo.pose[:, 3]
    found = np.asarray(photo.camera.img_from_cam(points)).reshape(-1, 2)
    return np.asarray((points[:, 2] > 0) & (np.linalg.norm(found - pixels, axis=1) < _most(photo.camera)))


def _most(camera: Any) -> float:
    """Pixels up to which a point agrees."""
    return max(4.0, 2 * EPIPOLAR_TOLERANCE * camera.mean_focal_length())
