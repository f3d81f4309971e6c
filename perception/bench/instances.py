"""A map's instances against its scene's truth, and where the confidences come from: `perception bench instances`.

perception bench instances SCENE MAP [-o DIR]    AP with the map's scores and with constant ones, things and stuff
                                                 together and apart, mIoU of rendered masks; pictures into DIR
perception bench instances --calibrate           fits the calibration on random scenes that are no one's truth
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

RATES = (0.15, 0.3, 0.45, 0.54)
KNOTS = (0.0, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.85, 1.0)


def score_map(scene: Path, map_path: Path) -> dict[str, Any]:
    """AP (protocol scannet, class-agnostic, exported with smoothing) and rendered mIoU of a map of a truth scene."""
    from perception.evaluate.instances import evaluate
    from perception.evaluate.rendered import rendered_miou
    from perception.export.labels import export_labels
    from perception.io.cloud import read_cloud
    from perception.io.store import read_map
    from perception.pipeline.rendering import as_gaussians, map_views

    gmap = read_map(map_path)
    cloud = read_cloud(scene / "gt_points.ply")
    truth = cloud.labels["instance_id"]
    about = json.loads((scene / "scene.json").read_text(encoding="utf-8"))["instances"]
    stuff = np.isin(truth, [entry["id"] for entry in about if entry["is_stuff"]])
    labels = export_labels(gmap.means, gmap.instance_ids, gmap.opacities, cloud)
    confidence = {entry["id"]: float(entry["score"]) for entry in gmap.instances}
    rows = {}
    for name, ignore in (("all", None), ("things", stuff), ("stuff", ~stuff)):
        for kind, scores in (("calibrated", confidence), ("constant", None)):
            result = evaluate(labels, scores, truth, ignore=ignore)
            rows[f"{name}, {kind}"] = {key: result[key] for key in ("ap", "ap50", "ap25")}
    return {
        "scene": str(scene),
        "map": str(map_path),
        "ap": rows,
        "instances": len(gmap.instances),
        "truth": len(about),
        "parts": sum(len(entry.get("parts", [])) for entry in gmap.instances),
        "noise_share": float(np.mean(gmap.instance_ids < 0)),
        "rendered_miou": rendered_miou(as_gaussians(gmap), gmap.instance_ids, map_views(gmap), scene / "masks_gt"),
    }


def write_pictures(map_path: Path, folder: Path) -> list[str]:
    """The instances from above and in two of the map's held-out views, as PNGs; their paths."""
    import cv2
    import torch

    from perception.instances.silhouettes import render_silhouettes
    from perception.io.store import read_map
    from perception.pictures import colorize_instances
    from perception.pipeline.above import instances_from_above
    from perception.pipeline.rendering import as_gaussians, map_views

    gmap = read_map(map_path)
    gaussians = as_gaussians(gmap)
    pictures = {"above": instances_from_above(gmap, 720)}
    views = map_views(gmap)
    for view in (views[0], views[len(views) // 2]):
        pose = torch.from_numpy(view.camera_from_world.astype(np.float32))
        K = torch.from_numpy(view.K.astype(np.float32))
        ids = render_silhouettes(gaussians, gmap.instance_ids, pose, K, view.width, view.height).ids
        pictures[Path(view.name).stem] = colorize_instances(ids)
    folder.mkdir(parents=True, exist_ok=True)
    for name, picture in pictures.items():
        cv2.imwrite(str(folder / f"{name}.png"), np.ascontiguousarray(picture[..., ::-1]))
    return [str(folder / f"{name}.png") for name in pictures]


def calibrate(scenes: int) -> dict[str, Any]:
    """Raw scores of instances found in random scenes with erring masks, beside whether each is right (IoU > .5).

    Returns the isotonic fit at KNOTS, made strictly rising by a hundredth so that ranks survive, and the counts.
    """
    from sklearn.isotonic import IsotonicRegression

    from perception.bench.blob_scenes import random_scene, with_errors
    from perception.config import InstanceConfig
    from perception.instances.group import group
    from perception.instances.votes import mask_votes

    raw, right = [], []
    for seed in range(scenes):
        rng = np.random.default_rng([seed, 1])
        made = random_scene(
            seed,
            int(rng.integers(8, 30)),
            views=int(rng.integers(2, 9)),
            crowding=float(rng.uniform(1, 2.2)),
            feature_noise=float(rng.uniform(0.1, 0.5)),
        )
        scene = with_errors(made, rng, RATES[seed % len(RATES)])
        g = scene.gaussians
        means, scales, opacities, features = (t.numpy() for t in (g.means, g.scales, g.opacities, g.features))
        found = group(means, scales, opacities, features, mask_votes(g, scene.views), InstanceConfig())
        raw += found.raw.tolist()
        right += (_best_iou(found.ids, scene.truth, found.count) > 0.5).tolist()
    fit = IsotonicRegression(y_min=0, y_max=1, out_of_bounds="clip").fit(raw, np.array(right, float))
    chance = 0.99 * fit.predict(KNOTS) + 0.01 * np.array(KNOTS)
    return {
        "scenes": scenes,
        "instances": len(raw),
        "right": int(np.sum(right)),
        "knots": [[x, round(float(y), 3)] for x, y in zip(KNOTS, chance, strict=True)],
    }


def _best_iou(ids: np.ndarray, truth: np.ndarray, count: int) -> np.ndarray:
    table = np.zeros((count + 1, int(truth.max()) + 1))
    np.add.at(table, (ids, truth), 1)
    inside = table[:-1]
    union = inside.sum(axis=1, keepdims=True) + table.sum(axis=0) - inside
    return np.asarray((inside / union).max(axis=1))


def main(arguments: Sequence[str] | None = None) -> int:
    """Prints the table, or one JSON object with --json."""
    parser = argparse.ArgumentParser(prog="perception bench instances", description=__doc__.splitlines()[0])
    parser.add_argument("scene", type=Path, nargs="?", help="folder of a truth scene")
    parser.add_argument("map", type=Path, nargs="?", help="its map")
    parser.add_argument("-o", "--output", type=Path, help="folder for pictures from above and of two views")
    parser.add_argument("--calibrate", action="store_true", help="fit the confidences on random scenes")
    parser.add_argument("--scenes", type=int, default=40, help="random scenes for --calibrate")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args(arguments)
    if args.calibrate:
        print(json.dumps(calibrate(args.scenes)))
        return 0
    if args.scene is None or args.map is None:
        parser.error("give SCENE and MAP, or --calibrate")
    result = score_map(args.scene, args.map)
    if args.output is not None:
        result["pictures"] = write_pictures(args.map, args.output)
    if args.json:
        print(json.dumps(result))
        return 0
    print(f"{'':<22}{'AP':>8}{'AP50':>8}{'AP25':>8}")
    for name, row in result["ap"].items():
        cells = ["-" if row[key] is None else f"{row[key]:.3f}" for key in ("ap", "ap50", "ap25")]
        print(f"{name:<22}" + "".join(f"{cell:>8}" for cell in cells))
    print(f"{result['instances']} instances ({result['parts']} parts) for {result['truth']} true ones", end=", ")
    print(f"{result['noise_share']:.1%} of the Gaussians noise, rendered mIoU {result['rendered_miou']:.3f}")
    return 0
