"""Nearest neighbours in 3D with the compiled k-d tree, exact in float32 relative to a common centre; the Gaussian with
the nearest mean (OpenSplat3D), in chunks for clouds of any size."""

from __future__ import annotations

import numpy as np

from perception import _core
from perception.errors import InputError
from perception.io.cloud_memory import cores

CHUNK = 1 << 20  # points at a time: 24 MiB of working memory


class Neighbors:
    """A k-d tree over points [N, 3] (any float dtype, finite).

    For a cloud far from the origin, its centre is subtracted in float64 before conversion to float32, so that
    georeferenced coordinates keep their precision.
    """

    def __init__(self, points: np.ndarray, threads: int | None = None) -> None:
        points = np.asarray(points)
        if points.ndim != 2 or points.shape[1] != 3 or len(points) == 0:
            raise InputError(f"expected at least one point as [N, 3]; found an array {list(points.shape)}")
        low, high = points.min(axis=0).astype(np.float64), points.max(axis=0).astype(np.float64)
        if not np.isfinite(low + high).all():
            raise InputError("points hold NaN or infinite coordinates; leave those out before the search")
        # Coordinates small relative to the extent are not moved: the difference of two close floats is exact.
        small = np.maximum(np.abs(low), np.abs(high)).max() <= 4 * (high - low).max()
        self.center = np.zeros(3) if small else (low + high) / 2
        self.low, self.high = low, high
        self.threads = threads or cores()
        self._tree = _core.KdTree(self.local(points), self.threads)

    def local(self, points: np.ndarray) -> np.ndarray:
        """points [Q, 3] relative to the tree's centre: float32, contiguous."""
        shifted = np.asarray(points) - self.center if self.center.any() else points
        return np.ascontiguousarray(shifted, dtype=np.float32)

    def query(self, queries: np.ndarray, k: int = 1, max_distance: float = np.inf) -> tuple[np.ndarray, np.ndarray]:
        """The k nearest of queries [Q, 3]: indices [Q, k] int32 and distances [Q, k] float32, nearest first.

        −1 and infinity where fewer than k points lie within max_distance, or the query is not finite. Equal
        distances go to the smaller index.
        """
        queries = np.asarray(queries)
        indices = np.empty((len(queries), k), np.int32)
        squared = np.empty((len(queries), k), np.float32)
        with np.errstate(over="ignore", invalid="ignore"):
            self._tree.knn(self.local(queries), indices, squared, float(max_distance), self.threads)
        return indices, np.sqrt(squared, out=squared)


def nearest_gaussian(
    points: np.ndarray, means: np.ndarray, *, chunk: int = CHUNK, max_distance: float | None = None
) -> np.ndarray:
    """Index [P] int64 of the nearest of means [N, 3] for each of points [P, 3].

    −1 for points that are not finite or farther than max_distance from every mean. Equal distances go to the smaller
    index. Means that are not finite are ignored.
    """
    finite = np.flatnonzero(np.isfinite(means).all(axis=1))
    result = np.full(len(points), -1, np.int64)
    if len(finite) == 0:
        return result
    tree = Neighbors(means if len(finite) == len(means) else means[finite])
    for begin in range(0, len(points), chunk):
        found = tree.query(points[begin : begin + chunk], 1, np.inf if max_distance is None else max_distance)[0][:, 0]
        result[begin : begin + chunk] = np.where(found >= 0, finite[found], -1)
    return result


def auto_distance(means: np.ndarray) -> float | None:
    """Distance limit from the map itself: twice the 99th percentile of the spacing of neighbouring means [N, 3].

    Even in sparse regions a point on the mapped surface is within half that spacing of a mean; the limit is four times
    this. Points beyond it were not mapped. None (no limit) for fewer than two distinct means.
    """
    means = means[np.isfinite(means).all(axis=1)]
    if len(means) < 2:
        return None
    chosen = means[:: max(len(means) // 50_000, 1)]
    gaps = Neighbors(means).query(chosen, 2)[1][:, 1]
    gaps = gaps[gaps > 0]
    return 2 * float(np.quantile(gaps, 0.99)) if len(gaps) else None
