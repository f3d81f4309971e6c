"""The space around the cameras of few photos, into which Gaussians reach only where something was measured.

Colours of few photos leave free how far a surface is. What shows a wall in some can then hang before the cameras
of others that do not see it, and it is a veil before photos taken between these.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from perception.gaussians.densify import rotation_matrices
from perception.gaussians.model import Gaussians
from perception.gaussians.views import TrainingView

REACH, NEAREST = 0.8, 0.01
"""Radius of the space around a camera, as a share of the depth of the nearest points in its photo, of which the share
NEAREST is noise. With 0.5 veils hung between the spaces of neighbouring cameras."""
MEASURED = 0.5
"""Share of that radius within which a measured point must lie, and up to which a Gaussian there may extend. With 0.25 a
plain wall beside the cameras goes, too, that only edges of photos show: 0.7 dB with every 2nd photo of a fox."""


class FreeSpace:
    """points [P, 3]: what was measured, here the means of the first Gaussians; views: of the cameras."""

    def __init__(self, points: np.ndarray, views: Sequence[TrainingView]):
        from scipy.spatial import cKDTree

        self._measured = cKDTree(points)
        self._balls = [_ball(points, view) for view in views]

    def reached_by(self, gaussians: Gaussians) -> np.ndarray:
        """[N] bool: whether each Gaussian reaches, by a standard deviation, into the space around a camera, and was not
        measured there."""
        means, scales = (tensor.cpu().double().numpy() for tensor in (gaussians.means, gaussians.scales))
        widest, found = scales.max(axis=1), np.zeros(len(means), bool)
        x, y, z = np.ascontiguousarray(means.T)
        for center, radius in self._balls:
            distance = np.sqrt((x - center[0]) ** 2 + (y - center[1]) ** 2 + (z - center[2]) ** 2)
            near = np.flatnonzero((distance - widest < radius) & (radius > 0) & ~found)
            axes = rotation_matrices(gaussians.quats.cpu()[near]).double().numpy()
            toward = ((center - means[near])[:, :, None] * axes).sum(axis=1) / np.maximum(distance[near], 1e-9)[:, None]
            extent = np.sqrt(((scales[near] * toward) ** 2).sum(axis=1))  # standard deviation on the ray to the camera
            measured = self._measured.query(means[near])[0] <= MEASURED * radius
            found[near] = (distance[near] - extent < radius) & ~(measured & (extent <= MEASURED * radius))
        return found


def _ball(points: np.ndarray, view: TrainingView) -> tuple[np.ndarray, float]:
    """Centre [3] of the camera, and the radius around it; 0 where its photo shows no point."""
    K, pose = view.K.double().numpy(), view.camera_from_world.double().numpy()
    x, y, z = ((points[:, None] * pose[:3, :3]).sum(axis=2) + pose[:3, 3]).T  # rounded alike with any threads
    depth = np.where(z > 0, z, 1)
    column, row = K[0, 0] * x / depth + K[0, 2], K[1, 1] * y / depth + K[1, 2]
    height, width = view.photo.shape[:2]
    inside = (z > 0) & (column >= 0) & (row >= 0) & (column < width) & (row < height)
    radius = REACH * float(np.quantile(z[inside], NEAREST)) if inside.any() else 0.0
    return -pose[:3, :3].T @ pose[:3, 3], radius
