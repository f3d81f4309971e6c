"""Labelling a large cloud: seconds, CPU seconds and peak memory, `bench clouds`.

Assignment: the nearest of --gaussians means for --points points, beside SciPy's tree, with the same answer. Smoothing:
nearest neighbours of every point, normals, kNN graph, ScanNet's weights, Felzenszwalb-Huttenlocher and the vote.
Evaluation: 200 × 200 instances on a million points. Memory is the peak less what was held before.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from perception.bench.output import Column, bench_parser, finish, table
from perception.bench.processes import fresh_peak, status_mib
from perception.errors import InputError

COLUMNS: tuple[Column, ...] = (
    ("seconds", "seconds", ".2f"),
    ("CPU s", "cpu_seconds", ".2f"),
    ("peak MiB", "peak_mib", ".0f"),
    ("mark", "mark", ".4f"),
)


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


def tasks(options: argparse.Namespace) -> dict[str, Callable[[], np.ndarray]]:
    """The timed functions by name; their inputs are made here."""
    from scipy.spatial import cKDTree

    from perception.evaluate.instances import evaluate
    from perception.export.assign import nearest_gaussian
    from perception.export.smooth import segment_cloud, vote
    from perception.types import PointCloud

    points, means = surfaces(options.points, 1, 0.002), surfaces(options.gaussians, 2, 0.01)
    labels = (points[:, 0] * 4).astype(np.int32)
    rng = np.random.default_rng(0)
    gt = rng.integers(1, 201, 1_000_000)
    pred = np.where(rng.random(len(gt)) < 0.3, rng.integers(0, 200, len(gt)), gt - 1)
    return {
        "assignment": lambda: nearest_gaussian(points, means),
        "assignment, scipy": lambda: cKDTree(means).query(points, 1, workers=-1)[1],
        "smoothing": lambda: vote(labels, segment_cloud(PointCloud(points))),
        "evaluation": lambda: np.array([evaluate(pred, {i: i / 200 for i in range(200)}, gt)["ap"]]),
    }


def measure(run: Callable[[], np.ndarray]) -> dict[str, float]:
    """Seconds, CPU seconds, peak memory in MiB, and a checksum of the result."""
    fresh_peak()
    before = status_mib("VmRSS")
    wall, cpu = time.perf_counter(), time.process_time()
    answer = run()
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    mark = float(np.asarray(answer, np.float64)[:: max(np.size(answer) // 100_000, 1)].mean())
    return {"seconds": wall, "cpu_seconds": cpu, "peak_mib": status_mib("VmHWM") - before, "mark": mark}


def main(arguments: Sequence[str] | None = None) -> None:
    """Prints the minimum over all rounds, in which the tasks take turns. The JSON keeps every round."""
    parser = bench_parser("clouds", __doc__)
    parser.add_argument("--points", type=int, default=500_000)
    parser.add_argument("--gaussians", type=int, default=50_000)
    parser.add_argument("--turns", type=int, default=3)
    parser.add_argument("--only", metavar="TEXT", default="", help="only tasks with TEXT in their name")
    options = parser.parse_args(arguments)
    jobs = {name: run for name, run in tasks(options).items() if options.only in name}
    if not jobs or min(options.points, options.gaussians, options.turns) < 1:
        raise InputError("bench clouds: expected counts of at least 1, and --only that names a task")
    turns: dict[str, list[dict[str, Any]]] = {name: [] for name in jobs}
    for _ in range(options.turns):
        for name, run in jobs.items():
            turns[name].append(measure(run))
    rows = [{"task": n, **{key: min(turn[key] for turn in t) for _, key, _ in COLUMNS}} for n, t in turns.items()]
    text = f"{options.points} points, {options.gaussians} Gaussians, {os.cpu_count()} cores, least of {options.turns}\n"
    finish("clouds", options, {"rows": rows, "turns": turns}, text + table(rows, COLUMNS, ("task",)))
