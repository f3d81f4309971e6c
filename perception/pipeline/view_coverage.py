"""Finds parts of a map that too few photos show; the position of a surface is reliable from three views on."""

from __future__ import annotations

import numpy as np
import torch

from perception.gaussians.model import Gaussians
from perception.gaussians.render import render
from perception.types import View

ENOUGH = 3
"""Least number of views of a reliable surface: two determine its position, the third confirms it."""
SOLID = 0.5
"""Least opacity of Gaussians that count as surface."""
SIDE = 240
"""Long side in pixels of the images in which visibility is tested."""
WEAK_SHARE = 0.02
"""Least share of weakly covered surface for a warning."""


@torch.no_grad()
def views_of_each(gaussians: Gaussians, views: list[View]) -> np.ndarray:
    """[N] int: number of views in which each Gaussian contributes to some pixel."""
    counts = torch.zeros(len(gaussians), dtype=torch.int64)
    for view in views:
        scale = min(1.0, SIDE / max(view.width, view.height))
        width, height = max(1, round(view.width * scale)), max(1, round(view.height * scale))
        K = view.K * np.array([[width / view.width], [height / view.height], [1.0]])
        out = render(
            gaussians,
            torch.from_numpy(view.camera_from_world.astype(np.float32)),
            torch.from_numpy(K.astype(np.float32)),
            width,
            height,
            depth=False,
        )
        counts += out.visible[0]
    return counts.numpy()


def weak_coverage(gaussians: Gaussians, views: list[View]) -> str | None:
    """One line on the surface seen by fewer than ENOUGH views: how much, where, which photo faces it; else None."""
    if len(gaussians) == 0 or not views:
        return None
    solid = gaussians.opacities.detach().numpy() > SOLID
    weak = solid & (views_of_each(gaussians, views) < ENOUGH)
    share = weak.sum() / max(1, solid.sum())
    if share < WEAK_SHARE:
        return None
    middle = np.median(gaussians.means.detach().numpy()[weak], axis=0)
    nearest = min(views, key=lambda view: _off_axis(view, middle))
    place = ", ".join(f"{x:.2f}" for x in middle)
    return (
        f"weak coverage: {share:.0%} of the surface is seen by fewer than {ENOUGH} photos, about ({place}), "
        f"which {nearest.name} faces; take more photos there"
    )


def _off_axis(view: View, point: np.ndarray) -> float:
    """Angle in radians between a view's axis and a point; π if the point is the camera centre."""
    local = view.camera_from_world[:3, :3] @ point + view.camera_from_world[:3, 3]
    distance = float(np.linalg.norm(local))
    return float(np.arccos(np.clip(local[2] / distance, -1, 1))) if distance > 0 else float(np.pi)
