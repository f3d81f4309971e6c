"""Aligns random scans of a scene with exact truth to a map of it: right, refused and wrong ones.

    python tools align.run room.gsmap scenes/room --cases 50 [--plain] [--metric]

A scan is gt_points.ply, cut to 60 % by a random plane, with 5 mm of noise, turned, moved and scaled by 0.01 to 100.
Right: within 0.3° and 1 cm (root mean square) of the truth. For the others, the stage that lost the place is told.
"""

import argparse
import time
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from perception.export import align as module
from perception.export.export_map import LONG_SIDE, MOST_VIEWS, rendered_depth
from perception.geometry import move_points
from perception.io.cloud import read_cloud
from perception.map.write import read_map
from perception.types import PointCloud


def case(views, cloud, seed, metric, plain):
    """(outcome, stage that lost the place and figures, degrees, metres)."""
    rng = np.random.default_rng(seed)
    height = cloud.points @ rng.normal(size=3)
    kept = height <= np.quantile(height, 0.6)
    points = cloud.points[kept] + rng.normal(0, 0.005, (kept.sum(), 3))
    scale = 1 if metric else 10 ** rng.uniform(-2, 2)
    turn, shift = Rotation.random(random_state=rng).as_matrix(), rng.uniform(-20, 20, 3)
    scan = PointCloud(scale * points @ turn + shift, None if plain else cloud.colors[kept])
    job = module.Registration(views, scan, not metric)
    right = module.Similarity(turn / scale, turn @ (job.scan_middle - shift) / scale - job.middle)
    candidates = job.candidates()
    refined = job.refined(candidates)
    stages = {"candidates": candidates, "best": job._distinct(candidates, 0.04, module.REFINED), "ICP": refined[:3]}
    lost = [name for name, places in stages.items() if not any(job.apart(p, right) < job.extent / 10 for p in places)]
    found = job.finished(refined)
    degrees = np.degrees(Rotation.from_matrix(found.map_from_scan[:3, :3] / found.scale @ turn.T).magnitude())
    away = np.sqrt(((move_points(found.map_from_scan, scan.points) - points) ** 2).sum(axis=1).mean())
    outcome = "refused" if found.refusal else "right" if degrees < 0.3 and away < 0.01 else "WRONG"
    return outcome, f"lost in {lost[:1]}, {found.refusal}", degrees, away


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("map", type=Path)
    parser.add_argument("scene", type=Path)
    parser.add_argument("--cases", type=int, default=50)
    parser.add_argument("--metric", action="store_true", help="the scan's unit is the metre")
    parser.add_argument("--plain", action="store_true", help="the scan has no colours")
    args = parser.parse_args()
    views, cloud = rendered_depth(read_map(args.map), MOST_VIEWS, LONG_SIDE), read_cloud(args.scene / "gt_points.ply")
    rows = []
    for seed in range(args.cases):
        started = time.process_time()
        rows.append(case(views, cloud, seed, args.metric, args.plain))
        print(
            seed,
            *rows[-1][:2],
            f"{rows[-1][2]:.3f}° {100 * rows[-1][3]:.2f} cm {time.process_time() - started:.0f} CPU s",
        )
    print({name: [row[0] for row in rows].count(name) for name in ("right", "refused", "WRONG")}, end=" ")
    print("medians of the right ones:", np.median([row[2:] for row in rows if row[0] == "right"], axis=0), "° and m")
