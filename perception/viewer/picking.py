"""Picking: the instance that a ray through the map shows."""

from __future__ import annotations

import numpy as np

from perception.io.store import Map

PIXEL = 0.0015
"""Angle of a click in radians: about a pixel of a laptop's window."""
SEEN = 0.15
"""Smallest weight in the picture, in [0, 1], at which an instance is picked."""


def pick(gmap: Map, ids: np.ndarray, shown: np.ndarray, origin: np.ndarray, direction: np.ndarray) -> int | None:
    """The instance id that a ray (origin [3], direction [3], map frame) shows, None when it meets none.

    A pixel is rendered along the ray: the instance with the largest weight in it. shown [N] bool: Gaussians that are
    visible.
    """
    import torch

    from perception.gaussians.rasterize import rasterize

    origin, direction = np.asarray(origin, np.float64), np.asarray(direction, np.float64)
    if not np.isfinite([origin, direction]).all() or not direction.any():
        return None
    # A cheap test first: only Gaussians within four radii of the ray contribute.
    unit = direction / np.linalg.norm(direction)
    away = gmap.means - origin
    along = away @ unit
    off = np.linalg.norm(away - along[:, None] * unit, axis=1)
    near = np.flatnonzero(shown & (along > 0) & (off < 4 * (gmap.scales.max(axis=1) + PIXEL * along)))
    found, owner = np.unique(ids[near], return_inverse=True)
    if not (found >= 0).any():
        return None
    side = np.cross(unit, np.eye(3)[np.abs(unit).argmin()])
    axes = np.stack([side, np.cross(unit, side), unit])
    pose = np.eye(4)
    pose[:3, :3] = axes / np.linalg.norm(axes, axis=1, keepdims=True)
    pose[:3, 3] = -pose[:3, :3] @ origin
    K = np.array([[1 / PIXEL, 0, 0.5], [0, 1 / PIXEL, 0.5], [0, 0, 1]])
    arrays = (gmap.means[near], gmap.quats[near], gmap.scales[near], gmap.opacities[near], pose[None], K[None])
    means, quats, scales, opacities, camera, lens = (torch.from_numpy(array.astype(np.float32)) for array in arrays)
    features, colors = torch.nn.functional.one_hot(torch.from_numpy(owner.reshape(-1))).float(), torch.zeros_like(means)
    with torch.no_grad():
        out = rasterize(means, quats, scales, opacities, colors, camera, lens, 1, 1, features=features)
    assert out.features is not None
    weights = np.where(found >= 0, out.features[0, 0, 0].numpy(), 0)
    return int(found[weights.argmax()]) if weights.max() >= SEEN else None


def covariances(gmap: Map) -> np.ndarray:
    """[N, 3, 3] float32 covariance matrices R S Sᵀ Rᵀ of the Gaussians."""
    norms = np.linalg.norm(gmap.quats, axis=1, keepdims=True)
    quats = np.where(norms > 0, gmap.quats / np.where(norms > 0, norms, 1), np.array([1, 0, 0, 0], np.float32))
    w, x, y, z = quats.astype(np.float32).T
    a, b, c = (gmap.scales.astype(np.float32) ** 2).T
    columns = (  # of the rotation, each times its axis' variance; written out, it is ten times as fast as matmul
        (1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y), a),
        (2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x), b),
        (2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y), c),
    )
    found = np.empty((len(gmap), 3, 3), np.float32)
    for i in range(3):
        for j in range(i, 3):
            found[:, i, j] = found[:, j, i] = sum(column[i] * column[j] * column[3] for column in columns)
    return found
