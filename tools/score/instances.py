"""Scores the instances of maps against the exact truth of their scenes.

python tools score.instances SCENE MAP …

AP with the map's scores and with constant ones, things and stuff together and apart, and mIoU of rendered masks.
Reliability: of all instances with 100 points or more, the score, and whether the IoU with a true one exceeds 0.5.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from perception.bench.output import Column, bench_parser, table
from perception.errors import InputError
from perception.geometry import align_similarity, camera_centres
from perception.inputs.transforms import read_frames
from perception.io.documents import read_json
from perception.map.map import Map
from perception.photos.views import make_view
from perception.types import PointCloud
from score.masks import evaluate_rendered
from score.reliability import SCORED, finish_reliability, parse_pairs


def read_scene(scene: Path) -> dict[str, Any]:
    """The content of scene.json. Raises InputError when the file is missing."""
    if not (scene / "scene.json").is_file():
        raise InputError(f"{scene}: no scene.json there; expected the folder of a scene with truth")
    return dict(read_json(scene / "scene.json"))


def read_truth_cloud(scene: Path, gmap: Map) -> PointCloud:
    """gt_points.ply in the map's frame, which for a map from photos alone is found from the true camera centres. Raises
    InputError without the label `instance_id`, or with most points off the map."""
    from perception.export.export_map import check_overlap
    from perception.io.cloud import read_cloud

    cloud = read_cloud(scene / "gt_points.ply")
    if "instance_id" not in cloud.labels:
        raise InputError(f"{scene / 'gt_points.ply'}: expected a property instance_id, found none")
    if gmap.info.get("scene", {}).get("input") == "photos":
        frames = read_json(scene / "transforms.json")["frames"]
        centres = {Path(f["file_path"]).name: np.array(f["transform_matrix"])[:3, 3] for f in frames}
        true = np.stack([centres[view.name] for view in gmap.views])
        scale, turn, shift = align_similarity(camera_centres(gmap.poses), true)
        cloud.points[:] = scale * cloud.points.astype(np.float64) @ turn.T + shift
        if cloud.normals is not None:
            cloud.normals[:] = cloud.normals.astype(np.float64) @ turn.T
    if check_overlap(gmap.means, cloud.points) < 0.5:
        raise InputError(f"{scene}: most of its points lie outside the map; map the scene with its transforms.json")
    return cloud


def score_map(scene: Path, map_path: Path) -> dict[str, Any]:
    """AP (protocol scannet, class-agnostic, exported labels with smoothing) and rendered mIoU against ground truth.

    Under the key SCORED, a pair for each instance with at least MIN_POINTS points: its score, and 1 if its IoU with a
    true instance exceeds 0.5, else 0.
    """
    from perception.evaluate.instances import evaluate, overlap_of_ids, read_truth
    from perception.export.export_map import export_labels
    from perception.export.render import as_gaussians
    from perception.map.write import read_map

    gmap = read_map(map_path)
    cloud = read_truth_cloud(scene, gmap)
    truth = cloud.labels["instance_id"]
    about = read_scene(scene)["instances"]
    stuff = np.isin(truth, [entry["id"] for entry in about if entry["is_stuff"]])
    labels = export_labels(gmap.means, gmap.instance_ids, cloud)
    confidence = {entry["id"]: float(entry["score"]) for entry in gmap.instances}
    unseen = [view for view in gmap.views if view.held_out] or gmap.views
    if gmap.info.get("scene", {}).get("input") == "splat":  # whose views are virtual: every 8th camera of the scene
        cameras = sorted(read_frames(scene / "transforms.json"), key=lambda frame: frame[0])[::8]
        unseen = [make_view(Path(name).name, Path(), lens, pose, scene) for name, pose, lens in cameras]
    rendered = evaluate_rendered(as_gaussians(gmap), gmap.instance_ids, unseen, scene / "masks_gt")
    rows = {}
    for name, ignore in (("all", None), ("things", stuff), ("stuff", ~stuff)):
        for kind, scores in (("calibrated", confidence), ("constant", None)):
            result = evaluate(labels, scores, truth, ignore=ignore)
            rows[f"{name}, {kind}"] = {key: result[key] for key in ("ap", "ap50", "ap25")}
    overlap = overlap_of_ids(labels, confidence, read_truth(truth))
    scored = np.stack([overlap.pred_scores, overlap.iou.max(axis=1, initial=0) > 0.5], axis=1)
    return {
        "scene": str(scene),
        "map": str(map_path),
        "ap": rows,
        SCORED: scored[overlap.pred_sizes >= MIN_POINTS].tolist(),
        "instances": len(gmap.instances),
        "truth": len(about),
        "parts": sum(len(entry.get("parts", [])) for entry in gmap.instances),
        "noise_share": float(np.mean(gmap.instance_ids < 0)),
        "rendered_miou": rendered["miou"],
    }


MIN_POINTS = 100
COLUMNS: tuple[Column, ...] = (("AP", "ap", ".3f"), ("AP50", "ap50", ".3f"), ("AP25", "ap25", ".3f"))


def main(arguments: Sequence[str] | None = None) -> None:
    """Prints the tables; JSON goes to the output folder."""
    options, pairs = parse_pairs(bench_parser("instances", __doc__), "SCENE MAP", arguments)
    results = [score_map(scene, gmap) for scene, gmap in pairs]
    lines = []
    for result in results:
        rows = [{"instances": name, **row} for name, row in result["ap"].items()]
        lines += [
            table(rows, COLUMNS, ("instances",)),
            f"{result['instances']} instances ({result['parts']} parts) for {result['truth']} true ones, "
            f"{result['noise_share']:.1%} of the Gaussians noise, rendered mIoU {result['rendered_miou']:.3f}",
        ]
    finish_reliability("instances", options, results, lines, "scores")


if __name__ == "__main__":
    main()
