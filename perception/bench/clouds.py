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
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from perception.bench.children import child_options
from perception.bench.memory import fresh_peak, status_mib

TREES = ("perception", "scipy", "open3d")
LISTS = 12
"""Neighbours that smoothing asks for."""


def surfaces(count: int, seed: int, noise: float = 0.0) -> np.ndarray:
    """Points [count, 3] float32 on the walls, floor and 40 balls of a made-up room of 8 × 6 × 3 m."""
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
    """Index [P] of the nearest mean, by one of TREES, on all cores."""
    if tree == "perception":
        from perception.export.assign import nearest_gaussian

        return nearest_gaussian(points, means)
    return neighbors(tree, means, points, 1)[:, 0]


def neighbors(tree: str, points: np.ndarray, queries: np.ndarray, k: int) -> np.ndarray:
    """The k nearest points [Q, k] int32 of queries, by scipy or open3d."""
    if tree == "scipy":
        from scipy.spatial import cKDTree

        found = cKDTree(points).query(queries, k, workers=-1)[1]
        return found.reshape(len(queries), k).astype(np.int32)
    import open3d

    tensor: Any = open3d.core.Tensor  # its type stubs do not know numpy arrays
    search = open3d.core.nns.NearestNeighborSearch(tensor(points))
    search.knn_index()
    return search.knn_search(tensor(queries), k)[0].numpy().astype(np.int32)


def smoothed(tree: str, points: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """Labels [P] after the vote of superpoints, the neighbours brought by one of TREES."""
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
    """One contender in this very process: seconds, CPU seconds, peak memory in MiB, and a mark of the answer."""
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


def _in_child(task: str, tree: str, arguments: Sequence[str]) -> dict[str, Any]:
    command = [sys.executable, "-m", "perception.bench.clouds", *arguments, "--one", task, tree]
    done = subprocess.run(command, capture_output=True, text=True, check=True, **child_options())
    result: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return result


def main(argv: Sequence[str] | None = None) -> None:
    """Prints a table; --json FILE writes settings, versions and every turn."""
    parser = argparse.ArgumentParser(prog="perception bench clouds", description=__doc__)
    parser.add_argument("--points", type=int, default=500_000)
    parser.add_argument("--gaussians", type=int, default=50_000)
    parser.add_argument("--turns", type=int, default=3)
    parser.add_argument("--tasks", default="assignment,smoothing,evaluation")
    parser.add_argument("--json", type=Path, metavar="FILE")
    parser.add_argument("--one", nargs=2, metavar=("TASK", "TREE"), help=argparse.SUPPRESS)
    args = parser.parse_args(argv)
    if args.one:
        print(json.dumps(measure(args.one[0], args.one[1], args)))
        return
    sizes = ["--points", str(args.points), "--gaussians", str(args.gaussians)]
    trees = [tree for tree in TREES if importlib.util.find_spec(tree)]
    jobs = [(task, tree) for task in args.tasks.split(",") for tree in (trees if task != "evaluation" else trees[:1])]
    turns: dict[tuple[str, str], list[dict[str, Any]]] = {job: [] for job in jobs}
    for _ in range(args.turns):
        for job in jobs:
            turns[job].append(_in_child(*job, sizes))
    print(f"{args.points} points, {args.gaussians} Gaussians, {os.cpu_count()} cores, least of {args.turns} turns")
    print(f"{'':24}{'seconds':>10}{'CPU s':>10}{'peak MiB':>10}{'mark':>16}")
    for (task, tree), rows in turns.items():
        best = {key: min(row[key] for row in rows) for key in ("seconds", "cpu_seconds", "peak_mib", "mark")}
        print(
            f"{task + ' ' + tree:24}{best['seconds']:>10.2f}{best['cpu_seconds']:>10.2f}{best['peak_mib']:>10.0f}"
            f"{best['mark']:>16.4f}"
        )
    if args.json:
        from perception.io.atomic import atomic_file
        from perception.pipeline.record import versions

        record = {
            "arguments": {key: str(value) for key, value in vars(args).items()},
            "versions": versions(),
            "turns": {" ".join(job): rows for job, rows in turns.items()},
        }
        with atomic_file(args.json) as aside:
            aside.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
