"""Oriented boxes around point sets, and the geometry of instances."""

from __future__ import annotations

from typing import Any

import numpy as np

from perception.errors import InputError
from perception.geometry import check_similarity, numbers, scale_of, transform
from perception.types import OrientedBox

BOX_TRIM = 0.01
"""Share of an instance's Gaussians left out of its oriented box at either end of each axis, as outliers."""
SAMPLE = 4096
"""Maximum number of points from which the axes of a trimmed box are chosen."""


def oriented_box(points: np.ndarray, trim: float = 0.0) -> OrientedBox:
    """The smallest box of finite points [P, 3] float, P >= 1, among those with an edge along x, y or z, or along
    their principal axes.

    For each of these axes, rotations about it that align with a side of the planar convex hull are tried; the least
    area is at one of them. Axes: longest side first, right-handed, largest component positive, so the result does not
    depend on the order of points. Coplanar points give a zero extent. trim: share of points left out at either end of
    each axis, against outliers; the axes are then chosen on an even sample.
    """
    points = np.asarray(points, np.float64)
    hull = None if trim else _hull(points)
    outline = points[:: len(points) // SAMPLE + 1] if trim else points if hull is None else hull
    outline = outline[np.lexsort(outline.T)]
    axes = _candidates(outline)
    low, high = _sides(axes, outline, trim)
    extent = high - low
    # A floor of a thousandth of the longest side, so that flat instances compare by their area.
    volume = np.maximum(extent, np.maximum(extent.max(axis=1, keepdims=True) * 1e-3, 1e-12)).prod(axis=1)
    best = int(np.argmax(volume <= 1.001 * volume.min()))  # the first of equals: the world axes if they qualify
    rotation = axes[best][np.argsort(-extent[best], kind="stable")]
    for row in rotation[:2]:
        if row[np.abs(row).argmax()] < 0:
            row *= -1
    rotation[2] = np.cross(rotation[0], rotation[1])
    low, high = _sides(rotation[None], points if trim else outline, trim)
    return OrientedBox(rotation.T @ ((low[0] + high[0]) / 2), rotation, high[0] - low[0])


def _sides(axes: np.ndarray, points: np.ndarray, trim: float) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest coordinates [C, 3] of points along the rows of axes [C, 3, 3]."""
    low, high = np.quantile(np.einsum("cij,pj->cpi", axes, points), [trim, 1 - trim], axis=1)
    return low, high


def _hull(points: np.ndarray) -> np.ndarray | None:
    """The corners of the convex hull of points [P, D]; None when they lie in a plane, or in 2D on a line."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        return np.asarray(points[ConvexHull(points).vertices])
    except (QhullError, ValueError):
        return None


def _candidates(points: np.ndarray) -> np.ndarray:
    """Candidate rotations [C, 3, 3] (rows are axes): the world axes, then those about each that align with one of the
    64 longest sides of the planar convex hull, then the principal axes."""
    found = [np.eye(3)]
    for up in range(3) if len(points) >= 4 else ():
        a, b = (up + 1) % 3, (up + 2) % 3
        corners = _hull(points[:, [a, b]])
        if corners is None:
            continue
        sides = np.roll(corners, -1, axis=0) - corners
        length = np.linalg.norm(sides, axis=1)
        longest = np.argsort(-length, kind="stable")[:64]
        for direction in sides[longest] / length[longest, None]:
            axes = np.zeros((3, 3))
            axes[0, [a, b]] = direction
            axes[1, [a, b]] = [-direction[1], direction[0]]
            axes[2, up] = 1
            found.append(axes)
    centred = points - points.mean(axis=0)
    return np.stack([*found, np.linalg.svd(centred.T @ centred)[2]])


def move_box(a_from_b: np.ndarray, box: OrientedBox) -> OrientedBox:
    """Transforms an oriented box from frame b to frame a."""
    scale = scale_of(a_from_b)
    rotation = np.asarray(box.rotation, np.float64) @ (a_from_b[:3, :3] / scale).T  # rows are axes
    center = a_from_b[:3, :3] @ np.asarray(box.center, np.float64) + a_from_b[:3, 3]
    return OrientedBox(center, rotation, np.asarray(box.extent, np.float64) * scale)


def instance_entry(
    instance: int, points: np.ndarray, weights: np.ndarray, score: float, views: int, label: str | None = None
) -> dict[str, Any]:
    """The entry in instances.json of Gaussians at points [G, 3] float64 with opacities `weights` [G]; views: number of
    photos that show it."""
    return {
        "id": instance,
        "label": label,
        "score": score,
        "num_gaussians": len(points),
        "views": views,
        "centroid": (weights @ points / max(weights.sum(), 1e-12)).tolist(),
        "obb": oriented_box(points, BOX_TRIM).to_json(),
        "aabb": {"min": points.min(axis=0).tolist(), "max": points.max(axis=0).tolist()},
    }


def inside(box: OrientedBox, points: np.ndarray) -> np.ndarray:
    """Which of points [P, 3] lie in `box`, borders included: bool [P]."""
    local = (np.asarray(points, np.float64) - box.center) @ np.asarray(box.rotation).T
    return (np.abs(local) <= np.asarray(box.extent) / 2).all(axis=1)


def check_box(box: Any) -> OrientedBox:
    """The box with float64 arrays; InputError unless its rotation is a rotation matrix and its extent is >= 0."""
    if not isinstance(box, OrientedBox):
        raise InputError(f"region: found {type(box).__name__}, expected an OrientedBox or axis_box(low, high)")
    center, extent = numbers(box.center, "region: center"), numbers(box.extent, "region: extent")
    rotation = numbers(box.rotation, "region: rotation")
    if center.shape != (3,) or extent.shape != (3,) or rotation.shape != (3, 3) or (extent < 0).any():
        raise InputError("region: expected a center [3], an extent [3] >= 0 and a rotation [3, 3]")
    check_similarity(transform(rotation, [0.0, 0.0, 0.0]), "region: rotation")
    if abs(np.linalg.det(rotation) - 1) > 1e-3:
        raise InputError("region: rotation is scaled, expected rows of length 1")
    return OrientedBox(center, rotation, extent)
