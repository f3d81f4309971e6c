"""Gaussians for the places that have none: growth by gradient copies what is there and never reaches an empty wall.

A view's picture is cut into blocks. A block that the map leaves empty gets one Gaussian as large as the block, of the
photo's colour, at the depth of the covered blocks around it; the photos then pull it where it belongs.
"""

from __future__ import annotations

import math

import numpy as np
import torch

from perception.colors import sh_from_rgb
from perception.gaussians.model import Gaussians
from perception.gaussians.render import render
from perception.gaussians.views import TrainingView

BLOCK = 8
"""Pixels a side of a block."""
EMPTY = 0.5
"""A block is empty when its mean opacity is below this."""
NEIGHBOURS = 12
FAR = 0.75
"""Of the depths of the nearest covered blocks this quantile is taken: what has no points is background more often."""
OPACITY = 0.5


@torch.no_grad()
def fill_holes(gaussians: Gaussians, views: list[TrainingView], room: int, seed: int) -> tuple[Gaussians, float]:
    """At most `room` new Gaussians for what `views`, taken in turn, show and the map does not; and the share of the
    pictures' blocks that was empty.

    A view is rendered with the Gaussians found for those before it, so that they share what they share.
    """
    generator = torch.Generator().manual_seed(seed)
    born, empty, blocks = gaussians.rows(torch.zeros(0, dtype=torch.long)), 0, 0
    for view in views:
        alphas, depths = _blocks(Gaussians.concatenate([gaussians, born]), view)
        holes = alphas < EMPTY
        empty, blocks = empty + int(holes.sum()), blocks + alphas.size
        if not holes.any() or holes.all() or len(born) >= room:
            continue
        found = _placed(view, holes, depths, gaussians, generator)
        born = Gaussians.concatenate([born, found.rows(torch.arange(min(len(found), room - len(born))))])
    return born, empty / max(1, blocks)


def _blocks(gaussians: Gaussians, view: TrainingView) -> tuple[np.ndarray, np.ndarray]:
    """Mean opacity, and opacity-weighted depth (0 where nothing is), of each block [h, w]."""
    height, width = view.photo.shape[:2]
    out = render(gaussians, view.camera_from_world, view.K, width, height, eps2d=view.eps2d)
    images = torch.stack([out.alphas[0], out.depths[0]])[None]
    alpha, depth = torch.nn.functional.avg_pool2d(images, BLOCK, ceil_mode=True)[0].numpy()
    return alpha, np.where(alpha > 0, depth / np.maximum(alpha, 1e-6), 0)


def _placed(
    view: TrainingView, holes: np.ndarray, depths: np.ndarray, like: Gaussians, generator: torch.Generator
) -> Gaussians:
    """One Gaussian for each of the blocks in `holes` [h, w] bool, shaped like the rows of `like`."""
    from scipy.spatial import cKDTree

    covered, empty = np.argwhere(~holes), np.argwhere(holes)
    count = min(NEIGHBOURS, len(covered))
    _, near = cKDTree(covered).query(empty, k=count)
    around = depths[~holes][near.reshape(len(empty), count)]
    depth = np.quantile(around, FAR, axis=1).astype(np.float32)

    height, width = view.photo.shape[:2]
    low = empty * BLOCK
    high = np.minimum(low + BLOCK, [height, width])
    rows, columns = ((low + high) / 2).T
    K = view.K.numpy()
    rays = np.stack([(columns - K[0, 2]) / K[0, 0], (rows - K[1, 2]) / K[1, 1], np.ones(len(empty))], axis=1)
    pose = view.camera_from_world.double().numpy()
    # Sums written out: a matrix product may round otherwise on another number of threads.
    means = ((rays * depth[:, None] - pose[:3, 3])[:, :, None] * pose[:3, :3]).sum(axis=1)
    colors = torch.nn.functional.avg_pool2d(view.photo.float().permute(2, 0, 1)[None], BLOCK, ceil_mode=True)[0]
    sh = torch.zeros(len(empty), *like.sh.shape[1:])
    sh[:, 0] = sh_from_rgb(colors[:, torch.from_numpy(holes)].T / 255)
    quats = torch.zeros(len(empty), 4)
    quats[:, 0] = 1.0
    scale = torch.from_numpy(depth) * (0.5 * BLOCK / float(K[0, 0]))
    return Gaussians(
        means=torch.from_numpy(means.astype(np.float32)),
        quats=quats,
        log_scales=scale.clamp(min=1e-9).log()[:, None].repeat(1, 3),
        opacity_logits=torch.full((len(empty),), math.log(OPACITY / (1 - OPACITY))),
        sh=sh,
        features=torch.rand(len(empty), like.features.shape[1], generator=generator) - 0.5,
    )
