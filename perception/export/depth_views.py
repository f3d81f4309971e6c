"""Depth rendered from a map's own cameras, and whether these see a point, see through it, or see neither."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from scipy.ndimage import binary_erosion

from perception.gaussians.model import Gaussians
from perception.gaussians.views import expected_depth, render
from perception.geometry import sums_by
from perception.machine import require_memory
from perception.photos.decode import scaled_K, scaled_size
from perception.photos.depth import without_edges
from perception.types import View

BYTES_PER_PIXEL = 20
"""Of a view: its depth, its three colours and its brightness, 4 each."""


@dataclass(frozen=True)
class DepthView:
    """camera_from_world [4, 4], K [3, 3] pixels, depth [H, W] float32 along the optical axis in map units (0 = none),
    colors [H, W, 3] float32 in [0, 1]."""

    camera_from_world: np.ndarray
    K: np.ndarray
    depth: np.ndarray
    colors: np.ndarray

    @cached_property
    def brightness(self) -> np.ndarray:
        """[H, W] float32, the mean of the colour channels."""
        return self.colors.mean(axis=2)

    def look(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Of points [P, 3]: their coordinates [P, 3] in camera axes, their pixels u, v [P, 2], and the depth [P] there,
        0 = none or outside the image."""
        own = np.einsum("nj,ij->ni", points, self.camera_from_world[:3, :3]) + self.camera_from_world[:3, 3]
        height, width = self.depth.shape
        front = own[:, 2] > 1e-9
        uv = own[:, :2] / np.where(front, own[:, 2], 1.0)[:, None] * np.diag(self.K)[:2] + self.K[:2, 2]
        inside = np.flatnonzero(front & (uv >= 0).all(axis=1) & (uv < [width, height]).all(axis=1))
        depth = np.zeros(len(points), np.float32)
        column, row = uv[inside].astype(np.int64).T
        depth[inside] = self.depth[row, column]
        return own, uv, depth

    def seen(self, points: np.ndarray, tolerance: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """(rows of the points [P, 3] within `tolerance` of the depth, their u, v, and [R, 3] in camera axes)."""
        own, uv, depth = self.look(points)
        rows = np.flatnonzero((depth > 0) & (np.abs(depth - own[:, 2]) <= tolerance))
        return rows, uv[rows, 0], uv[rows, 1], own[rows]


@torch.no_grad()
def depth_views(gaussians: Gaussians, views: Sequence[View], long_side: int = 640) -> list[DepthView]:
    """Expected depth where the map is more than half opaque, edges left out, and colours; of pinhole views scaled to at
    most `long_side` pixels. InputError where they do not fit into the memory."""
    sizes = [scaled_size(view, long_side) for view in views]
    needed = BYTES_PER_PIXEL * sum(width * height for width, height in sizes)
    require_memory(needed, f"depth rendered from {len(views)} views", "use a machine with more memory")
    found = []
    for view, (width, height) in zip(views, sizes, strict=True):
        K = scaled_K(view, width, height)
        pose = np.asarray(view.camera_from_world, np.float64)
        camera, intrinsics = (torch.from_numpy(array.astype(np.float32)) for array in (pose, K))
        out = render(gaussians, camera, intrinsics, width, height)
        depth = without_edges(expected_depth(out).numpy())
        found.append(DepthView(pose, K, depth, out.colors[0].clamp(0, 1).numpy()))
    return found


def observe(
    points: np.ndarray, views: Sequence[DepthView], tolerance: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What the views say of points [P, 3]: (on, free, gap), each [P].

    on: number of views whose depth there is within `tolerance`; gap: the mean of depth − z over those, positive in
    front of the surface. free: number of views that see farther. A view that sees less far says nothing: hidden.
    """
    on, free = np.zeros((2, len(points)), np.int32)
    gap = np.zeros(len(points))
    for view in views:
        own, _, depth = view.look(points)
        ahead = np.where(depth > 0, depth - own[:, 2], -np.inf)
        near = np.abs(ahead) <= tolerance
        on += near
        free += ahead > tolerance
        gap[near] += ahead[near]
    return on, free, gap / np.maximum(on, 1)


def fused_surface(views: Sequence[DepthView]) -> tuple[np.ndarray, np.ndarray]:
    """Mean point and unit normal, [P, 3] float64 each, of every second depth pixel in each cell of a grid, an eightieth
    of the extent wide; normals face the cameras."""
    points, normals = (np.concatenate(parts) for parts in zip(*map(_backprojected, views), strict=True))
    if not len(points):
        return points, normals
    low, high = np.percentile(points, [2, 98], axis=0)
    cell, count = grid_cells(points, float(np.linalg.norm(high - low)) / 80)
    mean, turned = (sums_by(cell, values, len(count)) / count[:, None] for values in (points, normals))
    length = np.linalg.norm(turned, axis=1)
    kept = (count >= 3) & (length > 0.3)
    return mean[kept], turned[kept] / length[kept, None]


def grid_cells(points: np.ndarray, width: float) -> tuple[np.ndarray, np.ndarray]:
    """(the cell [P], 0 to C − 1, of each of points [P, 3] in a grid of cells of `width`; points per cell [C])."""
    keys = np.floor((points - points.min(axis=0)) / width).astype(np.int64)
    sizes = keys.max(axis=0) + 1
    flat = (keys[:, 0] * sizes[1] + keys[:, 1]) * sizes[2] + keys[:, 2]
    _, cell, count = np.unique(flat, return_inverse=True, return_counts=True)
    return cell.reshape(-1), count


def centres(low: np.ndarray, shape: Sequence[int], width: float) -> np.ndarray:
    """Centres [X · Y · Z, 3] of a grid's cells of `width` from corner `low`, z fastest."""
    return (np.indices(shape).reshape(3, -1).T + 0.5) * width + low


def _backprojected(view: DepthView) -> tuple[np.ndarray, np.ndarray]:
    """Points and unit normals [P, 3] in the world, of every second pixel with depth whose neighbours have depth."""
    height, width = view.depth.shape
    v, u = np.mgrid[:height, :width] + 0.5
    rays = np.stack([(u - view.K[0, 2]) / view.K[0, 0], (v - view.K[1, 2]) / view.K[1, 1], np.ones_like(u)], axis=-1)
    own = rays * view.depth[..., None]
    normal = np.cross(own[2:, 1:-1] - own[:-2, 1:-1], own[1:-1, 2:] - own[1:-1, :-2])[::2, ::2]
    known = binary_erosion(view.depth > 0)[1:-1, 1:-1][::2, ::2]  # also of the four neighbours
    inner = own[1:-1, 1:-1][::2, ::2][known]
    length = np.linalg.norm(normal[known], axis=1, keepdims=True)
    rotation, shift = view.camera_from_world[:3, :3], view.camera_from_world[:3, 3]
    return (inner - shift) @ rotation, (normal[known] / np.maximum(length, 1e-30)) @ rotation
