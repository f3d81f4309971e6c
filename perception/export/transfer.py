"""Instances of a Gaussian map onto the points of a cloud: assignment, then the superpoint vote."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from perception.errors import InputError
from perception.export.assign import auto_distance, nearest_gaussian
from perception.export.likelihood import densest_instance
from perception.export.smooth import SmoothOptions, read_segments, segment_cloud, vote
from perception.types import PointCloud


@dataclass(frozen=True)
class ExportOptions:
    """rule: "nearest" mean (the paper), or "densest" instance, which asks for the Gaussians' shapes.

    drop_noise: Gaussians without an instance take no part, so every point gets a label (the paper's
    released code).

    max_distance: in map units; None = no limit, as in the paper; "auto" = measured from the map's own spacing
    (`auto_distance`). smooth: superpoint vote, on or off.
    segments: a ScanNet *.segs.json used instead of an own segmentation.
    """

    rule: str = "nearest"
    drop_noise: bool = True
    max_distance: float | str | None = None
    smooth: bool = True
    smoothing: SmoothOptions = field(default_factory=SmoothOptions)
    segments: Path | None = None


@dataclass(frozen=True)
class _Gaussians:
    means: np.ndarray
    ids: np.ndarray
    opacities: np.ndarray | None
    quats: np.ndarray | None
    scales: np.ndarray | None

    def rows(self, used: np.ndarray) -> _Gaussians:
        parts = (self.means, self.ids, self.opacities, self.quats, self.scales)
        return _Gaussians(*(None if part is None else part[used] for part in parts))  # type: ignore[arg-type]


def export_labels(
    means: np.ndarray,
    instance_ids: np.ndarray,
    opacities: np.ndarray | None,
    cloud: PointCloud,
    options: ExportOptions | None = None,
    *,
    quats: np.ndarray | None = None,
    scales: np.ndarray | None = None,
) -> np.ndarray:
    """Instance of each point [P] int32, −1 = none.

    means [N, 3] in the cloud's frame, instance_ids [N] int32 (−1 = noise). The rule "densest" also asks for
    opacities [N] in (0, 1), quats [N, 4] wxyz and scales [N, 3] > 0.
    """
    used = np.isfinite(means).all(axis=1)
    options = resolved(options or ExportOptions(), means, instance_ids)
    if options.drop_noise:
        used &= instance_ids >= 0
    gaussians = _Gaussians(means, instance_ids, opacities, quats, scales).rows(used)
    labels = _assigned(gaussians, cloud.points, options)
    if not options.smooth or not (labels >= 0).any():
        return labels
    if options.segments is not None:
        segments = read_segments(options.segments, len(labels))
    else:
        segments = segment_cloud(cloud, options.smoothing)
    smoothed = vote(labels, segments)
    if options.max_distance is not None:
        smoothed[labels < 0] = -1  # a vote does not reach where the map has nothing
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


def _assigned(g: _Gaussians, points: np.ndarray, options: ExportOptions) -> np.ndarray:
    limit = options.max_distance
    assert not isinstance(limit, str)  # resolved
    if options.rule == "nearest":
        owner = nearest_gaussian(points, g.means, max_distance=limit)
        return np.append(g.ids, -1).astype(np.int32)[owner]
    if options.rule != "densest":
        raise InputError(f"assignment rule '{options.rule}' is unknown; expected nearest or densest")
    if g.opacities is None or g.quats is None or g.scales is None:
        raise InputError("assignment rule 'densest' needs the Gaussians' rotations, scales and opacities")
    return densest_instance(points, g.means, g.quats, g.scales, g.opacities, g.ids, max_distance=limit)


def check_overlap(means: np.ndarray, points: np.ndarray) -> float:
    """Share of the finite points inside the map's bounds (1st to 99th percentile of its means).

    InputError when the cloud lies wholly outside them: another frame or another unit.
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
