"""Instance images and silhouettes of each photo, rendered with occlusion (paper §3.2.2)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from perception.gaussians.model import Gaussians
from perception.gaussians.render import render

BLOCK = 16
"""Instances per rendering pass: a feature width that the kernel is specialised for."""


@dataclass(frozen=True)
class Silhouettes:
    """One view. ids [H, W] int32: the instance with the largest weight in a pixel, −1 if it is below `threshold`;
    pixels [M]: number of pixels per instance; visible [M]: Gaussians per instance that contribute to any pixel."""

    ids: np.ndarray
    pixels: np.ndarray
    visible: np.ndarray


@torch.no_grad()
def render_silhouettes(
    gaussians: Gaussians,
    ids: np.ndarray,
    camera_from_world: torch.Tensor,
    K: torch.Tensor,
    width: int,
    height: int,
    threshold: float = 0.2,
    eps2d: float = 0.3,
) -> Silhouettes:
    """Renders each instance in white, with all other Gaussians in black as occluders; takes the maximum per pixel.

    ids [N] int32, −1 = none. camera_from_world [4, 4], K [3, 3] float32. eps2d: see `rasterize`.
    """
    count = int(ids.max(initial=-1)) + 1
    owner = torch.from_numpy(ids.astype(np.int64))
    best = torch.full((height, width), float(threshold))
    image = torch.full((height, width), -1, dtype=torch.int32)
    blocks = [torch.arange(min(count, BLOCK))]
    for block in blocks:
        column = torch.full((count + 1,), -1)  # the last entry is for id −1
        column[block] = torch.arange(len(block))
        inside = torch.nonzero(column[owner] >= 0)[:, 0]
        white = torch.zeros(len(gaussians), BLOCK)
        white[inside, column[owner[inside]]] = 1.0
        out = render(
            gaussians, camera_from_world, K, width, height, features=white, variance=False, depth=False, eps2d=eps2d
        )
        shown = owner[out.visible[0] & (owner >= 0)]
        if len(blocks) == 1:  # which Gaussians are visible does not depend on the block
            blocks += torch.unique(shown[shown >= BLOCK]).split(BLOCK) if count > BLOCK else ()
        assert out.features is not None  # features were given
        value, index = out.features[0, ..., : max(len(block), 1)].max(dim=2)
        wins = value > best
        best[wins] = value[wins]
        image[wins] = block[index[wins]].to(torch.int32)
    labels = image.numpy()
    return Silhouettes(
        labels,
        np.bincount(labels[labels >= 0], minlength=count),
        np.bincount(shown.numpy(), minlength=count),
    )
