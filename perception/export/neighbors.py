"""Nearest neighbours in 3D on the compiled k-d tree: exact in float32 about a common centre."""

from __future__ import annotations

import os

import numpy as np

from perception import _core
from perception.errors import InputError


def cores() -> int:
    """Cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class Neighbors:
    """A search tree over points [N, 3] (any float dtype, finite).

    Where the cloud lies far from the origin, coordinates are taken about its centre in float64 before they
    become float32, so that clouds in map coordinates lose nothing.
    """

    def __init__(self, points: np.ndarray, threads: int | None = None) -> None:
        points = np.asarray(points)
        if points.ndim != 2 or points.shape[1] != 3 or len(points) == 0:
            raise InputError(f"expected at least one point as [N, 3]; found an array {list(points.shape)}")
        low, high = points.min(axis=0).astype(np.float64), points.max(axis=0).astype(np.float64)
        if not np.isfinite(low + high).all():
            raise InputError("points hold NaN or infinite coordinates; leave those out before the search")
        # Coordinates small against the extent stay as they are: the difference of two near floats is exact.
        small = np.maximum(np.abs(low), np.abs(high)).max() <= 4 * (high - low).max()
        self.center = np.zeros(3) if small else (low + high) / 2
        self.low, self.high = low, high
        self.threads = threads or cores()
        self._tree = _core.KdTree(self.local(points), self.threads)

    def local(self, points: np.ndarray) -> np.ndarray:
        """points [Q, 3] about the tree's centre, as the tree sees them: float32, contiguous."""
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
