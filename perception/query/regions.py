"""Regions of space: an oriented box, or a prism over a polygon (for example a room of a floor plan)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from perception.boxes import move_box
from perception.errors import InputError
from perception.geometry import check_similarity, move_points
from perception.types import OrientedBox


@dataclass(frozen=True)
class Prism:
    """The volume over a polygon [n, 2] of x and y, n >= 3, between the heights low and high along z.

    The polygon may be concave; its last corner joins the first. Its coordinates are in the prism's own frame, which
    `from_prism` [4, 4] transforms into the frame where the prism is used.
    """

    polygon: np.ndarray
    low: float = -np.inf
    high: float = np.inf
    from_prism: np.ndarray = field(default_factory=lambda: np.eye(4))

    def __post_init__(self) -> None:
        corners = _numbers(self.polygon, "region: polygon")
        if corners.ndim != 2 or corners.shape[1] != 2 or len(corners) < 3:
            raise InputError(f"region: polygon has shape {list(corners.shape)}, expected [n, 2] with n >= 3")
        if np.isnan([self.low, self.high]).any() or self.low > self.high:
            raise InputError(f"region: heights from {self.low} to {self.high}, expected low <= high")
        object.__setattr__(self, "polygon", corners)


Region = OrientedBox | Prism


def axis_box(low: Sequence[float] | np.ndarray, high: Sequence[float] | np.ndarray) -> OrientedBox:
    """The box along the axes between two corners [3]; InputError unless low <= high."""
    a, b = _numbers(low, "region: low corner"), _numbers(high, "region: high corner")
    if a.shape != (3,) or b.shape != (3,) or (a > b).any():
        raise InputError(f"region: corners {a.tolist()} and {b.tolist()}, expected two [3] points with low <= high")
    return OrientedBox((a + b) / 2, np.eye(3), b - a)


def inside(region: Region, points: np.ndarray) -> np.ndarray:
    """Which of points [P, 3] lie in `region`, borders included for boxes: bool [P]."""
    if isinstance(region, OrientedBox):
        local = (np.asarray(points, np.float64) - region.center) @ np.asarray(region.rotation).T
        return (np.abs(local) <= np.asarray(region.extent) / 2).all(axis=1)
    local = move_points(np.linalg.inv(region.from_prism), np.asarray(points, np.float64))
    between = (local[:, 2] >= region.low) & (local[:, 2] <= region.high)
    return between & _in_polygon(region.polygon, local[:, :2])


def move_region(a_from_b: np.ndarray, region: Region) -> Region:
    """Transforms a region from frame b to frame a."""
    if isinstance(region, OrientedBox):
        return move_box(a_from_b, region)
    return Prism(region.polygon, region.low, region.high, a_from_b @ region.from_prism)


def check_region(region: Any) -> Region:
    """`region`, validated; InputError for any other type or for an invalid box."""
    if isinstance(region, Prism):
        return region
    if isinstance(region, OrientedBox):
        return check_box(region)
    raise InputError(f"region: found {type(region).__name__}, expected an OrientedBox, axis_box(low, high) or Prism")


def check_box(box: OrientedBox) -> OrientedBox:
    """The box with float64 arrays; InputError unless its rotation is a rotation matrix and its extent is >= 0."""
    center, extent = _numbers(box.center, "region: center"), _numbers(box.extent, "region: extent")
    rotation = _numbers(box.rotation, "region: rotation")
    if center.shape != (3,) or extent.shape != (3,) or rotation.shape != (3, 3) or (extent < 0).any():
        raise InputError("region: expected a center [3], an extent [3] >= 0 and a rotation [3, 3]")
    pose = np.eye(4)
    pose[:3, :3] = rotation
    check_similarity(pose, "region: rotation")
    if abs(np.linalg.det(rotation) - 1) > 1e-3:
        raise InputError("region: rotation is scaled, expected rows of length 1")
    return OrientedBox(center, rotation, extent)


def _in_polygon(corners: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Even-odd rule: a ray towards +x crosses the border an odd number of times."""
    odd = np.zeros(len(points), bool)
    x, y = points[:, 0], points[:, 1]
    for (x1, y1), (x2, y2) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        spans = (y1 > y) != (y2 > y)
        if y1 != y2:
            odd ^= spans & (x < x1 + (y - y1) * (x2 - x1) / (y2 - y1))
    return odd


def _numbers(value: Any, name: str) -> np.ndarray:
    try:
        array = np.asarray(value, np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name}: expected numbers, found {str(value)[:60]!r}") from error
    if not np.isfinite(array).all():
        raise InputError(f"{name}: expected finite numbers, found {str(value)[:60]!r}")
    return array
