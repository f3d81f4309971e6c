"""Transfers instance ids of a map to the points of a cloud: nearest Gaussian, then superpoint vote."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from perception.errors import InputError
from perception.export.neighbors import auto_distance, nearest_gaussian
from perception.export.smooth import read_segments, segment_cloud, vote
from perception.types import PointCloud

SCANNET = Path("scannet")


@dataclass(frozen=True)
class ExportOptions:
    """How labels are transferred; the defaults are the paper's.

    drop_noise: Gaussians without an instance are ignored, so every point gets a label (as in the released code).
    max_distance: in map units; None = no limit; "auto" = computed from the map's spacing (`auto_distance`).
    smooth: superpoint vote, on or off. segments: a ScanNet *.segs.json to use instead of our own segmentation, or
    SCANNET for the one that ScanNet's segmentator makes of a mesh.
    """

    drop_noise: bool = True
    max_distance: float | str | None = None
    smooth: bool = True
    segments: Path | None = None


def export_labels(
    means: np.ndarray, instance_ids: np.ndarray, cloud: PointCloud, options: ExportOptions | None = None
) -> np.ndarray:
    """Instance of each point [P] int32, −1 = none: that of the nearest mean (OpenSplat3D, point cloud transfer).

    means [N, 3] in the cloud's frame, instance_ids [N] int32 (−1 = noise).
    """
    options = resolved(options or ExportOptions(), means, instance_ids)
    limit = options.max_distance
    assert not isinstance(limit, str)  # resolved
    used = np.isfinite(means).all(axis=1) & ((instance_ids >= 0) | (not options.drop_noise))
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


def resolved(options: ExportOptions, means: np.ndarray, instance_ids: np.ndarray) -> ExportOptions:
    """The options with `max_distance` as a number or None."""
    limit = options.max_distance
    if limit is None or (isinstance(limit, float | int) and limit >= 0):
        return options
    if limit != "auto":
        raise InputError(f"max_distance is {limit}; expected a length that is not negative, or auto")
    used = means[instance_ids >= 0] if options.drop_noise else means
    return replace(options, max_distance=auto_distance(used))


def check_overlap(means: np.ndarray, points: np.ndarray) -> float:
    """Share of the finite points inside the map's bounds (1st to 99th percentile of its means).

    InputError when the two bounding boxes do not overlap: the cloud has another frame or unit.
    """
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
