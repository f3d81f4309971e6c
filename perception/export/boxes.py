"""Boxes around the points of instances."""

from __future__ import annotations

from typing import Any

import numpy as np

from perception.types import OrientedBox


def instance_boxes(points: np.ndarray, labels: np.ndarray, trim: float = 0.0) -> dict[int, dict[str, Any]]:
    """{id: {"num_points", "centroid", "aabb": {"min", "max"}, "obb"}} of labelled points [P, 3], labels [P]
    (−1 = none).

    trim: share of points left out at either end of each axis, against strays. Points that are not finite are
    left out.
    """
    inside = (labels >= 0) & np.isfinite(points).all(axis=1)
    order = np.flatnonzero(inside)
    order = order[np.argsort(labels[order], kind="stable")]
    ids, starts = np.unique(labels[order], return_index=True)
    boxes: dict[int, dict[str, Any]] = {}
    for i, rows in zip(ids.tolist(), np.split(order, starts[1:]), strict=True):
        own = points[rows].astype(np.float64)
        low, high = np.quantile(own, [trim, 1 - trim], axis=0)
        boxes[i] = {
            "num_points": len(own),
            "centroid": own.mean(axis=0).tolist(),
            "aabb": {"min": low.tolist(), "max": high.tolist()},
            "obb": oriented_box(own, trim).to_json(),
        }
    return boxes


def oriented_box(points: np.ndarray, trim: float = 0.0) -> OrientedBox:
    """The smallest box of points [P, 3] among those with an edge along x, y or z, or along their principal
    axes.

    About each of the three axes the box turns along the sides of the planar hull, where the least area lies.
    With a trim the choice is made on an even sample of at most 4096 points.
    """
    outline = _hull(points) if trim == 0 else points[:: len(points) // 4096 + 1]
    axes = np.stack(_candidates(outline))
    local = np.einsum("cij,pj->cpi", axes, outline)
    low, high = np.quantile(local, [trim, 1 - trim], axis=1) if trim else (local.min(axis=1), local.max(axis=1))
    extent = high - low
    # A floor of a thousandth of the longest side, so that flat instances compare by their area.
    volume = np.maximum(extent, np.maximum(extent.max(axis=1, keepdims=True) * 1e-3, 1e-12)).prod(axis=1)
    best = int(np.argmax(volume <= 1.001 * volume.min()))  # of equals the first: the world's axes if they do
    return OrientedBox(axes[best].T @ ((low[best] + high[best]) / 2), axes[best], extent[best])


def _hull(points: np.ndarray) -> np.ndarray:
    """The corners of the convex hull [C, 3], or all points when they lie in a plane."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        return points[ConvexHull(points).vertices]
    except (QhullError, ValueError):
        return points


def _candidates(points: np.ndarray) -> list[np.ndarray]:
    """Rotations [3, 3] (rows are axes, right-handed) worth trying; the world's axes come first."""
    found = [np.eye(3)]
    if len(points) < 4:
        return found
    for up in range(3):
        a, b = (up + 1) % 3, (up + 2) % 3
        for direction in _hull_directions(points[:, [a, b]]):
            axes = np.zeros((3, 3))
            axes[0, [a, b]] = direction
            axes[1, [a, b]] = [-direction[1], direction[0]]
            axes[2, up] = 1
            found.append(axes)
    principal = np.linalg.svd(np.cov(points.T))[2]
    principal[2] *= np.sign(np.linalg.det(principal)) or 1
    return [*found, principal]


def _hull_directions(plane: np.ndarray, most: int = 64) -> np.ndarray:
    """Unit directions [D, 2] of the convex hull's longest sides; none when the points lie on a line."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        corners = plane[ConvexHull(plane).vertices]
    except QhullError:
        return np.empty((0, 2))
    sides = np.roll(corners, -1, axis=0) - corners
    length = np.linalg.norm(sides, axis=1)
    longest = np.argsort(-length, kind="stable")[:most]
    return sides[longest] / length[longest, None]
