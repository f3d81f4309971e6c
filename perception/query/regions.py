"""Boxes as regions of space: made, validated, and tested for points."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from perception.errors import InputError
from perception.geometry import check_similarity
from perception.types import OrientedBox


def axis_box(low: Sequence[float] | np.ndarray, high: Sequence[float] | np.ndarray) -> OrientedBox:
    """The box along the axes between two corners [3]; InputError unless low <= high."""
    a, b = _numbers(low, "region: low corner"), _numbers(high, "region: high corner")
    if a.shape != (3,) or b.shape != (3,) or (a > b).any():
        raise InputError(f"region: corners {a.tolist()} and {b.tolist()}, expected two [3] points with low <= high")
    return OrientedBox((a + b) / 2, np.eye(3), b - a)


def inside(box: OrientedBox, points: np.ndarray) -> np.ndarray:
    """Which of points [P, 3] lie in `box`, borders included: bool [P]."""
    local = (np.asarray(points, np.float64) - box.center) @ np.asarray(box.rotation).T
    return (np.abs(local) <= np.asarray(box.extent) / 2).all(axis=1)


def check_box(box: Any) -> OrientedBox:
    """The box with float64 arrays; InputError unless its rotation is a rotation matrix and its extent is >= 0."""
    if not isinstance(box, OrientedBox):
        raise InputError(f"region: found {type(box).__name__}, expected an OrientedBox or axis_box(low, high)")
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


def _numbers(value: Any, name: str) -> np.ndarray:
    try:
        array = np.asarray(value, np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name}: expected numbers, found {str(value)[:60]!r}") from error
    if not np.isfinite(array).all():
        raise InputError(f"{name}: expected finite numbers, found {str(value)[:60]!r}")
    return array
