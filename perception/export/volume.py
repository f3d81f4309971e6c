"""Space on a grid of voxels, from rendered depth: free, occupied or unknown; distances; closed bodies of instances."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import ndimage

from perception.errors import InputError
from perception.export.depth_views import DepthView, observe
from perception.export.neighbors import nearest_gaussian

UNKNOWN, FREE, OCCUPIED = 0, 1, 2
MOST_VOXELS = 200_000_000
_SLAB = 1 << 19


def grid_shape(low: np.ndarray, high: np.ndarray, voxel: float) -> tuple[int, int, int]:
    """Voxels of a side above 0 from corner `low` to beyond `high`; InputError when they are too many."""
    shape = np.maximum(np.ceil((high - low) / voxel), 1)
    if shape.prod() > MOST_VOXELS:
        raise InputError(f"--voxel-size {voxel:g} gives {shape.prod():.2g} voxels; at most {MOST_VOXELS:.0e} are held")
    return int(shape[0]), int(shape[1]), int(shape[2])


def centres(low: np.ndarray, shape: Sequence[int], voxel: float) -> np.ndarray:
    """Centres [X · Y · Z, 3] of the voxels, z fastest."""
    return (np.indices(shape).reshape(len(shape), -1).T + 0.5) * voxel + low


def occupancy(low: np.ndarray, shape: tuple[int, int, int], voxel: float, views: Sequence[DepthView]) -> np.ndarray:
    """[X, Y, Z] uint8: OCCUPIED where views see a surface in the voxel (depth within half its diagonal of the centre),
    unless more than twice as many see farther, then FREE; UNKNOWN where none looks or all are blocked."""
    state = np.empty(shape, np.uint8).reshape(shape[0], -1)
    slab = max(_SLAB // (shape[1] * shape[2]), 1)
    for x in range(0, shape[0], slab):
        part = (min(slab, shape[0] - x), *shape[1:])
        on, free, _ = observe(centres(low + np.array([x * voxel, 0, 0]), part, voxel), views, voxel * np.sqrt(3) / 2)
        found = np.where((on > 0) & (2 * on >= free), OCCUPIED, np.where(free > 0, FREE, UNKNOWN))
        state[x : x + part[0]] = found.reshape(part[0], -1)
    return state.reshape(shape)


def signed_distance(state: np.ndarray, voxel: float) -> np.ndarray:
    """[X, Y, Z] float32: distance of each centre to the nearest occupied one, in map units; in occupied voxels minus
    that to the nearest other. Unknown space is no obstacle here; infinity if nothing is occupied."""
    held = state == OCCUPIED
    if not held.any():
        return np.full(state.shape, np.inf, np.float32)
    outside = ndimage.distance_transform_edt(~held) - ndimage.distance_transform_edt(held)
    return np.asarray(outside * voxel, np.float32)


def closed_body(
    low: np.ndarray, high: np.ndarray, voxel: float, views: Sequence[DepthView], means: np.ndarray, own: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(vertices [V, 3] float32, faces [F, 3] int32) of a watertight mesh between corners `low` and `high`.

    Space carving (Kutulakos & Seitz 2000) with depth: a voxel is outside if views see farther than it, or if the
    nearest of means [N, 3] is not `own` [N]; hidden space counts as body, so that a side which no photo shows
    reaches to the bounds. Near the surface the mean of depth − z places it within the voxel. The largest connected part
    is kept, its hollows are filled, and the level 0 is meshed by marching cubes (Lorensen & Cline 1987).
    """
    from skimage.measure import marching_cubes

    shape = grid_shape(low, high, voxel)
    places, reach = centres(low, shape, voxel), 3 * voxel
    on, free, gap = observe(places, views, reach)
    level = np.where((on > 0) & (2 * on >= free), gap / reach, np.where(free > 0, 1.0, -1.0))
    nearest = nearest_gaussian(places, means)
    level = np.where(own[nearest] & (nearest >= 0), level, np.maximum(level, 0.5)).reshape(shape)
    parts, count = ndimage.label(level < 0)
    if count == 0:
        raise InputError(f"the instance holds no voxel of {voxel:g}; choose a smaller --voxel-size")
    body = parts == 1 + int(np.argmax(np.bincount(parts.ravel())[1:]))
    filled = ndimage.binary_fill_holes(body)
    level = np.where(filled, np.minimum(np.where(body, level, -1.0), -1e-3), np.maximum(level, 1e-3))
    vertices, faces, _, _ = marching_cubes(np.pad(level, 1, constant_values=1.0), 0.0)
    points = low + (vertices - 0.5) * voxel  # index 1 after padding is the centre of the first voxel
    return points.astype(np.float32), faces.astype(np.int32)
