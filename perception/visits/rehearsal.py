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
from perception.io.memory import Keep
from perception.photos.decode import scaled_K, scaled_size
from perception.types import View
from perception.visits.evidence import AGREE, sight

SHOWN, HIDDEN = 0.9, 0.05
"""Opacity from which the map shows a pixel, and share of something else in it from which it does not count."""
OVERLAP, SAMPLES = 0.1, 5000
"""Least share of what the visit sees in a view, relative to the view that shows most; points by which it is told."""
MOST = 64
"""Renders that are trained."""


def showing(views: Sequence[View], gaussians: Gaussians, seen: np.ndarray) -> list[View]:
    """The views that trained the map and show what a visit sees, `seen` [N] bool of the Gaussians: in a building most
    show other rooms."""
    points = gaussians.means.double().numpy()[seen]
    points = points[:: 1 + len(points) // SAMPLES]
    trained, counts = [view for view in views if not getattr(view, "held_out", False)], list[int]()
    for view in trained:
        _, z, mapped = sight(gaussians, view, points)
        counts.append(int((np.abs(z - mapped) < 2 * AGREE * mapped).sum()))
    least = max(1.0, OVERLAP * max(counts, default=0))
    return [view for view, number in zip(trained, counts, strict=True) if number >= least]


def rehearsed(
    views: Sequence[View], max_side: int, count: int, stays: Gaussians, others: Gaussians, keep: Keep = np.asarray
) -> list[TrainingView]:
    """At most `count` or MOST renders of what stays, evenly chosen of `views`, with long sides up to `max_side`. Pixels
    in which one of the others stands in front, or stood, do not count. keep: where images are held."""
    chosen = np.unique(np.linspace(0, len(views) - 1, min(count, MOST, len(views))).round().astype(int))
    marked = Gaussians.concatenate([stays, others])
    white = (torch.arange(len(marked)) >= len(stays)).float()
    marked = replace(marked, sh=sh_from_rgb(white[:, None, None].expand(-1, 1, 3)))
    made = []
    for view in (views[n] for n in chosen):
        width, height = scaled_size(view, max_side)
        matrices = scaled_K(view, width, height), view.camera_from_world
        K, pose = (torch.from_numpy(matrix.astype(np.float32)) for matrix in matrices)
        out = render(stays, pose, K, width, height, harmonics=True)
        other = render(marked, pose, K, width, height, harmonics=True).colors[0, ..., 0]
        weight = ((out.alphas[0] > SHOWN) & (other < HIDDEN)).float().cpu()
        photo = (255 * out.colors[0].clamp(0, 1)).round().to(torch.uint8).cpu()
        made.append(TrainingView(f"rehearsed {view.name}", photo, None, K, pose, weight=weight, keep=keep).stored())
    return made
