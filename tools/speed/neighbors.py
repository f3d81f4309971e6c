"""Measures CPU seconds of nearest neighbours: ours, SciPy's, small_gicp's and pykdtree's, in turns.

python tools speed.neighbors [--threads 1]
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from perception.export.neighbors import Neighbors


def surface(count: int, rng: np.random.Generator) -> np.ndarray:
    """[count, 3] float32, shuffled: 20 planes and 20 spheres with noise, as of a room."""
    parts = []
    for number, size in enumerate(map(len, np.array_split(np.arange(count), 40))):
        directions = rng.normal(size=(size, 3))
        if number % 2:
            directions[:, number // 2 % 3] = 0
        parts.append(rng.uniform(-2, 2, 3) + 0.5 * directions / np.linalg.norm(directions, axis=1, keepdims=True))
    return rng.permutation(np.concatenate(parts) + rng.normal(0, 0.002, (count, 3))).astype(np.float32)


def libraries(threads: int) -> Iterator[tuple[str, Callable[[np.ndarray, np.ndarray, int], Any]]]:
    """Name, and what builds a tree of points and asks it for the k nearest of each query."""
    yield "ours", lambda points, queries, k: Neighbors(points, threads).query(queries, k)
    yield "cKDTree", lambda points, queries, k: cKDTree(points, balanced_tree=False).query(queries, k, workers=threads)
    with suppress(ImportError):
        import small_gicp

        def gicp(points: np.ndarray, queries: np.ndarray, k: int) -> Any:
            tree = small_gicp.KdTree(small_gicp.PointCloud(points), num_threads=threads)
            return tree.batch_knn_search(queries.astype(np.float64), k, num_threads=threads)

        yield "small_gicp", gicp
    with suppress(ImportError):
        from pykdtree.kdtree import KDTree  # its threads are OpenMP's

        yield "pykdtree", lambda points, queries, k: KDTree(points).query(queries, k=k)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--turns", type=int, default=3)
    options = parser.parse_args()
    rng = np.random.default_rng(0)
    means, cloud = surface(500_000, rng), surface(300_000, rng)
    near = np.repeat(means, 2, axis=0) + rng.normal(0, 0.01, (1_000_000, 3)).astype(np.float32)
    for what, points, queries, k in (("nearest mean", means, near, 1), ("neighbour lists", cloud, cloud, 25)):
        spent: dict[str, list[float]] = {}
        for _ in range(options.turns):
            for name, ask in libraries(options.threads):
                start = time.process_time()
                ask(points, queries, k)
                spent.setdefault(name, []).append(time.process_time() - start)
        print(what, ", ".join(f"{name} {np.median(seconds):.2f} s" for name, seconds in spent.items()), flush=True)


if __name__ == "__main__":
    main()
