"""A model of Gaussians seen by one camera: `rasterize` with the model's own tensors."""

from __future__ import annotations

from typing import Any

import torch

from perception.gaussians.model import Gaussians
from perception.gaussians.rasterize import Rasterization, rasterize


def render(
    gaussians: Gaussians,
    camera_from_world: torch.Tensor,
    K: torch.Tensor,
    width: int,
    height: int,
    *,
    harmonics: bool = False,
    **options: Any,
) -> Rasterization:
    """One view (C = 1) from camera_from_world [4, 4] through K [3, 3], float32; `options` as of `rasterize`.

    harmonics: colours as seen from this camera; without, the constant ones, which are enough where only visibility,
    depth or features are asked for.
    """
    return rasterize(
        gaussians.means,
        gaussians.quats,
        gaussians.scales,
        gaussians.opacities,
        gaussians.sh if harmonics else gaussians.base_colors,
        camera_from_world[None],
        K[None],
        width,
        height,
        sh_degree=gaussians.sh_degree if harmonics else None,
        **options,
    )
