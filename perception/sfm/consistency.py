"""Checks of models against the verified matches of their photos.

Repeated textures can merge different parts of a scene although nearly every photo registers. The matches of each
verified pair satisfy one epipolar geometry, which the model either agrees with or contradicts.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from networkx.utils import UnionFind
from scipy.spatial import cKDTree

from perception.sfm.database import verified_matches

MAX_UNREGISTERED, MAX_SECOND_MODEL, MAX_CONTRADICTED, MAX_UNMATCHED = 0.15, 0.30, 0.005, 0.30
MOST_CONTRADICTED = 4
"""Pairs. Right models of up to 1,200 photos had none, two wrong ones of 1,200 photos 14 and 35 of 18,887."""
NEAR, TURN, FEWEST = 0.1, 15.0, 5
"""Of photos at one position that look the same way: their distance relative to depth, and degrees between their axes.
Least number of pairs from which a fold is concluded."""
EPIPOLAR_TOLERANCE, TOLERANCE_PIXELS = 4.0 / 1000, 4.0
"""Largest Sampson distance of a match that agrees, in normalised image coordinates; TOLERANCE_PIXELS (the error that
verification allows) divided by the focal length where that is larger."""


@dataclass(frozen=True)
class Pair:
    """Two registered photos with `inliers` verified matches; `share` of them satisfy the model's epipolar geometry."""

    i: int
    j: int
    inliers: int
    share: float

    @property
    def agrees(self) -> bool:
        """Whether at least half of the matches satisfy the model's epipolar geometry."""
        return self.share >= 0.5


def model_warnings(models: list[Any], database: Path, photos: int) -> list[str]:
    """Warnings, one line each, on pycolmap models sorted by size, of which models[0] is used; photos: number."""
    best = models[0]
    warnings = []
    registered = best.num_reg_images()
    if registered < (1 - MAX_UNREGISTERED) * photos:
        warnings.append(f"only {registered} of {photos} photos are registered")
    if len(models) > 1 and models[1].num_reg_images() > MAX_SECOND_MODEL * registered:
        sizes = ", ".join(str(model.num_reg_images()) for model in models)
        split = f"the photos split into {len(models)} unconnected models ({sizes}); the largest is mapped"
        warnings.append(f"{split}; for another, put the photos that are left out into a folder of their own")
    return warnings + fold_warnings(best, database)


def fold_warnings(model: Any, database: Path) -> list[str]:
    """Warnings, one line each, that different parts of the scene may lie on top of each other in a pycolmap model."""
    pairs, warnings = verified_pairs(model, database), []
    if len(pairs) >= FEWEST and is_contradicted(pairs):
        wrong = f"{len(stronger_contradictions(pairs))} of {len(pairs)} matched photo pairs contradict the model"
        warnings.append(f"{wrong} and are stronger than the pairs it rests on: it may be folded (equal textures?)")
    unmatched, near = _unmatched_neighbors(model, {(pair.i, pair.j) for pair in pairs})
    if near >= FEWEST and unmatched > MAX_UNMATCHED * near:
        alike = f"{unmatched} of {near} photo pairs that the model puts at one position, looking the same way"
        warnings.append(f"{alike}, do not match: it may be folded (equal textures?)")
    return warnings


def stronger_contradictions(pairs: list[Pair]) -> list[Pair]:
    """The contradicted pairs whose photos are not connected by agreeing pairs that are all at least as strong.
    Repeated textures also give verified pairs, so a contradicted pair alone is not an error. It is one if the model
    depends on weaker pairs instead."""
    connected, found = UnionFind(), []
    for pair in sorted(pairs, key=lambda p: (-p.inliers, not p.agrees)):
        if pair.agrees:
            connected.union(pair.i, pair.j)
        elif connected[pair.i] != connected[pair.j]:
            found.append(pair)
    return found


def is_contradicted(pairs: list[Pair]) -> bool:
    """Whether a share of over MAX_CONTRADICTED of the pairs, or over MOST_CONTRADICTED, contradict and are stronger."""
    return len(stronger_contradictions(pairs)) > min(MAX_CONTRADICTED * len(pairs), MOST_CONTRADICTED)


def outvoted_photos(pairs: list[Pair]) -> set[int]:
    """Photos most of whose verified matches lie in pairs that contradict the model."""
    votes = Counter[int]()
    for pair in pairs:
        votes.update(dict.fromkeys((pair.i, pair.j), pair.inliers if pair.agrees else -pair.inliers))
    return {image for image, vote in votes.items() if vote < 0}


