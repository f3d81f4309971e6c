"""A map's instances against its scene's truth: `perception bench instances SCENE MAP`.

AP with the map's scores and with constant ones, things and stuff together and apart, and mIoU of rendered masks.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np


def score_map(scene: Path, map_path: Path) -> dict[str, Any]:
    """AP (protocol scannet, class-agnostic, exported with smoothing) and rendered mIoU of a map of a truth scene."""
    from perception.evaluate.instances import evaluate
    from perception.evaluate.rendered import rendered_miou
    from perception.export.transfer import export_labels
    from perception.io.cloud import read_cloud
    from perception.io.store import read_map
    from perception.pipeline.rendering import as_gaussians, map_views

    gmap = read_map(map_path)
    cloud = read_cloud(scene / "gt_points.ply")
    truth = cloud.labels["instance_id"]
    about = json.loads((scene / "scene.json").read_text(encoding="utf-8"))["instances"]
    stuff = np.isin(truth, [entry["id"] for entry in about if entry["is_stuff"]])
    labels = export_labels(gmap.means, gmap.instance_ids, cloud)
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
    from perception.pipeline.rendering import as_gaussians, map_views
    from perception.pipeline.top_view import instances_top_view

    gmap = read_map(map_path)
    gaussians = as_gaussians(gmap)
    pictures = {"above": instances_top_view(gmap, 720)}
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


def main(arguments: Sequence[str] | None = None) -> int:
    """Prints the table, or one JSON object with --json."""
    parser = argparse.ArgumentParser(prog="perception bench instances", description=__doc__.splitlines()[0])
    parser.add_argument("scene", type=Path, help="folder of a truth scene")
    parser.add_argument("map", type=Path, help="its map")
    parser.add_argument("-o", "--output", type=Path, help="folder for pictures from above and of two views")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args(arguments)
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
