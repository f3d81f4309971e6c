"""New photos and the map's together: tracks over both, and bundle adjustment with the map's cameras held."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from perception.geometry import camera_centres
from perception.localise.keypoints import Described, triangulated
from perception.localise.reference import Reference
from perception.posed.bundle_adjustment import Adjusted, Poses, adjust, residuals
from perception.posed.pose_refinement import match_errors
from perception.sfm.consistency import Pair, stronger_contradictions
from perception.sfm.tracks import Features, grouped, observed

ROUNDS = 2
"""Rounds of tracks and adjustment: with better poses, more features agree."""
LOOSE = 0.1
"""Standard error of the start of a new pose: angle in radians, position as a share of the distance to the points. It
keeps the equations regular and weighs nothing beside features."""


@dataclass(frozen=True)
class Adjustment:
    """poses: of the map's V views, then of N new photos. point [F of the new]: of each new feature, −1 = none.
    points [P, 3]. inliers, rms: by number of the new photo: features that agree, and their error in pixels."""

    poses: Poses
    point: np.ndarray
    points: np.ndarray
    inliers: dict[int, int]
    rms: dict[int, float]
    _found: Adjusted | None

    def covariances(self, lens: dict[int, tuple[float, float]]) -> dict[int, np.ndarray]:
        """[6, 6] by number of the new photo, of rotation vector (map axes, radians) and position. Of all at once, which
        takes the cube of their number. lens: as `Adjusted.covariances`, of the photos whose lens is not known."""
        if self._found is None:
            return {}
        return dict(zip(self.inliers, self._found.covariances(self._rows(lens, 2)), strict=True))

    def lens_steps(
        self, lens: dict[int, tuple[float, float]], changed: dict[int, np.ndarray]
    ) -> dict[int, tuple[np.ndarray, np.ndarray]]:
        """Of the photos in `lens`, by number: see `Adjusted.lens_steps`."""
        if self._found is None or not lens:
            return {}
        found = self._found.lens_steps(self._rows(lens, 2), self._rows(changed, 3))
        both = dict(zip(self.inliers, zip(*found, strict=True), strict=True))
        return {number: both[number] for number in lens}

    def _rows(self, values: Mapping[int, Sequence[float] | np.ndarray], width: int) -> np.ndarray:
        """[K, width] of the adjusted photos, 0 where there is no value."""
        return np.array([values.get(number, (0.0,) * width) for number in self.inliers])


def joined(reference: Reference, new: Features, pairs: np.ndarray) -> Features:
    """The features of both, those of the new photos after those of the map's views."""
    old = reference.described.features
    rays, focal, depth = (np.concatenate([getattr(f, name) for f in (old, new)]) for name in ("rays", "focal", "depth"))
    return Features(np.concatenate([old.view, new.view + len(reference.views)]), rays, focal, depth, pairs)


def adjusted(
    reference: Reference, new: Described, placed: dict[int, np.ndarray], links: np.ndarray, most: float
) -> Adjustment:
    """Refines the poses `placed` (camera_from_map by number of the new photo). links [M, 2]: new feature and feature of
    the map. most: largest error in pixels. A photo that keeps no features stays as it was, without covariance."""
    old, count = reference.described.features, len(reference.views)
    poses = _with(reference.poses, placed, len(new.starts) - 1)
    inside = np.isin(new.features.view, list(placed))
    between = inside[new.features.pairs].all(axis=1) & _agreeing(new, poses, count, most)
    shift = len(old.view)
    pairs = np.concatenate([old.pairs, links[inside[links[:, 0]]] + (shift, 0), new.features.pairs[between] + shift])
    features = joined(reference, new.features, pairs)
    rows, point = grouped(features, pairs)
    seen = np.bincount(point, features.view[rows] >= count, point.max(initial=-1) + 1) > 0
    rows, point = rows[seen[point]], (np.cumsum(seen) - 1)[point[seen[point]]]
    for _ in range(ROUNDS):
        kept, number, points = triangulated(features, rows, point, poses, most)
        used, index = np.unique(features.view[kept], return_inverse=True)
        free = used >= count
        if not free.any():
            break
        tracks = replace(observed(features, kept, number), view=index)
        given = Poses(poses.rotation[used], poses.center[used])
        distance = float(np.median(np.linalg.norm(points[number] - given.center[index], axis=1)))
        found = adjust(tracks, given, given, (LOOSE, LOOSE * distance), held=~free)
        poses.rotation[used[free]], poses.center[used[free]] = found.poses.rotation[free], found.poses.center[free]
    of_new = kept >= shift
    owner = np.full(len(new.features.view), -1, np.int64)
    owner[kept[of_new] - shift] = number[of_new]
    numbers = (used[free] - count).tolist() if len(used) else []
    error = np.hypot(*residuals(tracks, found.poses, found.points)[0].T) if numbers else np.empty(0)
    errors = {n: error[index == np.searchsorted(used, n + count)] for n in numbers}
    inliers = {n: len(each) for n, each in errors.items()}
    rms = {n: float(np.sqrt(np.mean(each**2))) for n, each in errors.items()}
    return Adjustment(poses, owner, found.points if numbers else points, inliers, rms, found if numbers else None)


def contradicted(reference: Reference, new: Described, found: Adjustment, placed: set[int], most: float) -> int | None:
    """The placed photo whose pose rests on fewest features, of two whose matches contradict their poses and are more
    than those that the poses rest on (see `sfm.consistency`): a texture or thing that is elsewhere now. None if there
    is none."""
    views, good = new.features.view[new.features.pairs], _agreeing(new, found.poses, len(reference.views), most)
    pairs = [Pair(-1, number, found.inliers[number], 1.0) for number in sorted(placed)]
    rows = np.isin(views, list(placed)).all(axis=1)
    both, index, counts = np.unique(views[rows], axis=0, return_inverse=True, return_counts=True)
    shares = np.bincount(index.ravel(), good[rows], len(both)) / counts
    pairs += map(Pair, *both.T.tolist(), counts.tolist(), shares.tolist())
    wrong = {number for pair in stronger_contradictions(pairs) for number in (pair.i, pair.j)}
    return min(wrong, key=lambda number: (found.inliers[number], number), default=None)


def _agreeing(new: Described, poses: Poses, count: int, most: float) -> np.ndarray:
    """[M] whether the matches between new photos agree with their poses, which follow `count` of the map."""
    lines, _ = match_errors(new.features, Poses(poses.rotation[count:], poses.center[count:]))
    return np.asarray((lines.reshape(2, -1) <= most).all(axis=0))


def _with(poses: Poses, placed: dict[int, np.ndarray], count: int) -> Poses:
    """The map's poses, and `count` more; those that are not placed are the identity."""
    matrices = np.stack([placed.get(n, np.eye(4)) for n in range(count)])
    rotation = np.concatenate([poses.rotation, matrices[:, :3, :3]])
    return Poses(rotation, np.concatenate([poses.center, camera_centres(matrices)]))
