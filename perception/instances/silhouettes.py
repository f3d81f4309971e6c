"""What each photo shows of each instance: id images and silhouettes rendered with occlusion (paper §3.2.2)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from perception.gaussians.model import Gaussians
from perception.gaussians.render import render

BLOCK = 16
"""Instances rendered in one pass: a feature width the kernel is specialised for."""


@dataclass(frozen=True)
class Silhouettes:
    """One view. ids [H, W] int32: the instance that holds most of a pixel, −1 where none holds `threshold`;
    pixels [M] its pixel counts; visible [M] Gaussians of each instance that contribute to some pixel."""

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
) -> Silhouettes:
    """Renders every instance white on black with all the others in front of it, then takes the largest a pixel.

    ids [N] int32, −1 = none. camera_from_world [4, 4], K [3, 3] float32.
    """
    count = int(ids.max(initial=-1)) + 1
    owner = torch.from_numpy(ids.astype(np.int64))
    best = torch.full((height, width), float(threshold))
    image = torch.full((height, width), -1, dtype=torch.int32)
    seen = torch.zeros(len(gaussians), dtype=torch.bool)
    for first in range(0, max(count, 1), BLOCK):
        inside = (owner >= first) & (owner < first + BLOCK)
        white = torch.zeros(len(gaussians), BLOCK)
        white[inside, owner[inside] - first] = 1.0
        out = render(gaussians, camera_from_world, K, width, height, features=white, variance=False, depth=False)
        seen = out.visible[0]
        assert out.features is not None  # features were given
        value, index = out.features[0].max(dim=2)
        wins = value > best
        best[wins] = value[wins]
        image[wins] = (index[wins] + first).to(torch.int32)
    labels = image.numpy()
    shown = owner[seen & (owner >= 0)]
    return Silhouettes(
        labels,
        np.bincount(labels[labels >= 0], minlength=count),
        np.bincount(shown.numpy(), minlength=count),
    )
