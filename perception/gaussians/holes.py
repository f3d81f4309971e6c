"""Adds Gaussians in image regions that the map leaves empty. Densification only copies existing Gaussians.

Each view is divided into blocks of BLOCK × BLOCK pixels. An empty block gets one Gaussian of the block's size and the
photo's mean colour there, at a depth taken from the nearest covered blocks. Training then moves it to the surface.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from perception.gaussians.model import Gaussians, isotropic
from perception.gaussians.views import TrainingView, render, unprojected

BLOCK = 8
"""Side of a block in pixels."""
EMPTY = 0.5
"""A block is empty when its mean opacity is below this."""
NEIGHBOURS = 12
"""Nearest covered blocks from which the depth of an empty one is taken."""
FAR = 0.75
"""Quantile of the depths of the nearest covered blocks that is used: regions without points are mostly background."""
OPACITY = 0.5
"""Opacity of the Gaussians added."""


@torch.no_grad()
def fill_holes(gaussians: Gaussians, views: list[TrainingView], room: int, seed: int) -> tuple[Gaussians, float]:
    """At most `room` new Gaussians for the empty blocks of `views`, and the share of all blocks that was empty.

    Each view is rendered with the Gaussians added for the views before it, so a hole seen in several is filled once.
    """
    generator = torch.Generator().manual_seed(seed)
    born, empty, blocks = gaussians.rows(torch.zeros(0, dtype=torch.long)), 0, 0
    for view in views:
        alphas, depths = _blocks(Gaussians.concatenate([gaussians, born]), view)
        holes = alphas < EMPTY
        covered = ~holes
        if view.weight is not None:
            holes &= _block_mean(view.weight[None])[0].numpy() > 0.999  # no colour of an ignored pixel
        empty, blocks = empty + int(holes.sum()), blocks + alphas.size
        if not holes.any() or not covered.any() or len(born) >= room:
            continue
        new = _in_holes(view, holes, covered, depths, gaussians, generator).to(gaussians.means.device)
        born = Gaussians.concatenate([born, new.rows(torch.arange(min(len(new), room - len(born))))])
    return born, empty / max(1, blocks)


def _blocks(gaussians: Gaussians, view: TrainingView) -> tuple[np.ndarray, np.ndarray]:
    """Mean opacity of each block [h, w], and its opacity-weighted mean depth [h, w], 0 where the opacity is 0."""
    height, width = view.photo.shape[:2]
    out = render(gaussians, view.camera_from_world, view.K, width, height, eps2d=view.eps2d)
    assert out.depths is not None  # for the type checker
    alpha, depth = _block_mean(torch.stack([out.alphas[0], out.depths[0]])).cpu().numpy()
    return alpha, np.where(alpha > 0, depth / np.maximum(alpha, 1e-6), 0)


def _block_mean(images: torch.Tensor) -> torch.Tensor:
    return torch.nn.functional.avg_pool2d(images[None], BLOCK, ceil_mode=True)[0]


def _in_holes(
    view: TrainingView,
    holes: np.ndarray,
    covered: np.ndarray,
    depths: np.ndarray,
    like: Gaussians,
    generator: torch.Generator,
) -> Gaussians:
    """One Gaussian for each True block of holes [h, w], by depths of the `covered` ones; tensors like `like`."""
    from scipy.spatial import cKDTree

    known, empty = np.argwhere(covered), np.argwhere(holes)
    count = min(NEIGHBOURS, len(known))
    _, near = cKDTree(known).query(empty, k=count)
    around = depths[covered][near.reshape(len(empty), count)]
    depth = np.quantile(around, FAR, axis=1).astype(np.float32)

    height, width = view.photo.shape[:2]
    low = empty * BLOCK
    high = np.minimum(low + BLOCK, [height, width])
    rows, columns = ((low + high) / 2).T
    K = view.K.numpy()
    means = unprojected(K, view.camera_from_world.double().numpy(), columns, rows, depth)
    colors = _block_mean(view.photo.float().permute(2, 0, 1))
    rgb = colors[:, torch.from_numpy(holes)].T / 255
    scales = torch.from_numpy(depth) * (0.5 * BLOCK / float(K[0, 0]))
    log_scales = scales.clamp(min=1e-9).log()
    balls = isotropic(means, log_scales, rgb, OPACITY, like.features.shape[1], generator)
    harmonics = balls.sh.new_zeros(len(empty), like.sh.shape[1] - 1, 3)
    return replace(balls, sh=torch.cat([balls.sh, harmonics], dim=1))
