"""Parts of photos that disagree with the other photos because something moved: people, a robot's own arm.

A half-trained map tells where a pixel's surface lies. A block of pixels moved, or was hidden by what moved, when its
mean colour differs from that of the same place in most photos that see it. As RobustNeRF (Sabour et al. 2023) masks
outliers with a smooth kernel, but photos are compared with photos, so that detail which is not yet trained is kept.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np
import torch

from perception.gaussians.model import Gaussians
from perception.gaussians.train import Observer, Trainer
from perception.gaussians.views import TrainingView, depth_image, unprojected
from perception.geometry import camera_centres
from perception.io.arrays import read_npz
from perception.io.atomic import atomic_file
from perception.progress import Progress

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
_3X3 = list(product((0, 1, 2), repeat=2))


def train_without_transients(
    trainer: Trainer, views: list[TrainingView], observer: Observer, file: Path, progress: Progress
) -> list[TrainingView]:
    """Trains until START, and returns the views without what disagrees with the other photos then.

    file: holds the masks, and is read instead when it exists, so that a resumed run takes the same steps.
    """
    if trainer.progress < START:
        trainer.run(observer, until=START)
    if file.is_file():
        stored = read_npz(file, file, "it is damaged; delete the work folder to start over")
        masks = [stored[f"{index}"] for index in range(len(views))]
    else:
        masks = transient_masks(trainer.gaussians, views)
        with atomic_file(file) as aside, aside.open("wb") as stream:
            np.savez_compressed(stream, **{f"{index}": mask for index, mask in enumerate(masks)})  # type: ignore[arg-type]
    photos, share = sum(bool(mask.any()) for mask in masks), float(np.mean([mask.mean() for mask in masks]))
    progress.log(f"moved between photos: {share:.1%} of the pixels, in {photos} of {len(views)} photos, are left out")
    views = [without_transients(view, mask) for view, mask in zip(views, masks, strict=True)]
    trainer.show(views)
    return views


def without_transients(view: TrainingView, moved: np.ndarray) -> TrainingView:
    """The view with weight and depth 0 where `moved` [H, W] is True."""
    if not moved.any():
        return view
    kept = torch.from_numpy(~moved)
    weight = kept.float() if view.weight is None else view.weight * kept
    return replace(view, weight=weight, depth=None if view.depth is None else view.depth * kept)


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
    centres = camera_centres(poses)
    spread = max(float(np.linalg.norm(centres - centres.mean(axis=0), axis=1).mean()), 1e-9)
    masks = []
    for index, (view, grid) in enumerate(zip(views, grids, strict=True)):
        apart = np.linalg.norm(centres - centres[index], axis=1) / spread - poses[:, 2, :3] @ poses[index, 2, :3]
        apart[index] = np.inf
        near = np.argsort(apart, kind="stable")[: min(PHOTOS, len(views) - 1)]
        differs = _differs(grid, [grids[other] for other in near])
        blocks = (
            _around(differs & (_around(differs) >= AROUND)) > 0
        )  # differ with most neighbours, and all around these
        row, column = (
            np.minimum(np.arange(n) // grid.side, m - 1)
            for n, m in zip(view.photo.shape[:2], blocks.shape, strict=True)
        )
        masks.append(np.asarray(blocks[row[:, None], column]))
    return masks


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
    points = unprojected(grid.K, grid.pose, x, y, grid.depth)
    found = np.full((len(others), height, width), np.nan)
    for row, other in zip(found, others, strict=True):
        there = points @ other.pose[:3, :3].T + other.pose[:3, 3]
        z = np.where(grid.depth > 0, there[..., 2], -1.0)
        column, line = (
            np.floor(other.K[i, i] * there[..., i] / np.where(z > 0, z, 1.0) + other.K[i, 2]) for i in (0, 1)
        )
        inside = (z > 0) & (column >= 1) & (line >= 1)
        inside &= (column < other.depth.shape[1] - 1) & (line < other.depth.shape[0] - 1)
        at = line[inside].astype(np.int64), column[inside].astype(np.int64)
        # The map's depth is not exact, so the most similar of 3 × 3 blocks counts.
        colors = np.stack([other.colors[at[0] + down - 1, at[1] + right - 1] for down, right in _3X3])
        least = np.abs(colors - grid.colors[inside]).max(axis=2).min(axis=0)
        seen = np.abs(other.depth[at] - z[inside]) < VISIBLE * z[inside]
        row[inside] = np.where(seen, least, np.nan)
    enough = np.isfinite(found).sum(axis=0) >= LEAST_PHOTOS
    median = np.nanmedian(np.where(enough, found, 0.0), axis=0)
    return np.asarray(enough & (median > DIFFERENT))


def _around(blocks: np.ndarray) -> np.ndarray:
    """Number of True blocks among the 3 × 3 around each."""
    padded = np.pad(blocks.astype(np.int64), 1)
    height, width = blocks.shape
    return np.asarray(np.sum([padded[i : i + height, j : j + width] for i, j in _3X3], axis=0))
