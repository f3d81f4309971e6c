"""Coordinate frames other than the map's, such as a robot's base frame or a metric frame."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from perception.errors import InputError
from perception.types import OrientedBox

_TOLERANCE = 1e-4
"""Largest deviation of R Rᵀ / s² from the identity: float32 poses pass, shears do not."""


@dataclass(frozen=True)
class Frame:
    """A named frame. from_map [4, 4]: the transform frame_from_map, rigid or a similarity.

    A scale other than 1 converts units, for example those of a reconstruction into metres.
    """

    name: str
    from_map: np.ndarray

    def __post_init__(self) -> None:
        object.__setattr__(self, "from_map", check_similarity(self.from_map, f"frame '{self.name}'"))

    @property
    def to_map(self) -> np.ndarray:
        """map_from_frame [4, 4]."""
        return np.linalg.inv(self.from_map)


def check_similarity(a_from_b: Any, name: str = "a_from_b") -> np.ndarray:
    """`a_from_b` as float64 [4, 4]; InputError unless it is a rotation times a positive scale, and a translation."""
    try:
        matrix = np.asarray(a_from_b, np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name}: expected 4 × 4 numbers, found {str(a_from_b)[:60]!r}") from error
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise InputError(f"{name}: expected a finite [4, 4] transform, found shape {list(matrix.shape)}")
    scale = scale_of(matrix)
    linear = matrix[:3, :3] / scale if scale > 0 else matrix[:3, :3]
    straight = np.abs(linear @ linear.T - np.eye(3)).max() <= _TOLERANCE
    if scale <= 0 or not straight or not np.array_equal(matrix[3], [0, 0, 0, 1]):
        raise InputError(
            f"{name}: expected a rotation, a positive scale and a translation with last row 0 0 0 1; "
            "found a shear, a mirror or another last row"
        )
    return matrix


def scale_of(a_from_b: np.ndarray) -> float:
    """The scale of a similarity [4, 4]: the cube root of the determinant, negative for a mirror."""
    return float(np.cbrt(np.linalg.det(a_from_b[:3, :3])))


def move_points(a_from_b: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Transforms points [..., 3] from frame b to a in float64; returns their own float dtype, else float64."""
    moved = np.asarray(points, np.float64) @ a_from_b[:3, :3].T + a_from_b[:3, 3]
    return moved.astype(points.dtype if np.issubdtype(np.asarray(points).dtype, np.floating) else np.float64)


def move_box(a_from_b: np.ndarray, box: OrientedBox) -> OrientedBox:
    """Transforms an oriented box from frame b to frame a."""
    scale = scale_of(a_from_b)
    rotation = np.asarray(box.rotation, np.float64) @ (a_from_b[:3, :3] / scale).T  # rows are axes
    center = a_from_b[:3, :3] @ np.asarray(box.center, np.float64) + a_from_b[:3, 3]
    return OrientedBox(center, rotation, np.asarray(box.extent, np.float64) * scale)