def consistent_photos(pairs: list[Pair]) -> set[int]:
    """The largest set of photos of a model that no contradicted pair divides, each with more agreeing pairs than not.

    From the strongest pair to the weakest, an agreeing pair joins the sets of its photos and a contradicted one forbids
    that they are joined (Wolf et al., "The mutex watershed", ECCV 2018).
    """
    members: dict[int, set[int]] = {image: {image} for pair in pairs for image in (pair.i, pair.j)}
    apart: dict[int, set[int]] = {image: set() for image in members}
    """By photo, those that may not be in its set."""
    for pair in sorted(pairs, key=lambda p: (-p.inliers, not p.agrees)):
        one, other = members[pair.i], members[pair.j]
        if one is other:
            continue
        if not pair.agrees:
            apart[pair.i].add(pair.j)
            apart[pair.j].add(pair.i)
        elif not any(apart[image] & other for image in one):
            one |= other
            members |= dict.fromkeys(other, one)
    kept = max(members.values(), key=lambda images: (len(images), -min(images)), default=set())
    while wrong := {image for image, votes in _votes(pairs, kept).items() if votes <= 0}:
        kept = kept - wrong
    return kept


def _votes(pairs: list[Pair], photos: set[int]) -> dict[int, int]:
    """Of each photo, the agreeing pairs less the contradicted ones, among `photos`."""
    votes = dict.fromkeys(photos, 0)
    for pair in pairs:
        if pair.i in photos and pair.j in photos:
            votes[pair.i] += 1 if pair.agrees else -1
            votes[pair.j] += 1 if pair.agrees else -1
    return votes


def verified_pairs(model: Any, database: Path) -> list[Pair]:
    """The verified pairs between registered photos, judged by the model."""
    registered = {i: model.images[i] for i in model.reg_image_ids()}
    poses = {i: image.cam_from_world().matrix() for i, image in registered.items()}
    rays = {i: _normalised(image) for i, image in registered.items()}
    pairs = []
    for (i, j), found in verified_matches(database).items():
        if i in registered and j in registered and len(found):
            distance = _sampson(rays[i][found[:, 0]], rays[j][found[:, 1]], poses[i], poses[j])
            focal = min(registered[image].camera.mean_focal_length() for image in (i, j))
            agree = distance < max(EPIPOLAR_TOLERANCE, TOLERANCE_PIXELS / focal)
            pairs.append(Pair(i, j, len(found), float(agree.mean())))
    return pairs


def _normalised(image: Any) -> np.ndarray:
    pixels = np.array([point.xy for point in image.points2D], dtype=np.float64).reshape(-1, 2)
    return np.c_[np.asarray(image.camera.cam_from_img(pixels)).reshape(-1, 2), np.ones(len(pixels))]


def _sampson(a: np.ndarray, b: np.ndarray, a_from_w: np.ndarray, b_from_w: np.ndarray) -> np.ndarray:
    """First-order distance of matches a, b [M, 3] from the epipolar geometry (Hartley & Zisserman, eq. 11.9)."""
    rotation = b_from_w[:, :3] @ a_from_w[:, :3].T
    x, y, z = b_from_w[:, 3] - rotation @ a_from_w[:, 3]
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ rotation
    line_b, line_a = a @ essential.T, b @ essential
    slope = (line_b[:, :2] ** 2).sum(1) + (line_a[:, :2] ** 2).sum(1)
    return np.abs((b * line_b).sum(1)) / np.sqrt(np.maximum(slope, 1e-30))


def _unmatched_neighbors(model: Any, matched: set[tuple[int, int]]) -> tuple[int, int]:
    """(pairs without matches, all pairs) among cameras whose distance is less than NEAR of their depths, the distances
    of the median point, and that differ by less than TURN degrees."""
    ids = sorted(model.reg_image_ids())
    centers = np.stack([model.images[i].projection_center() for i in ids])
    forward = np.stack([model.images[i].viewing_direction() for i in ids])
    xyz = np.array([point.xyz for point in model.points3D.values()]).reshape(-1, 3)
    if len(xyz) == 0:
        return 0, 0
    some = xyz[:: max(1, len(xyz) // 2000)]
    depth = np.array([np.median(np.linalg.norm(some - center, axis=1)) for center in centers])
    near, rank = list[tuple[int, int]](), np.argsort(np.argsort(depth, kind="stable"))
    # Each with those of more depth: by the depth of a camera far away, all others would be pairs.
    for row, around in enumerate(cKDTree(centers).query_ball_point(centers, NEAR * depth)):
        others = np.array([other for other in around if rank[other] > rank[row]], int)
        close = np.linalg.norm(centers[others] - centers[row], axis=1) < NEAR * depth[row]
        close &= forward[others] @ forward[row] > np.cos(np.radians(TURN))
        near += [(ids[row], ids[other]) for other in others[close].tolist()]
    unmatched = sum((i, j) not in matched and (j, i) not in matched for i, j in near)
    return unmatched, len(near)
