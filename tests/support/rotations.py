"""Rotations written out, as an oracle for those of libraries."""

from __future__ import annotations

import numpy as np


def rotation_from_quaternion(wxyz: np.ndarray) -> np.ndarray:
    """Rotation [3, 3] of a quaternion [4] wxyz; the quaternion need not be of unit length."""
    w, x, y, z = np.asarray(wxyz, dtype=np.float64) / np.linalg.norm(wxyz)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
