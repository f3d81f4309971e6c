"""Instances of a Gaussian map onto a cloud: assignment, smoothing and the files the contract promises."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from perception.errors import InputError
from perception.export.assign import nearest_gaussian
from perception.export.smooth import SmoothOptions, read_segments, segment_cloud, vote
from perception.io.cloud import write_cloud
from perception.io.cloud_atomic import replacing
from perception.types import PointCloud


@dataclass(frozen=True)
class ExportOptions:
    """drop_noise: Gaussians without an instance take no part, so every point gets a label (the paper's
    released code).

    max_distance: in map units; None = no limit, as in the paper. smooth: superpoint vote, on or off.
    segments: a ScanNet *.segs.json used instead of an own segmentation.
    """

    drop_noise: bool = True
    max_distance: float | None = None
    smooth: bool = True
    smoothing: SmoothOptions = field(default_factory=SmoothOptions)
    segments: Path | None = None


def export_labels(
    means: np.ndarray,
    instance_ids: np.ndarray,
    opacities: np.ndarray | None,
    cloud: PointCloud,
    options: ExportOptions | None = None,
) -> np.ndarray:
    """Instance of each point [P] int32, −1 = none.

    means [N, 3] in the cloud's frame, instance_ids [N] int32 (−1 = noise), opacities [N] in (0, 1) or None.
    """
    options = options or ExportOptions()
    used = instance_ids >= 0 if options.drop_noise else np.ones(len(instance_ids), bool)
    owner = nearest_gaussian(cloud.points, means[used], max_distance=options.max_distance)
    labels = np.append(instance_ids[used], -1).astype(np.int32)[owner]
    if not options.smooth or not (labels >= 0).any():
        return labels
    if options.segments is not None:
        segments = read_segments(options.segments, len(labels))
    else:
        segments = segment_cloud(cloud, options.smoothing)
    smoothed = vote(labels, segments)
    if options.max_distance is not None:
        smoothed[owner < 0] = -1  # a vote does not reach where the map has nothing
    return np.where(np.isfinite(cloud.points).all(axis=1), smoothed, -1).astype(np.int32)


def check_overlap(means: np.ndarray, points: np.ndarray) -> None:
    """InputError when the cloud lies wholly outside the map's bounds: another frame or another unit."""
    finite = points[np.isfinite(points).all(axis=1)]
    if len(finite) == 0:
        raise InputError("cloud: all coordinates are NaN or infinite; nothing can be labelled")
    low, high = np.percentile(means, 1, axis=0), np.percentile(means, 99, axis=0)
    cloud_low, cloud_high = finite.min(axis=0), finite.max(axis=0)
    gap = np.maximum(np.maximum(low - cloud_high, cloud_low - high), 0)
    if gap.any():
        raise InputError(
            f"cloud: does not overlap the map: it lies {np.linalg.norm(gap):.3g} units away (cloud "
            f"{_box(cloud_low, cloud_high)}, map {_box(low, high)}); bring it into the map's frame"
        )


def _box(low: np.ndarray, high: np.ndarray) -> str:
    return " x ".join(f"{a:.3g}..{b:.3g}" for a, b in zip(low, high, strict=True))


def write_export(
    path: str | Path,
    cloud: PointCloud,
    labels: np.ndarray,
    instances: Mapping[int, Mapping[str, Any]],
) -> dict[str, Any]:
    """Write the cloud with `instance_id` and its sidecar JSON (same stem); returns the sidecar.

    instances: {id: {"score": float, "label": str or None}} of the map; points and order are the cloud's own.
    """
    path = Path(path)
    labelled = PointCloud(cloud.points, cloud.colors, cloud.normals, cloud.faces)
    labelled.labels = {"instance_id": labels.astype(np.int32)}
    ids, counts = np.unique(labels[labels >= 0], return_counts=True)
    sidecar: dict[str, Any] = {"instances": {}}
    for i, n in zip(ids.tolist(), counts.tolist(), strict=True):
        known = instances.get(i, {})
        sidecar["instances"][str(i)] = {
            "score": float(known.get("score", 1.0)),
            "label": known.get("label"),
            "num_points": n,
        }
    write_cloud(path, labelled)
    with replacing(path.with_suffix(".json")) as file:
        file.write(json.dumps(sidecar, indent=1).encode())
    return sidecar
