"""Parts of photos that disagree with the other photos because something moved: people, a robot's own arm.

A half-trained map tells where a pixel's surface lies. A block of pixels moved, or was hidden by what moved, when its
mean colour differs from that of the same place in most photos that see it. As RobustNeRF (Sabour et al. 2023) masks
outliers with a smooth kernel, but photos are compared with photos, so that detail which is not yet trained is kept.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

from perception.gaussians.model import Gaussians
from perception.gaussians.views import TrainingView, depth_image

START = 0.25
"""Training progress at which photos are compared: depth is known then, and little of what moved is in the map."""
BLOCKS = 48
"""Blocks along the long side of a photo."""
PHOTOS, LEAST_PHOTOS = 16, 3
"""Photos nearby that a block is compared with, and how many of them must see its place."""
DIFFERENT, VISIBLE = 0.15, 0.1
"""Difference of colour (of 1, largest channel) that counts; relative difference of depth at which it is seen."""
AROUND = 5
"""Blocks that must differ of the 3 × 3 around a block, so that thin edges are kept."""


@dataclass(frozen=True)
class _Grid:
    """A view in blocks: mean colours [h, w, 3] in [0, 1], depth [h, w] (0 = none), K, camera_from_world, block side."""

    colors: np.ndarray
    depth: np.ndarray
    K: np.ndarray
    pose: np.ndarray
    side: int


def transient_masks(gaussians: Gaussians, views: list[TrainingView]) -> list[np.ndarray]:
    """For each view [H, W] bool, True where its photo disagrees with the others."""
    grids = [_grid(gaussians, view) for view in views]
    poses = np.stack([grid.pose for grid in grids])
    centres = -np.einsum("nji,nj->ni", poses[:, :3, :3], poses[:, :3, 3])
    spread = max(float(np.linalg.norm(centres - centres.mean(axis=0), axis=1).mean()), 1e-9)
    masks = []
    for index, view in enumerate(views):
        apart = np.linalg.norm(centres - centres[index], axis=1) / spread - poses[:, 2, :3] @ poses[index, 2, :3]
        apart[index] = np.inf
        near = np.argsort(apart, kind="stable")[: min(PHOTOS, len(views) - 1)]
        masks.append(_full_size(_smooth(_differs(grids[index], [grids[other] for other in near])), grids[index], view))
    return masks


def without_transients(view: TrainingView, moved: np.ndarray) -> TrainingView:
    """The view with weight and depth 0 where `moved` [H, W] is True."""
    if not moved.any():
        return view
    kept = torch.from_numpy(~moved)
    weight = kept.float() if view.weight is None else view.weight * kept
    return replace(view, weight=weight, depth=None if view.depth is None else view.depth * kept)


def _grid(gaussians: Gaussians, view: TrainingView) -> _Grid:
    height, width = view.photo.shape[:2]
    side = max(1, round(max(height, width) / BLOCKS))
    h, w = height // side, width // side
    photo = view.photo.numpy()[: h * side, : w * side].reshape(h, side, w, side, 3)
    K = view.K.double().numpy() * np.array([[1 / side], [1 / side], [1]])
    depth = depth_image(gaussians, view.camera_from_world, torch.from_numpy(K).float(), w, h).numpy()
    return _Grid(photo.mean(axis=(1, 3)) / 255, depth, K, view.camera_from_world.double().numpy(), side)


def _differs(grid: _Grid, others: list[_Grid]) -> np.ndarray:
    """[h, w] bool: blocks whose colour is DIFFERENT from the median of at least LEAST_PHOTOS other photos."""
    height, width = grid.depth.shape
    y, x = np.mgrid[:height, :width] + 0.5
    rays = np.stack([(x - grid.K[0, 2]) / grid.K[0, 0], (y - grid.K[1, 2]) / grid.K[1, 1], np.ones_like(x)], axis=-1)
    points = (rays * grid.depth[..., None] - grid.pose[:3, 3]) @ grid.pose[:3, :3]
    found = np.full((len(others), height, width), np.nan)
    for row, other in zip(found, others, strict=True):
        points_there = points @ other.pose[:3, :3].T + other.pose[:3, 3]
        z = np.where(grid.depth > 0, points_there[..., 2], -1.0)
        safe = np.where(z > 0, z, 1.0)
        column = np.floor(other.K[0, 0] * points_there[..., 0] / safe + other.K[0, 2])
        line = np.floor(other.K[1, 1] * points_there[..., 1] / safe + other.K[1, 2])
        inside = (z > 0) & (column >= 1) & (line >= 1)
        inside &= (column < other.depth.shape[1] - 1) & (line < other.depth.shape[0] - 1)
        at = line[inside].astype(np.int64), column[inside].astype(np.int64)
        shifts = [(down, right) for down in (-1, 0, 1) for right in (-1, 0, 1)]  # the map's depth is not exact
        there = np.stack([other.colors[at[0] + down, at[1] + right] for down, right in shifts])
        least = np.abs(there - grid.colors[inside]).max(axis=2).min(axis=0)
        seen = np.abs(other.depth[at] - z[inside]) < VISIBLE * z[inside]
        row[inside] = np.where(seen, least, np.nan)
    enough = np.isfinite(found).sum(axis=0) >= LEAST_PHOTOS
    median = np.nanmedian(np.where(enough, found, 0.0), axis=0)
    return np.asarray(enough & (median > DIFFERENT))


def _smooth(differs: np.ndarray) -> np.ndarray:
    """Blocks that differ together with most of their neighbours, and all blocks around these."""

    def around(blocks: np.ndarray) -> np.ndarray:
        padded = np.pad(blocks.astype(np.int64), 1)
        height, width = blocks.shape
        shifts = [padded[down : down + height, right : right + width] for down in range(3) for right in range(3)]
        return np.asarray(np.sum(shifts, axis=0))

    return around(differs & (around(differs) >= AROUND)) > 0


def _full_size(blocks: np.ndarray, grid: _Grid, view: TrainingView) -> np.ndarray:
    height, width = view.photo.shape[:2]
    row = np.minimum(np.arange(height) // grid.side, blocks.shape[0] - 1)
    column = np.minimum(np.arange(width) // grid.side, blocks.shape[1] - 1)
    return np.asarray(blocks[row[:, None], column])
