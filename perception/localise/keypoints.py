"""Features of a set of photos with their descriptors, and matches between photos of two sets."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from perception.posed.bundle_adjustment import Poses, residuals, starting_points
from perception.sfm.database import FeatureStore
from perception.sfm.pairs import COARSE_FEATURES, mutual_matches, stored_features, unit
from perception.sfm.tracks import Features, Tracks, observed

RATIO = 0.8
"""Lowe's ratio of matches: of the nearest to the second nearest distance of descriptors."""
NARROW = np.cos(np.radians(1.0))
"""Points whose rays all lie within this cosine of the first are left out: their distance is not known."""
TOLERANCE, TOLERANCE_SIDE = 4.0, 800
"""Largest error of a feature in pixels, of photos with a long side of TOLERANCE_SIDE or less; of larger ones more."""


@dataclass(frozen=True)
class Described:
    """The features of V photos. starts [V + 1]: photo v has the features starts[v] : starts[v + 1] of `features`.
    pixels [F, 2]. descriptors: uint8 [F, 128] of each photo. coarse: unit descriptors of the largest features of all,
    those of photo v in coarse_starts[v] : coarse_starts[v + 1]."""

    features: Features
    starts: np.ndarray
    pixels: np.ndarray
    descriptors: list[np.ndarray]
    coarse: np.ndarray
    coarse_starts: np.ndarray

    def matches(self, view: int, other: Described, of_other: int) -> np.ndarray:
        """Features [M, 2] that match between a photo of this and one of another set: mutual nearest neighbours."""
        similarity = unit(self.descriptors[view]) @ unit(other.descriptors[of_other]).T
        return mutual_matches(similarity, RATIO) + np.array([self.starts[view], other.starts[of_other]])

    def votes(self, view: int, other: Described) -> np.ndarray:
        """[W] number of matches of the largest features of a photo with those of each photo of another set."""
        similarity = self.coarse[slice(*self.coarse_starts[view : view + 2])] @ other.coarse.T
        blocks = np.split(similarity, other.coarse_starts[1:-1], axis=1)
        return np.array([len(mutual_matches(block)) for block in blocks])


def described(features: Features, store: FeatureStore) -> Described:
    """The features that `features_of` read from `store`, with their descriptors."""
    pixels, descriptors, by_size = zip(*stored_features(store.database, store.names), strict=True)
    coarse = [unit(data[order[:COARSE_FEATURES]]) for data, order in zip(descriptors, by_size, strict=True)]
    starts, coarse_starts = (np.cumsum([0, *map(len, each)]) for each in (descriptors, coarse))
    return Described(features, starts, np.concatenate(pixels), list(descriptors), np.concatenate(coarse), coarse_starts)


def tolerance(long_side: int) -> float:
    """Largest error in pixels of a feature in a photo with this long side."""
    return TOLERANCE * max(1.0, long_side / TOLERANCE_SIDE)


def triangulated(
    features: Features, rows: np.ndarray, point: np.ndarray, poses: Poses, most: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The features `rows` [O] of points `point` [O] that agree with one point in space, and these [P, 3].
    most: largest error in pixels. A point whose features disagree loses the worst until two agree; it is left out where
    its rays are nearly parallel, or it lies behind a camera."""
    while True:
        tracks = observed(features, rows, point)
        xyz = starting_points(tracks, poses) if len(rows) else np.empty((0, 3))
        pixels, _, x = residuals(tracks, poses, xyz)
        error = np.where(x[:, 2] > 0, np.hypot(*pixels.T), np.inf)
        worst = np.full(tracks.size, most)
        np.maximum.at(worst, point, error)
        kept = (error < worst[point]) | (worst[point] <= most)
        kept &= np.bincount(point, kept, tracks.size)[point] >= 2
        if kept.all():
            break
        rows, point = rows[kept], np.unique(point[kept], return_inverse=True)[1]
    wide = _wide(tracks, poses, xyz)
    kept = wide[point]
    return rows[kept], (np.cumsum(wide) - 1)[point[kept]], xyz[wide]


def _wide(tracks: Tracks, poses: Poses, xyz: np.ndarray) -> np.ndarray:
    """[P] whether the distance of a point is known: by the angle between its rays, or measured."""
    ray = xyz[tracks.point] - poses.center[tracks.view]
    ray /= np.maximum(np.linalg.norm(ray, axis=1, keepdims=True), 1e-300)
    first = ray[np.searchsorted(tracks.point, np.arange(tracks.size))]
    wide = ((ray * first[tracks.point]).sum(axis=1) < NARROW) | (tracks.depth > 0)
    return np.bincount(tracks.point, wide, tracks.size) > 0
