"""What earlier visits saw, rendered from the map at their cameras, to be trained beside the photos of a visit: colours
are fitted to the sides that a visit looks at, and would be wrong from all others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from perception.changes.evidence import AGREE, sight
from perception.colors import sh_from_rgb
from perception.gaussians.model import Gaussians, HeldGaussians
from perception.gaussians.views import TrainingView, render
from perception.geometry import camera_centres
from perception.io.memory import Keep
from perception.photos.decode import scaled_K, scaled_size
from perception.types import View

SHOWN, HIDDEN = 0.9, 0.05
"""Opacity from which the map shows a pixel, and share of something else in it from which it does not count."""
OVERLAP, SAMPLES = 0.1, 5000
"""Least share of what the visit sees in a view, relative to the view that shows most; points by which it is told."""
MOST = 64
"""Renders that are trained."""


def showing(views: Sequence[View], gaussians: Gaussians, seen: np.ndarray, reach: float) -> list[tuple[View, int]]:
    """The views that show something of what a visit sees, `seen` [N] bool of the Gaussians, and how many points of it:
    in a building most show other rooms. reach: how far its photos see; those that are farther are not looked at."""
    from scipy.spatial import cKDTree

    means = gaussians.means.double().numpy()
    points = means[seen]
    points, found = points[:: 1 + len(points) // SAMPLES], list[tuple[View, int]]()
    centres = camera_centres(np.array([view.camera_from_world for view in views]).reshape(-1, 4, 4))
    near = np.flatnonzero(cKDTree(points).query(centres)[0] <= reach)
    ends = np.concatenate([points, centres[near]])  # of the lines of sight: what hides a point lies in their box
    if not len(near):
        return found
    size = 3 * gaussians.scales.max(dim=1).values.double().numpy()[:, None]
    inside = ((means + size > ends.min(axis=0)) & (means - size < ends.max(axis=0))).all(axis=1)
    local = HeldGaussians(**gaussians.rows(torch.from_numpy(np.flatnonzero(inside))).named())
    for view in (views[n] for n in near.tolist()):
        _, z, mapped = sight(local, view, points)
        if count := int((np.abs(z - mapped) < 2 * AGREE * mapped).sum()):
            found.append((view, count))
    return found


def to_rehearse(shown: Sequence[tuple[View, int]], max_side: int, count: int) -> list[TrainingView]:
    """At most `count` or MOST, evenly chosen of the views that trained the map and show enough of what a visit sees
    (see `showing`), with long sides up to `max_side` and black photos."""
    trained = [(view, number) for view, number in shown if not view.held_out]
    least = OVERLAP * max((number for _, number in trained), default=0)
    views = [view for view, number in trained if number >= least]
    chosen = np.unique(np.linspace(0, len(views) - 1, min(count, MOST, len(views))).round().astype(int))
    made = []
    for view in (views[n] for n in chosen):
        width, height = scaled_size(view, max_side)
        matrices = scaled_K(view, width, height), view.camera_from_world
        K, pose = (torch.from_numpy(matrix.astype(np.float32)) for matrix in matrices)
        black = torch.zeros(height, width, 3, dtype=torch.uint8)
        made.append(TrainingView(f"rehearsed {view.name}", black, None, K, pose))
    return made


def rehearsed(
    views: Sequence[TrainingView], stays: Gaussians, others: Gaussians, keep: Keep = np.asarray
) -> list[TrainingView]:
    """The views with renders of what stays. Pixels in which one of the others stands in front, or stood, do not count.
    keep: where images are held."""
    marked = Gaussians.concatenate([stays, others])
    white = (torch.arange(len(marked)) >= len(stays)).float()
    marked = replace(marked, sh=sh_from_rgb(white[:, None, None].expand(-1, 1, 3)))
    made = []
    for view in views:
        camera = view.camera_from_world, view.K, *view.photo.shape[1::-1]
        out = render(stays, *camera, harmonics=True)
        other = render(marked, *camera, harmonics=True).colors[0, ..., 0]
        weight = ((out.alphas[0] > SHOWN) & (other < HIDDEN)).float().cpu()
        photo = (255 * out.colors[0].clamp(0, 1)).round().to(torch.uint8).cpu()
        made.append(replace(view, photo=photo, weight=weight, keep=keep).stored())
    return made
