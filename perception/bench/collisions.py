"""Objects that share no photo and fall into one instance, with and without the cure: `perception bench collisions`.

The paper's loss pushes apart only what some photo shows together; features of things that share no photo are free to
coincide. Here they do so on purpose: pairs of balls with one feature, each pair member seen by cameras of its own.
With a scene and a map of it, the same is counted on that map's true instances.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

GAPS = (2.0, 4.0, 8.0, 16.0)
METHODS = ("features alone", "split in space", "consensus")


def collision_rate(ids: np.ndarray, truth: np.ndarray, together: np.ndarray) -> dict[str, float]:
    """Of the pairs of true instances that share no photo: the share whose main instance is the same.

    ids [N], truth [N] int (negative = none); together [G, G] bool: some photo shows both.
    """
    count = len(together)
    main = np.full(count, -1)
    for g in range(count):
        found = ids[(truth == g) & (ids >= 0)]
        if len(found):
            main[g] = np.bincount(found).argmax()
    a, b = np.triu_indices(count, 1)
    apart = ~together[a, b] & (main[a] >= 0) & (main[b] >= 0)
    hits = int((main[a] == main[b])[apart].sum())
    return {"pairs": int(apart.sum()), "collisions": hits, "rate": hits / max(int(apart.sum()), 1)}


def pair_scene(gap: float, pairs: int = 6, seed: int = 0) -> tuple[Any, np.ndarray]:
    """(scene, together): two rows of balls `gap` apart, opposite balls of one feature; no camera sees both rows."""
    from perception.bench.blob_scenes import make_scene

    rng = np.random.default_rng(seed)
    along = 0.8 * np.arange(pairs)
    rows = [np.stack([along, np.full(pairs, y), np.zeros(pairs)], axis=1) for y in (0.0, gap)]
    features = np.concatenate([rng.normal(0, 0.4, (pairs, 8))] * 2)
    cameras = []
    for row, side in zip(rows, (-1.0, 1.0), strict=True):  # from outside, steeply down: the other row is out of view
        for x in np.linspace(0, along[-1], 6):
            target = np.array([x, row[0, 1], 0.0])
            cameras.append((target + np.array([0.3, -0.45 * side, 1.4]), target))
    scene = make_scene(np.concatenate(rows), features, cameras, each=200, radius=0.25, focal=70.0, seed=seed)
    return scene, _together(scene)


def _together(scene: Any) -> np.ndarray:
    """[G, G] bool by rendering: the pairs of which some photo shows both."""
    from perception.instances.silhouettes import render_silhouettes

    count = int(scene.truth.max()) + 1
    together = np.zeros((count, count), bool)
    for view in scene.views:
        height, width = view.photo.shape[:2]
        seen = (
            render_silhouettes(scene.gaussians, scene.truth, view.camera_from_world, view.K, width, height).pixels > 0
        )
        together |= seen[:, None] & seen[None]
    return together


def measure(scene: Any, together: np.ndarray) -> dict[str, dict[str, float]]:
    """Collisions of a scene by method."""
    from perception.config import InstanceConfig
    from perception.instances.cluster import cluster_features, split_disconnected
    from perception.instances.group import group
    from perception.instances.votes import mask_votes

    g, config = scene.gaussians, InstanceConfig()
    means, scales, opacities, features = (t.numpy() for t in (g.means, g.scales, g.opacities, g.features))
    plain = cluster_features(features, config)[0]
    found = {
        METHODS[0]: plain,
        METHODS[1]: split_disconnected(means, scales, plain, config.min_cluster_size),
        METHODS[2]: group(means, scales, opacities, features, mask_votes(g, scene.views), config).ids,
    }
    return {name: collision_rate(ids, scene.truth, together) for name, ids in found.items()}


def measure_map(scene: Path, map_path: Path) -> dict[str, dict[str, float]]:
    """Collisions of a map of a truth scene: as it stands, and by its features alone."""
    import cv2

    from perception.config import InstanceConfig
    from perception.instances.cluster import cluster_features
    from perception.io.cloud import read_cloud
    from perception.io.store import read_map

    from scipy.spatial import cKDTree  # isort: skip

    gmap, cloud = read_map(map_path), read_cloud(scene / "gt_points.ply")
    _, nearest = cKDTree(cloud.points).query(gmap.means)
    names, truth = np.unique(cloud.labels["instance_id"], return_inverse=True)
    together = np.zeros((len(names), len(names)), bool)
    for file in sorted((scene / "masks_gt").glob("*.png")):
        seen = np.isin(names, np.unique(np.asarray(cv2.imread(str(file), cv2.IMREAD_UNCHANGED))))
        together |= seen[:, None] & seen[None]
    solid = gmap.opacities >= InstanceConfig().min_opacity
    features = np.where(solid, 0, -1)
    features[solid] = cluster_features(gmap.features[solid], InstanceConfig())[0]
    owner = np.where(solid, truth.reshape(-1)[nearest], -1)
    return {
        METHODS[0]: collision_rate(features, owner, together),
        "the map": collision_rate(gmap.instance_ids, owner, together),
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Prints the table, or one JSON object with --json."""
    parser = argparse.ArgumentParser(prog="perception bench collisions", description=__doc__.splitlines()[0])
    parser.add_argument("scene", type=Path, nargs="?", help="folder of a truth scene")
    parser.add_argument("map", type=Path, nargs="?", help="its map")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args(arguments)
    if (args.scene is None) != (args.map is None):
        parser.error("give SCENE and MAP together, or neither")
    if args.scene is not None:
        result = {str(args.map): measure_map(args.scene, args.map)}
    else:
        result = {f"rows {gap:g} apart": measure(*pair_scene(gap)) for gap in GAPS}
    if args.json:
        print(json.dumps(result))
        return 0
    for title, rows in result.items():
        print(title)
        for name, row in rows.items():
            print(
                f"  {name:<18}{row['collisions']:>4} of {row['pairs']} pairs without a common photo ({row['rate']:.1%})"
            )
    return 0
