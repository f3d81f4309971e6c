"""Labelling a cloud by a map: milliseconds and peak memory beside accuracy, over points, rule and smoothing.

Without MAP a scene of touching spheres with exact truth is made. With MAP and a cloud that knows its instances
(`instance_id`), AP by protocol `scannet` stands beside the times. Contenders take turns; printed are median and spread.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from perception.bench.sweep_cli import Column, finish, save_plot, table
from perception.errors import InputError
from perception.types import PointCloud

CASES = (("nearest", False), ("nearest", True), ("densest", False), ("densest", True))


@dataclass(frozen=True)
class ExportScene:
    """Gaussians (means, quats, scales, opacities, ids as in `export_labels`), scores by id, and a cloud."""

    means: np.ndarray
    quats: np.ndarray
    scales: np.ndarray
    opacities: np.ndarray
    ids: np.ndarray
    scores: dict[int, float]
    cloud: PointCloud


def synthetic_scene(gaussians: int, points: int, spheres: int = 64, seed: int = 0) -> ExportScene:
    """Spheres of radius .5 on a grid of pitch 1, so that neighbours touch; Gaussians on their surfaces, 2 % astray."""
    rng = np.random.default_rng(seed)
    side = int(np.ceil(spheres ** (1 / 3)))
    centres = np.stack(np.meshgrid(*[np.arange(side)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)[:spheres]

    def surface(count: int, noise: float) -> tuple[np.ndarray, np.ndarray]:
        owner = rng.integers(spheres, size=count)
        normals = rng.normal(size=(count, 3))
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        return centres[owner] + normals * (0.5 + noise * rng.normal(size=(count, 1))), owner

    means, owner = surface(gaussians, 0.01)
    ids = np.where(rng.random(gaussians) < 0.02, -1, owner).astype(np.int32)
    cloud_points, truth = surface(points, 0.0)
    spacing = np.sqrt(spheres * np.pi / gaussians)
    scales = spacing * rng.uniform(0.5, 1.5, (gaussians, 3))
    quats, opacities = rng.normal(size=(gaussians, 4)), rng.uniform(0.2, 1, gaussians)
    cloud = PointCloud(cloud_points.astype(np.float32), labels={"instance_id": truth.astype(np.int32)})
    floats = [array.astype(np.float32) for array in (means, quats, scales, opacities)]
    return ExportScene(floats[0], floats[1], floats[2], floats[3], ids, dict.fromkeys(range(spheres), 1.0), cloud)


def map_scene(path: Path, points: Path | None) -> ExportScene:
    """A map and a cloud; without `points` the map's own surface."""
    from perception.io.cloud import read_cloud
    from perception.io.store import read_map
    from perception.pipeline.exporting import surface_points

    gmap = read_map(path)
    cloud = surface_points(gmap) if points is None else read_cloud(points)
    scores = {entry["id"]: float(entry["score"]) for entry in gmap.instances}
    return ExportScene(gmap.means, gmap.quats, gmap.scales, gmap.opacities, gmap.instance_ids, scores, cloud)


def measure(scene: ExportScene, shares: Sequence[float], turns: int) -> list[dict[str, Any]]:
    """A row for every share of the cloud's points (every n-th point), rule and smoothing."""
    from perception.export.labels import ExportOptions, export_labels
    from perception.pipeline.record import PeakMemory

    clouds = {share: _thinned(scene.cloud, share) for share in shares}
    cells = [(share, rule, smooth) for share in shares for rule, smooth in CASES]
    times: dict[Any, list[float]] = {cell: [] for cell in cells}
    rows: dict[Any, dict[str, Any]] = {}
    for turn in range(turns + 1):  # the first turn warms up
        for cell in cells:
            share, rule, smooth = cell
            peak, began = PeakMemory(), time.perf_counter()
            labels = export_labels(
                scene.means,
                scene.ids,
                scene.opacities,
                clouds[share],
                ExportOptions(rule=rule, smooth=smooth),
                quats=scene.quats,
                scales=scene.scales,
            )
            if turn:
                times[cell].append(1e3 * (time.perf_counter() - began))
                continue
            rows[cell] = {"rule": rule, "smooth": "yes" if smooth else "no", "points": len(labels)}
            rows[cell] |= {"peak_mib": peak.mib()} | _scores(labels, scene, clouds[share])
    for cell, row in rows.items():
        q25, q50, q75 = np.percentile(times[cell], [25, 50, 75])
        row |= {"ms": float(q50), "spread_ms": float(q75 - q25), "us_per_point": 1e3 * float(q50) / row["points"]}
    return list(rows.values())


