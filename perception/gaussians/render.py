"""Renders a `Gaussians` model from one camera with `rasterize`."""

from __future__ import annotations

from typing import Any

import torch

from perception.gaussians.model import Gaussians
from perception.rasterizer.rasterize import Rasterization, rasterize


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
    """Renders one view (C = 1) where the Gaussians are: camera_from_world [4, 4], K [3, 3] in pixels, float32, on any
    device; `options`: see `rasterize`.

    harmonics: True computes view-dependent colours from all spherical harmonics. False uses the constant term, which is
    enough for visibility, depth and features.
    """
    device = gaussians.means.device
    return rasterize(
        gaussians.means,
        gaussians.quats,
        gaussians.scales,
        gaussians.opacities,
        gaussians.sh if harmonics else gaussians.base_colors,
        camera_from_world[None].to(device),
        K[None].to(device),
        width,
        height,
        sh_degree=gaussians.sh_degree if harmonics else None,
        **options,
    )
