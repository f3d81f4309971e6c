"""Similarities that bring overlapping parts of a reconstruction together, at all their overlaps at once."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import spsolve
from scipy.spatial.transform import Rotation

from perception.geometry import align_similarity, camera_centres
from perception.photos.lens import load_pycolmap

Similarity = tuple[float, np.ndarray, np.ndarray]
"""Scale s, rotation R [3, 3] and translation t [3] of x ↦ s R x + t."""
Poses = dict[int, np.ndarray]
"""Camera from world, [3, 4] float64, by image id."""
NEAR = 0.02
"""Distance at which the same photo of two parts fits, relative to the size of a part."""
FIT = 9, 1 / 3
"""Least number and share of the points of shared photos that fit, three a photo, by which two parts are tied."""
STEPS = 8
"""Gauss-Newton steps; the last ones change 1,200 photos of a building by less than a hundredth of their errors."""


@dataclass(frozen=True)
class _Tie:
    """The rows of the photos [M] that two parts, by number, both have, and which points [M, 3] of them fit."""

    parts: tuple[int, int]
    rows: tuple[np.ndarray, np.ndarray]
    fits: np.ndarray


def similarities(parts: Sequence[Poses], own: Sequence[set[int]], start: Poses, seed: int) -> list[Similarity]:
    """The similarity S_p of each part, x ↦ s R x + t, so that photos lie where all parts that have them say.

    own: images of each part whose poses in `start` place it at first. Two parts are tied by the photos in both that are
    an own one of either, as far as one similarity fits them (RANSAC): a part may have others in wrong places. Minimised
    is Σ ρ(|x_pi − x_qi|) over all ties (ρ: Cauchy, of width NEAR / 3); the first part stays. x_pi are three points of a
    photo as S_p places it: its centre, and those ahead of and above it at the median distance of a centre from the
    middle of its part, so that angles count as much as places.
    """
    given = [np.array(list(part.values())) for part in parts]
    first = [np.array([start[image] for image in part]) for part in parts]
    centres = [camera_centres(poses) for poses in first]
    size = float(np.median(np.concatenate([np.linalg.norm(c - c.mean(axis=0), axis=1) for c in centres])))
    sure = [_sure(part, images) for part, images in zip(parts, own, strict=True)]
    moves = [_placed(poses[s], at[s], size) for poses, at, s in zip(given, first, sure, strict=True)]
    ties = list(_ties(parts, own, [_points(*each, size) for each in zip(moves, given, strict=True)], NEAR * size, seed))
    for _ in range(STEPS if ties else 0):
        moves = _step(moves, [_points(*each, size) for each in zip(moves, given, strict=True)], ties, NEAR / 3 * size)
    return moves


def _sure(part: Poses, images: set[int]) -> np.ndarray:
    """[n] bool: the own photos of a part, all where it has few."""
    own = np.array([image in images for image in part])
    return own if own.sum() >= 3 else np.ones(len(own), bool)


def _placed(poses: np.ndarray, first: np.ndarray, size: float) -> Similarity:
    """That which moves poses [n, 3, 4] to the `first` ones."""
    one = (1.0, np.eye(3), np.zeros(3))
    here, there = camera_centres(poses), camera_centres(first)
    scale = float(
        np.linalg.norm(there - there.mean(axis=0)) / max(float(np.linalg.norm(here - here.mean(axis=0))), 1e-12)
    )
    points = _points((scale, *one[1:]), poses, size).reshape(-1, 3), _points(one, first, size).reshape(-1, 3)
    more, turn, shift = align_similarity(points[1], points[0])
    return more * scale, turn, shift


def _points(move: Similarity, poses: np.ndarray, size: float) -> np.ndarray:
    """[n, 3, 3] centres of poses [n, 3, 4] that are moved, and points `size` ahead of and above each."""
    scale, turn, shift = move
    centre = scale * camera_centres(poses) @ turn.T + shift
    return centre[:, None] + size * np.stack([0 * centre, poses[:, 2, :3] @ turn.T, poses[:, 1, :3] @ turn.T], axis=1)


def _ties(
    parts: Sequence[Poses], own: Sequence[set[int]], now: list[np.ndarray], near: float, seed: int
) -> Iterator[_Tie]:
    """Of all pairs of parts that share photos; now [n, 3, 3]: the points of each part, as it is placed."""
    rows, having = [{image: n for n, image in enumerate(part)} for part in parts], dict[int, list[int]]()
    for number, part in enumerate(parts):
        for image in part:
            having.setdefault(image, []).append(number)
    pairs = {(min(a, b), max(a, b)) for a, images in enumerate(own) for image in images for b in having[image]}
    for a, b in sorted(pair for pair in pairs if pair[0] != pair[1]):
        shared = [image for image in sorted((own[a] | own[b]) & rows[a].keys()) if image in rows[b]]
        at = np.array([rows[a][image] for image in shared]), np.array([rows[b][image] for image in shared])
        found = robust_similarity(now[b][at[1]].reshape(-1, 3), now[a][at[0]].reshape(-1, 3), near, seed)
        fits = np.zeros(3 * len(shared), bool) if found is None else np.asarray(found["inlier_mask"], bool)
        if fits.sum() >= max(FIT[0], FIT[1] * len(fits)):
            yield _Tie((a, b), at, fits.reshape(-1, 3))


def robust_similarity(source: np.ndarray, target: np.ndarray, near: float, seed: int) -> dict[str, Any] | None:
    """What pycolmap finds by RANSAC: "tgt_from_src", and which points [M, 3] it brings `near` (RANSAC's largest error)
    to their targets, "inlier_mask" and "num_inliers"; None without a similarity."""
    pycolmap = load_pycolmap()
    pycolmap.set_random_seed(seed)
    ransac = pycolmap.RANSACOptions(max_error=near, min_inlier_ratio=0.1, max_num_trials=5000, random_seed=seed)
    found: dict[str, Any] | None = pycolmap.estimate_sim3d_robust(source, target, ransac)
    return found


def _step(moves: list[Similarity], now: list[np.ndarray], ties: list[_Tie], width: float) -> list[Similarity]:
    """One Gauss-Newton step, in which each part but the first moves by a small similarity about its middle.
    now [n, 3, 3]: the points of each part."""
    middles, blocks, residual, begun = [points[:, 0].mean(axis=0) for points in now], [], [], 0
    for tie in ties:
        away = (now[tie.parts[0]][tie.rows[0]] - now[tie.parts[1]][tie.rows[1]])[tie.fits]
        root = np.repeat(1 / np.sqrt(1 + (np.linalg.norm(away, axis=1) / width) ** 2), 3)
        rows = np.repeat(begun + np.arange(len(root)), 7)
        for sign, number, photos in zip((1, -1), tie.parts, tie.rows, strict=True):
            slope = root[:, None] * _by_motion(now[number][photos] - middles[number])[tie.fits].reshape(-1, 7)
            blocks.append((sign * slope.ravel(), rows, np.tile(7 * number + np.arange(7), len(root))))
        residual.append(root * away.ravel())
        begun += len(root)
    values, rows, columns = map(np.concatenate, zip(*blocks, strict=True))
    J = sparse.csr_matrix((values, (rows, columns)), (begun, 7 * len(now)))[:, 7:]
    normal = (J.T @ J).tocsc()
    normal += 1e-9 * float(normal.diagonal().max()) * sparse.identity(normal.shape[0], format="csc")
    found = np.append(np.zeros(7), spsolve(normal, -J.T @ np.concatenate(residual))).reshape(-1, 7)
    moved = []
    for (scale, turn, shift), middle, step in zip(moves, middles, found, strict=True):
        about, growth = Rotation.from_rotvec(step[3:6]).as_matrix(), 1 + step[6]
        moved.append((growth * scale, about @ turn, middle + step[:3] + growth * about @ (shift - middle)))
    return moved


def _by_motion(local: np.ndarray) -> np.ndarray:
    """[M, 3, 3, 7] derivatives of the points [M, 3, 3] of photos by a translation, a rotation vector and a growth, all
    about the origin: the points beside a centre keep their distance from it."""
    found = np.zeros((*local.shape, 7))
    found[..., :3] = np.eye(3)
    found[..., 3:6] = np.cross(np.eye(3), local[..., None, :]).swapaxes(-1, -2)
    found[..., 6] = local[:, :1]
    return found


def moved_pose(similarity: Similarity, pose: np.ndarray) -> np.ndarray:
    """The pose [3, 4] of a camera in a world that the similarity moves."""
    scale, turn, shift = similarity
    own = pose[:, :3] @ turn.T
    return np.column_stack([own, scale * pose[:, 3] - own @ shift])


def pose_of(image: Any) -> np.ndarray:
    """[3, 4] of a pycolmap image."""
    return np.asarray(image.cam_from_world().matrix())