def _thinned(cloud: PointCloud, share: float) -> PointCloud:
    rows = np.linspace(0, len(cloud.points) - 1, max(1, round(share * len(cloud.points)))).round().astype(int)
    colors = None if cloud.colors is None else cloud.colors[rows]
    normals = None if cloud.normals is None else cloud.normals[rows]
    return PointCloud(cloud.points[rows], colors, normals, labels={k: v[rows] for k, v in cloud.labels.items()})


def _scores(labels: np.ndarray, scene: ExportScene, cloud: PointCloud) -> dict[str, Any]:
    truth = cloud.labels.get("instance_id")
    if truth is None:
        return {}
    from perception.evaluate.instances import evaluate

    result = evaluate(labels, scene.scores, truth)
    return {key: result[key] for key in ("ap", "ap50", "ap25")}


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line."""
    parser = argparse.ArgumentParser(prog="perception bench export", description=__doc__)
    parser.add_argument("map", nargs="?", type=Path, metavar="MAP")
    parser.add_argument("--points", type=Path, metavar="CLOUD", help="with `instance_id` it is scored, too")
    parser.add_argument("-o", "--output", type=Path, default=Path("bench-export"))
    parser.add_argument("--shares", type=float, nargs="+", default=[0.1, 0.3, 1.0], help="shares of the points")
    parser.add_argument("--turns", type=int, default=7)
    parser.add_argument("--gaussians", type=int, default=100_000, help="of the scene that is made")
    parser.add_argument("--cloud", type=int, default=300_000, metavar="N", help="points of the scene that is made")
    options = parser.parse_args(arguments)
    if not all(0 < share <= 1 for share in options.shares) or options.turns < 1:
        raise InputError(f"--shares {options.shares}, --turns {options.turns}: expected shares in (0, 1], turns >= 1")
    made = options.map is None
    scene = synthetic_scene(options.gaussians, options.cloud) if made else map_scene(options.map, options.points)
    rows = measure(scene, options.shares, options.turns)
    columns: tuple[Column, ...] = (
        ("points", "points", "d"),
        ("ms", "ms", ".0f"),
        ("spread", "spread_ms", ".0f"),
        ("us/point", "us_per_point", ".2f"),
        ("MiB", "peak_mib", ".0f"),
        ("AP", "ap", ".3f"),
        ("AP50", "ap50", ".3f"),
        ("AP25", "ap25", ".3f"),
    )
    name = "made scene" if made else str(options.map)
    text = f"{name}: {len(scene.means)} Gaussians; median of {options.turns} turns, spread = quartiles' distance\n"
    _plot(options.output / "export.png", name, rows)
    finish("export", options, {"rows": rows}, text + table(rows, columns, ("rule", "smooth")))
    return 0


def _plot(path: Path, name: str, rows: Sequence[dict[str, Any]]) -> None:
    def draw(figure: Any) -> None:
        axis = figure.subplots()
        for rule, smooth in CASES:
            held = [row for row in rows if row["rule"] == rule and row["smooth"] == ("yes" if smooth else "no")]
            label = f"{rule}{', superpoint vote' if smooth else ''}"
            half = [row["spread_ms"] / 2 for row in held]
            axis.errorbar([row["points"] for row in held], [row["ms"] for row in held], half, marker="o", label=label)
        axis.set(xscale="log", yscale="log", xlabel="points", ylabel="ms", title=name)
        axis.grid(alpha=0.3)
        axis.legend(fontsize=8)

    save_plot(path, draw, (6, 4.2))


if __name__ == "__main__":
    raise SystemExit(main())
