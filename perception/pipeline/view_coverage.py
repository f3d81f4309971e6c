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


def views_of_each(gaussians: Gaussians, views: list[View]) -> np.ndarray:
    """[N] int: number of views in which each Gaussian contributes to some pixel."""
    counts = torch.zeros(len(gaussians), dtype=torch.int64)
    for view in views:
        scale = min(1.0, SIDE / max(view.width, view.height))
        width, height = max(1, round(view.width * scale)), max(1, round(view.height * scale))
        K = view.K * np.array([[width / view.width], [height / view.height], [1.0]])
        pose, K = (torch.from_numpy(matrix.astype(np.float32)) for matrix in (view.camera_from_world, K))
        with torch.no_grad():
            counts += render(gaussians, pose, K, width, height, depth=False).visible[0]
    return counts.numpy()


def weak_coverage(gaussians: Gaussians, views: list[View]) -> str | None:
    """One line on the surface seen by fewer than ENOUGH views: how much, where, which photo faces it; else None."""
    solid = gaussians.opacities.detach().numpy() > SOLID
    weak = solid & (views_of_each(gaussians, views) < ENOUGH)
    share = weak.sum() / max(1, solid.sum())
    if share < WEAK_SHARE or not views:
        return None
    middle = np.median(gaussians.means.detach().numpy()[weak], axis=0)

    def along_axis(view: View) -> float:
        """Cosine between a view's axis and the direction to `middle`."""
        local = view.camera_from_world[:3, :3] @ middle + view.camera_from_world[:3, 3]
        return float(local[2] / max(np.linalg.norm(local), 1e-9))

    place = ", ".join(f"{x:.2f}" for x in middle)
    return (
        f"weak coverage: {share:.0%} of the surface is seen by fewer than {ENOUGH} photos, about ({place}), "
        f"which {max(views, key=along_axis).name} faces; take more photos there"
    )
