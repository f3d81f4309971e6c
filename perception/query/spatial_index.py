"""Exact distances to instances' points, and their shares inside regions; bounding boxes prune the search."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterable

import numpy as np

from perception.boxes import inside
from perception.map.map import InstanceIndex
from perception.types import OrientedBox

_NEIGHBORS = 8


class SpatialIndex:
    """Spatial queries on the points of instances. bounds [K, 2, 3]: lowest and highest corner, in the order of ids."""

    def __init__(self, index: InstanceIndex) -> None:
        self.index = index
        bounds = [(points.min(axis=0), points.max(axis=0)) for points in map(index.of, index.ids)]
        self.bounds = np.array(bounds, np.float64).reshape(-1, 2, 3)
        self._row = {int(i): n for n, i in enumerate(index.ids)}

    def aabb(self, instance_id: int) -> np.ndarray:
        """[2, 3] lowest and highest corner of the instance's points; NaN without points."""
        return self.bounds[self._row[instance_id]] if instance_id in self._row else np.full((2, 3), np.nan)

    def distance(self, instance_id: int, point: np.ndarray) -> float:
        """From a point [3] to the nearest of the instance's points; infinite without points."""
        points = self.index.of(instance_id)
        return float(np.sqrt(_squared(points, point).min())) if len(points) else float("inf")

    def nearest(self, point: np.ndarray, count: int, ids: Iterable[int]) -> list[tuple[float, int]]:
        """The `count` instances of `ids` with the nearest points: (distance, id), nearest first, ties by id."""
        known = [i for i in ids if i in self._row]
        bounds = self.bounds[[self._row[i] for i in known]].reshape(-1, 2, 3)
        apart = np.maximum(bounds[:, 0] - point, point - bounds[:, 1])
        return _closest(known, apart, count, lambda i, _: self.distance(i, point))

    def share_inside(self, instance_id: int, region: OrientedBox) -> float:
        """The share of the instance's points that lies in `region`, in [0, 1]; 0 without points."""
        points, corners = self.index.of(instance_id), region.corners
        low, high = self.aabb(instance_id)
        apart = (corners.max(axis=0) < low - 1e-9).any() or (corners.min(axis=0) > high + 1e-9).any()
        return float(inside(region, points).mean()) if len(points) and not apart else 0.0

    def reaches(self, instance_id: int, point: np.ndarray) -> bool:
        """Whether `point` [3] lies on the instance: its distance to the instance's nearest point p is at most the
        distance of p to its eighth neighbour."""
        points = self.index.of(instance_id)
        squared = _squared(points, point)
        nearest = int(squared.argmin())
        around = _squared(points, points[nearest].astype(np.float64))
        radius = np.partition(around, min(_NEIGHBORS, len(around) - 1))[min(_NEIGHBORS, len(around) - 1)]
        return bool(squared[nearest] <= radius)

    def neighbors(self, instance_id: int, count: int) -> list[tuple[float, int]]:
        """The `count` other instances whose points come nearest: (gap, id), nearest first."""
        from scipy.spatial import cKDTree

        points = self.index.of(instance_id)
        others = [int(i) for i in self.index.ids if i != instance_id]
        if not len(points) or not others:
            return []
        tree = cKDTree(points)
        low, high = self.aabb(instance_id)
        bounds = self.bounds[[self._row[i] for i in others]]
        apart = np.maximum(bounds[:, 0] - high, low - bounds[:, 1])

        def gap(other: int, most: float) -> float:
            return float(tree.query(self.index.of(other), distance_upper_bound=max(most * (1 + 1e-9), 1e-30))[0].min())

        return [entry for entry in _closest(others, apart, count, gap) if np.isfinite(entry[0])]


def _squared(points: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Squared distances [P] in float64 of points [P, 3] to one [3]."""
    difference = np.asarray(points, np.float64) - point
    return np.einsum("ij,ij->i", difference, difference)


def _closest(
    ids: list[int], apart: np.ndarray, count: int, distance: Callable[[int, float], float]
) -> list[tuple[float, int]]:
    """The `count` of `ids` with the least distances: (distance, id), nearest first, ties by id.

    apart [I, 3]: distance between bounding boxes by axis, negative where they overlap. Instances are visited by rising
    distance of the boxes, a lower bound of distance(id, most), which may be infinite beyond `most`. The search stops
    once this bound exceeds the largest distance that is kept.
    """
    least = np.sqrt((apart.clip(min=0) ** 2).sum(axis=1)) * (1 - 1e-9)  # rounding must not hide a tie
    kept: list[tuple[float, int]] = []
    for n in np.argsort(least, kind="stable"):
        most = kept[-1][0] if len(kept) >= count else np.inf
        if least[n] > most:
            break
        kept = heapq.nsmallest(count, [*kept, (distance(ids[n], most), ids[n])])
    return kept
