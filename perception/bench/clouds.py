"""Labelling a large cloud beside scipy's and open3d's trees: seconds, CPU seconds and peak memory, `bench clouds`.

Assignment: the nearest of --gaussians means for --points points. Smoothing: 12 nearest neighbours of every point,
normals, kNN graph, ScanNet's weights, Felzenszwalb-Huttenlocher and the vote; the others bring the neighbours, the
rest is ours. Evaluation: 200 × 200 instances on a million points. Every contender runs in a process of its own, in
turns; memory is the process' peak less what it held before it began. The full size of the issue is --points 10000000
--gaussians 500000. Contenders that are not installed are left out.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from perception.bench.output import Column, bench_parser, finish, table
from perception.bench.processes import fresh_peak, run_python, status_mib

TREES = ("perception", "scipy", "open3d")
LISTS = 12
"""Neighbours per point used for smoothing."""


def surfaces(count: int, seed: int, noise: float = 0.0) -> np.ndarray:
    """Points [count, 3] float32, metres, on the walls, floor and 40 spheres of a synthetic room of 8 × 6 × 3 m."""
    rng = np.random.default_rng(seed)
    room = np.array([8.0, 6.0, 3.0])
    points = rng.random((count, 3)) * room
    kind = rng.integers(0, 8, count)
    for side in range(5):  # two walls along x, two along y, the floor
        axis, low = (side // 2, side % 2 == 0) if side < 4 else (2, True)
        points[kind == side, axis] = 0.0 if low else room[axis]
    balls = np.random.default_rng(7)
    centers, radii = balls.random((40, 3)) * room, 0.1 + 0.3 * balls.random(40)
    rows = np.flatnonzero(kind >= 5)
    ball = rng.integers(0, 40, len(rows))
    direction = rng.normal(size=(len(rows), 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    points[rows] = centers[ball] + radii[ball, None] * direction
    if noise:
        points += rng.normal(0, noise, points.shape)
    return points.astype(np.float32)


def nearest(tree: str, points: np.ndarray, means: np.ndarray) -> np.ndarray:
    """Index [P] of the nearest mean, computed with one of TREES on all cores."""
    if tree == "perception":
        from perception.export.assign import nearest_gaussian

        return nearest_gaussian(points, means)
    return neighbors(tree, means, points, 1)[:, 0]


def neighbors(tree: str, points: np.ndarray, queries: np.ndarray, k: int) -> np.ndarray:
    """Indices [Q, k] int32 of the k nearest points of each query, computed with scipy or open3d."""
    if tree == "scipy":
        from scipy.spatial import cKDTree

        found = cKDTree(points).query(queries, k, workers=-1)[1]
        return found.reshape(len(queries), k).astype(np.int32)
    import open3d

    tensor: Any = open3d.core.Tensor  # open3d's type stubs do not accept numpy arrays
    search = open3d.core.nns.NearestNeighborSearch(tensor(points))
    search.knn_index()
    return search.knn_search(tensor(queries), k)[0].numpy().astype(np.int32)


def smoothed(tree: str, points: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """Labels [P] after the vote per superpoint. The neighbours come from one of TREES."""
    from perception.export.graph import list_edges, list_normals, scannet_weights
    from perception.export.smooth import felzenszwalb, segment_cloud, vote
    from perception.types import PointCloud

    if tree == "perception":
        return vote(labels, segment_cloud(PointCloud(points)))
    lists = neighbors(tree, points, points, LISTS)
    edges = list_edges(lists[:, :9])
    weights = scannet_weights(points, list_normals(points, lists), edges, oriented=False)
    return vote(labels, felzenszwalb(edges, weights, len(points)))


def measure(task: str, tree: str, args: argparse.Namespace) -> dict[str, Any]:
    """Runs a task with one tree in this process: seconds, CPU seconds, peak memory in MiB, a checksum of the result."""
    if tree == "perception":
        import perception.export  # noqa: F401
    elif tree == "scipy":
        import scipy.spatial  # noqa: F401
    else:
        import open3d  # noqa: F401
    run = _task(task, tree, args)
    fresh_peak()
    before = status_mib("VmRSS")
    wall, cpu = time.perf_counter(), time.process_time()
    answer = run()
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    peak = status_mib("VmHWM") - before
    mark = float(np.asarray(answer, np.float64)[:: max(np.size(answer) // 100_000, 1)].mean())
    return {"seconds": wall, "cpu_seconds": cpu, "peak_mib": peak, "mark": mark}


def _task(task: str, tree: str, args: argparse.Namespace) -> Callable[[], Any]:
    if task == "evaluation":
        from perception.evaluate.instances import evaluate

        rng = np.random.default_rng(0)
        gt = rng.integers(1, 201, 1_000_000)
        pred = np.where(rng.random(len(gt)) < 0.3, rng.integers(0, 200, len(gt)), gt - 1)
        return lambda: np.array([evaluate(pred, {i: i / 200 for i in range(200)}, gt)["ap"]])
    points = surfaces(args.points, 1, 0.002)
    if task == "smoothing":
        labels = (points[:, 0] * 4).astype(np.int32)
        return lambda: smoothed(tree, points, labels)
    means = surfaces(args.gaussians, 2, 0.01)
    return lambda: nearest(tree, points, means)


COLUMNS: tuple[Column, ...] = (
    ("seconds", "seconds", ".2f"),
    ("CPU s", "cpu_seconds", ".2f"),
    ("peak MiB", "peak_mib", ".0f"),
    ("mark", "mark", ".4f"),
)


def main(arguments: Sequence[str] | None = None) -> None:
    """Prints the minimum over all rounds. The JSON keeps every round."""
    parser = bench_parser("clouds", __doc__)
    parser.add_argument("--points", type=int, default=500_000)
    parser.add_argument("--gaussians", type=int, default=50_000)
    parser.add_argument("--turns", type=int, default=3)
    parser.add_argument("--tasks", default="assignment,smoothing,evaluation")
    parser.add_argument("--one", nargs=2, metavar=("TASK", "TREE"), help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.one:
        print(json.dumps(measure(options.one[0], options.one[1], options)))
        return
    sizes = ["--points", str(options.points), "--gaussians", str(options.gaussians)]
    trees = [tree for tree in TREES if importlib.util.find_spec(tree)]
    tasks = options.tasks.split(",")
    jobs = [(task, tree) for task in tasks for tree in (trees if task != "evaluation" else trees[:1])]
    turns: dict[tuple[str, str], list[dict[str, Any]]] = {job: [] for job in jobs}
    for _ in range(options.turns):
        for job in jobs:
            output = run_python("-m", "perception.bench.clouds", *sizes, "--one", *job)
            turns[job].append(json.loads(output.splitlines()[-1]))
    rows = [
        {"task": task, "by": tree, **{key: min(turn[key] for turn in found) for _, key, _ in COLUMNS}}
        for (task, tree), found in turns.items()
    ]
    text = f"{options.points} points, {options.gaussians} Gaussians, {os.cpu_count()} cores, least of {options.turns}\n"
    text += table(rows, COLUMNS, ("task", "by"))
    finish("clouds", options, {"rows": rows, "turns": {" ".join(job): found for job, found in turns.items()}}, text)


if __name__ == "__main__":
    main()
