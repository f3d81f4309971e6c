"""What earlier visits saw, rendered from the map at their cameras, to be trained beside the photos of a visit: colours
are fitted to the sides that a visit looks at, and would be wrong from all others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from perception.colors import sh_from_rgb
from perception.gaussians.model import Gaussians
from perception.gaussians.views import TrainingView, render
from perception.photos.decode import scaled_K, scaled_size
from perception.types import View

SHOWN, HIDDEN = 0.9, 0.05
"""Opacity from which the map shows a pixel, and share of something else in it from which it does not count."""


def rehearsed(
    views: Sequence[View], max_side: int, count: int, stays: Gaussians, others: Gaussians
) -> list[TrainingView]:
    """At most `count` renders of what stays, at views of earlier visits that trained the map, evenly chosen, with long
    sides up to `max_side`. Pixels in which one of the others stands in front, or stood, do not count."""
    trained = [view for view in views if not getattr(view, "held_out", False)]
    chosen = np.unique(np.linspace(0, len(trained) - 1, min(count, len(trained))).round().astype(int))
    marked = Gaussians.concatenate([stays, others])
    white = (torch.arange(len(marked)) >= len(stays)).float()
    marked = replace(marked, sh=sh_from_rgb(white[:, None, None].expand(-1, 1, 3)))
    made = []
    for view in (trained[n] for n in chosen):
        width, height = scaled_size(view, max_side)
        matrices = scaled_K(view, width, height), view.camera_from_world
        K, pose = (torch.from_numpy(matrix.astype(np.float32)) for matrix in matrices)
        out = render(stays, pose, K, width, height, harmonics=True)
        other = render(marked, pose, K, width, height, harmonics=True).colors[0, ..., 0]
        weight = ((out.alphas[0] > SHOWN) & (other < HIDDEN)).float().cpu()
        photo = (255 * out.colors[0].clamp(0, 1)).round().to(torch.uint8).cpu()
        made.append(TrainingView(f"rehearsed {view.name}", photo, None, K, pose, weight=weight))
    return made
