"""The files of an export: the labelled cloud the contract promises, and what else was asked for."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from perception.errors import InputError
from perception.export.formats import Instances, instance_colors, write_boxes, write_scannet, write_split
from perception.export.labels import ExportOptions, check_overlap, export_labels, resolved
from perception.io.atomic import replacing
from perception.io.cloud import read_cloud, write_cloud
from perception.types import PointCloud


@dataclass(frozen=True)
class Outputs:
    """What is written beside the labelled cloud: paths, None = not.

    color: of the cloud's points, "original" or "instance". split: folder for one cloud an instance; boxes:
    JSON; scannet: folder of a submission (scene = the cloud's stem); mcap: ROS 2 bag file. frame and metric
    are the map's.
    """

    color: str = "original"
    split: Path | None = None
    boxes: Path | None = None
    scannet: Path | None = None
    mcap: Path | None = None
    frame: str = "map"
    metric: bool = False


def run_export(
    out: str | Path,
    cloud: str | Path | PointCloud,
    means: np.ndarray,
    instance_ids: np.ndarray,
    instances: Instances,
    *,
    opacities: np.ndarray | None = None,
    quats: np.ndarray | None = None,
    scales: np.ndarray | None = None,
    classes: Mapping[int, int] | None = None,
    options: ExportOptions | None = None,
    outputs: Outputs | None = None,
) -> tuple[dict[str, Any], str]:
    """Label a cloud (a file or in memory) by the map's Gaussians and write it: (JSON-able result, table).

    means [N, 3] and instance_ids [N] int32 (−1 = noise) in the cloud's frame; opacities, quats and scales as
    in export_labels; instances: {id: {"score", "label"}}; classes: semantic id by instance id, written as
    `semantic_id` (0 where unknown) and into the submission.
    """
    options, outputs = resolved(options or ExportOptions(), means, instance_ids), outputs or Outputs()
    if outputs.color not in ("original", "instance"):
        raise InputError(f"color is '{outputs.color}'; expected original or instance")
    began = time.perf_counter()
    source = cloud if isinstance(cloud, PointCloud) else read_cloud(cloud)
    inside = check_overlap(means, source.points)
    labels = export_labels(means, instance_ids, opacities, source, options, quats=quats, scales=scales)
    painted = source
    if outputs.color == "instance":
        painted = PointCloud(source.points, instance_colors(labels), source.normals, source.faces)
    _write_others(outputs, Path(out).stem, painted, labels, instances, classes)
    sidecar = write_export(out, painted, labels, instances, classes)  # last: where the cloud lies, all lies
    result = {
        "points": len(labels),
        "labelled": int((labels >= 0).sum()),
        "inside_map": inside,
        "seconds": time.perf_counter() - began,
        "rule": options.rule,
        "max_distance": options.max_distance,
        "smoothed": options.smooth,
        **sidecar,
    }
    return result, _table(result)


def _write_others(
    outputs: Outputs,
    scene: str,
    cloud: PointCloud,
    labels: np.ndarray,
    instances: Instances,
    classes: Mapping[int, int] | None,
) -> None:
    if outputs.split is not None:
        write_split(outputs.split, cloud, labels)
    if outputs.boxes is not None:
        write_boxes(outputs.boxes, cloud.points, labels, instances, frame=outputs.frame, metric=outputs.metric)
    if outputs.scannet is not None:
        write_scannet(outputs.scannet, scene, labels, instances, classes)
    if outputs.mcap is not None:
        from perception.export.mcap import write_mcap

        write_mcap(outputs.mcap, cloud, labels, instances, frame=outputs.frame)


def _table(result: dict[str, Any]) -> str:
    lines = [f"{'id':>6}{'points':>12}{'score':>8}  label"]
    rows = sorted(result["instances"].items(), key=lambda row: -row[1]["num_points"])
    lines += [f"{i:>6}{r['num_points']:>12}{r['score']:>8.3f}  {r['label'] or ''}" for i, r in rows]
    lines.append(f"{result['labelled']} of {result['points']} points labelled, {result['seconds']:.1f} s")
    if result["max_distance"] is not None:
        lines.append(f"points farther than {result['max_distance']:.4g} from every Gaussian are -1")
    if result["inside_map"] < 0.5:
        lines.append(f"only {result['inside_map']:.0%} of the points lie inside the map: same frame and unit?")
    return "\n".join(lines)


def write_export(
    path: str | Path,
    cloud: PointCloud,
    labels: np.ndarray,
    instances: Instances,
    classes: Mapping[int, int] | None = None,
) -> dict[str, Any]:
    """Write the cloud with `instance_id` and its sidecar JSON (same stem); returns the sidecar.

    instances: {id: {"score": float, "label": str or None}} of the map; points and order are the cloud's own.
    """
    path = Path(path)
    labelled = PointCloud(cloud.points, cloud.colors, cloud.normals, cloud.faces)
    labelled.labels = {"instance_id": labels.astype(np.int32)}
    if classes is not None:
        known_ids, index = np.unique(labels, return_inverse=True)
        semantic = np.array([classes.get(i, 0) for i in known_ids.tolist()], np.int32)
        labelled.labels["semantic_id"] = semantic[index]
    ids, counts = np.unique(labels[labels >= 0], return_counts=True)
    sidecar: dict[str, Any] = {"instances": {}}
    for i, n in zip(ids.tolist(), counts.tolist(), strict=True):
        known = instances.get(i, {})
        sidecar["instances"][str(i)] = {
            "score": float(known.get("score", 1.0)),
            "label": known.get("label"),
            "num_points": n,
        }
    with replacing(path.with_suffix(".json")) as file:
        file.write(json.dumps(sidecar, indent=1).encode())
    write_cloud(path, labelled)
    return sidecar
