"""Transfers instance ids of a map to the points of a cloud: nearest Gaussian, then superpoint vote. Writes labelled
clouds with their sidecars.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from perception.errors import InputError
from perception.export.neighbors import nearest_gaussian
from perception.export.smooth import read_segments, segment_cloud, vote
from perception.io.atomic import atomic_file
from perception.io.cloud import write_cloud
from perception.types import PointCloud

SCANNET = Path("scannet")


@dataclass(frozen=True)
class ExportOptions:
    """How labels are transferred; the defaults are the paper's.

    max_distance: in map units, beyond which points stay unlabelled; None = no limit.
    smooth: superpoint vote, on or off. segments: a ScanNet *.segs.json to use instead of our own segmentation, or
    SCANNET for the one that ScanNet's segmentator makes of a mesh.
    """

    max_distance: float | None = None
    smooth: bool = True
    segments: Path | None = None


def export_labels(
    means: np.ndarray, instance_ids: np.ndarray, cloud: PointCloud, options: ExportOptions | None = None
) -> np.ndarray:
    """Instance of each point [P] int32, −1 = none: that of the nearest mean (OpenSplat3D, point cloud transfer).
    means [N, 3] in the cloud's frame, instance_ids [N] int32 (−1 = noise, ignored as in the released code)."""
    options = options or ExportOptions()
    limit = options.max_distance
    if limit is not None and not limit >= 0:
        raise InputError(f"max_distance is {limit}; expected a length that is not negative")
    used = np.isfinite(means).all(axis=1) & (instance_ids >= 0)
    nearest = nearest_gaussian(cloud.points, means[used], max_distance=limit)
    labels = np.append(instance_ids[used], -1).astype(np.int32)[nearest]
    if not options.smooth or not (labels >= 0).any():
        return labels
    given = options.segments
    if given in (None, SCANNET):
        segments = segment_cloud(cloud, scannet=given is not None)
    else:
        segments = read_segments(given, len(labels))
    smoothed = vote(labels, segments)
    if limit is not None:
        smoothed[labels < 0] = -1  # points beyond the map stay unlabelled
    return np.where(np.isfinite(cloud.points).all(axis=1), smoothed, -1).astype(np.int32)


def check_overlap(means: np.ndarray, points: np.ndarray) -> float:
    """Share of the finite points inside the map's bounds (1st to 99th percentile of its means).
    InputError when the two bounding boxes do not overlap: the cloud has another frame or unit."""
    finite = points[np.isfinite(points).all(axis=1)]
    if len(finite) == 0:
        raise InputError("cloud: all coordinates are NaN or infinite; nothing can be labelled")
    means = means[np.isfinite(means).all(axis=1)]
    if len(means) == 0:
        raise InputError("map: holds no Gaussians; nothing can be labelled")
    low, high = np.percentile(means, 1, axis=0), np.percentile(means, 99, axis=0)
    cloud_low, cloud_high = finite.min(axis=0), finite.max(axis=0)
    gap = np.maximum(np.maximum(low - cloud_high, cloud_low - high), 0)
    if gap.any():
        raise InputError(
            f"cloud: does not overlap the map: it lies {np.linalg.norm(gap):.3g} units away (cloud "
            f"{_box(cloud_low, cloud_high)}, map {_box(low, high)}); bring it into the map's frame"
        )
    inside = ((finite >= low) & (finite <= high)).all(axis=1)
    return float(inside.mean())


def _box(low: np.ndarray, high: np.ndarray) -> str:
    return " x ".join(f"{a:.3g}..{b:.3g}" for a, b in zip(low, high, strict=True))


Instances = Mapping[int, Mapping[str, Any]]


def write_export(
    path: str | Path,
    cloud: PointCloud,
    labels: np.ndarray,
    instances: Instances,
    facts: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Writes the cloud with `instance_id` and its sidecar JSON (same stem); returns the sidecar.

    labels [P] int32, −1 = none; points and order are the cloud's own. instances: {id: {"score", "label"}} of the map.
    Entries have "score", "label", "num_points"; those of parts also their `parent`, of groups the `instances` in them.
    facts: further keys of the sidecar.
    """
    path, rows = Path(path), {}
    ids, counts = np.unique(labels[labels >= 0], return_counts=True)
    for i, n in zip(ids.tolist(), counts.tolist(), strict=True):
        known = instances.get(i, {})
        row = {"score": float(known.get("score", 1.0)), "label": known.get("label"), "num_points": n}
        rows[str(i)] = row | {key: known[key] for key in ("parent", "instances") if key in known}
    sidecar = {**(facts or {}), "instances": rows}
    with atomic_file(path.with_suffix(".json")) as new:
        new.write_text(json.dumps(sidecar, indent=1), encoding="utf-8")
    labelled = {"instance_id": labels.astype(np.int32)}
    write_cloud(path, PointCloud(cloud.points, cloud.colors, cloud.normals, cloud.faces, labelled))
    return sidecar
