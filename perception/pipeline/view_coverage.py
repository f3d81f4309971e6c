"""Which parts of a map too few photos saw: a surface needs three views before its place can be trusted."""

from __future__ import annotations

import numpy as np
import torch

from perception.gaussians.model import Gaussians
from perception.gaussians.render import render
from perception.types import View

ENOUGH = 3
"""Views from which a surface must be seen: two place it, the third confirms."""
SOLID = 0.5
"""Opacity from which a Gaussian counts as surface."""
SIDE = 240
"""Pixels of the longer side at which visibility is looked at."""
TOLD = 0.02
"""Share of the surface below which weak places are not worth a warning."""


@torch.no_grad()
def views_of_each(gaussians: Gaussians, views: list[View]) -> np.ndarray:
    """[N] int: in how many views each Gaussian contributes to some pixel."""
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
    if share < TOLD:
        return None
    middle = np.median(gaussians.means.detach().numpy()[weak], axis=0)
    nearest = min(views, key=lambda view: _off_axis(view, middle))
    place = ", ".join(f"{x:.2f}" for x in middle)
    return (
        f"weak coverage: {share:.0%} of the surface is seen by fewer than {ENOUGH} photos, about ({place}), "
        f"which {nearest.name} faces; take more photos there"
    )


def _off_axis(view: View, point: np.ndarray) -> float:
    """Angle in radians between a view's axis and a point; π where the point lies at its centre."""
    local = view.camera_from_world[:3, :3] @ point + view.camera_from_world[:3, 3]
    distance = float(np.linalg.norm(local))
    return float(np.arccos(np.clip(local[2] / distance, -1, 1))) if distance > 0 else float(np.pi)
