"""Oriented boxes around point sets."""

from __future__ import annotations

import numpy as np

from perception.types import OrientedBox


def oriented_box(points: np.ndarray) -> OrientedBox:
    """The box along the principal axes of points [P, 3] float, P >= 1; longest axis first, right-handed.

    Coincident or coplanar points give zero extents along the missing axes. The sign of each axis is fixed by its
    largest component being positive, so equal sets in any order have equal boxes.
    """
    points = np.asarray(points, np.float64)
    mean = points.mean(axis=0)
    _, axes = np.linalg.eigh((points - mean).T @ (points - mean))
    rotation = axes[:, ::-1].T.copy()
    for row in rotation[:2]:
        if row[np.abs(row).argmax()] < 0:
            row *= -1
    rotation[2] = np.cross(rotation[0], rotation[1])
    local = (points - mean) @ rotation.T
    low, high = local.min(axis=0), local.max(axis=0)
    return OrientedBox(mean + (low + high) / 2 @ rotation, rotation, high - low)
