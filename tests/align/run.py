"""Random scans of a scene with exact truth, aligned to maps of it: right, refused and wrong ones.

    python tests/align/run.py room.gsmap scenes/room --cases 50 [--plain] [--metric]

A scan is gt_points.ply, cut to 60 % by a random plane, with 5 mm of noise, turned, moved and scaled by 0.01 to 100.
Right: within 0.3° and 1 cm (root mean square) of the truth. The stage that lost a right place is told for the others.
"""

from __future__ import annotations

import argparse
import collections
import time
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from perception.export import align as module
from perception.geometry import scale_of
from perception.io.cloud import read_cloud
from perception.io.store import read_map
from perception.pipeline.placing import LONG_SIDE, MOST_VIEWS, rendered_depth
from perception.types import PointCloud


def scan_of(cloud: PointCloud, seed: int, metric: bool, plain: bool) -> tuple[PointCloud, np.ndarray]:
    """The scan, and map_from_scan [4, 4]."""
    rng = np.random.default_rng(seed)
    height = cloud.points @ rng.normal(size=3)
    kept = height <= np.quantile(height, 0.6)
    points = cloud.points[kept] + rng.normal(0, 0.005, (kept.sum(), 3))
    scale = 1.0 if metric else float(10 ** rng.uniform(-2, 2))
    turn, shift = Rotation.random(random_state=rng).as_matrix(), rng.uniform(-20, 20, 3)
    map_from_scan = np.eye(4)
    map_from_scan[:3, :3], map_from_scan[:3, 3] = turn / scale, -turn @ shift / scale
    return PointCloud(scale * points @ turn + shift, None if plain else cloud.colors[kept]), map_from_scan


def errors(found: np.ndarray, true: np.ndarray, points: np.ndarray) -> tuple[float, float]:
    """(degrees, root mean square distance of the scan's points from their true places)."""
    turn = Rotation.from_matrix(found[:3, :3] / scale_of(found) @ (true[:3, :3] / scale_of(true)).T)
    away = points @ (found - true)[:3, :3].T + (found - true)[:3, 3]
    return float(np.degrees(turn.magnitude())), float(np.sqrt((away**2).sum(axis=1).mean()))


def run(views: list[module.DepthView], scan: PointCloud, true: np.ndarray, metric: bool) -> tuple[str, float, float]:
    """(outcome, degrees, metres)."""
    job = module.Registration(views, scan, not metric)
    linear = true[:3, :3]
    right = module.Place(linear, linear @ job.scan_middle + true[:3, 3] - job.middle)
    near = lambda places: any(job.apart(place, right) < 0.1 * job.extent for place in places)  # noqa: E731
    candidates = job.candidates()
    kept = job._distinct(candidates, 0.04, module.REFINED)
    places = job.refined(candidates)
    found = job.finished(places)
    degrees, away = errors(found.map_from_scan, true, scan.points)
    stages = ("no candidate", near(candidates)), ("not kept", near(kept)), ("not refined", near(places[:3]))
    stage = next((name for name, held in stages if not held), "judged otherwise")
    if found.refusal is None:
        return "right" if degrees < 0.3 and away < 0.01 else "WRONG", degrees, away
    why = f"{found.agreement:.3f} {found.cover:.2f} {found.rival:.2f} {found.stiffness:.1e} {found.likeness}"
    return f"refused ({stage if away > 0.05 else 'at the right place'}) {why}", degrees, away


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("map", type=Path)
    parser.add_argument("scene", type=Path)
    parser.add_argument("--cases", type=int, default=50)
    parser.add_argument("--first", type=int, default=0, help="seed of the first case")
    parser.add_argument("--metric", action="store_true", help="the scan's unit is the metre")
    parser.add_argument("--plain", action="store_true", help="the scan has no colours")
    args = parser.parse_args()
    gmap, cloud = read_map(args.map), read_cloud(args.scene / "gt_points.ply")
    moved = np.array(gmap.info["scene"].get("map_from_input", np.eye(4)))
    assert np.array_equal(moved, np.eye(4)), "the map left the frame of its input"
    views, told, accepted = rendered_depth(gmap, MOST_VIEWS, LONG_SIDE), collections.Counter(), []
    for seed in range(args.first, args.first + args.cases):
        scan, true = scan_of(cloud, seed, args.metric, args.plain)
        started = time.process_time()
        outcome, degrees, away = run(views, scan, true, args.metric)
        seconds = time.process_time() - started
        print(f"{seed}: {outcome}, {degrees:.3f}° {100 * away:.2f} cm, {seconds:.0f} CPU s", flush=True)
        told[outcome.split(" ")[0]] += 1
        if outcome == "right":
            accepted.append((degrees, 100 * away))
    print(dict(told), "medians of the right ones: {:.3f}° {:.2f} cm".format(*np.median(accepted or [[0, 0]], axis=0)))


if __name__ == "__main__":
    main()
