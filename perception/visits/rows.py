"""The Gaussians of a map that the photos of a visit show: those that an update renders, holds in memory and trains.

In a building most of what lies in the frusta of the photos is behind walls. What the map's renders from there hardly
show matters to none of them, whatever the photos show: training moves no surface of the map, and new things only hide
more. Where a thing is gone, the map is looked at again without it (`Visit.without`).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from perception.changes.evidence import at_surface
from perception.changes.look import in_view
from perception.gaussians.model import Gaussians, HeldGaussians
from perception.gaussians.views import TrainingView, expected_depth
from perception.map.map import Map
from perception.rasterizer.rasterize import rasterizer_for
from perception.rasterizer.types import Cotangents, Gradients, Settings

FAINTEST = 0.02
"""Pixels that a Gaussian fills of a picture, its weights summed, from which that shows it. Without the others pixels of
a made building change by 7 grey levels at most, 99.9 % of them by less than .4."""
TOLD = 1.0, 10.0
"""Pixels that a Gaussian fills in all photos from which these tell its colours: if one sees its centre, and else."""
MANY = 0.1
"""Share of the Gaussians in the frusta from which those that are not shown are left out: of fewer little is saved."""


def shape_of(gmap: Map) -> HeldGaussians:
    """All Gaussians of a map without features and with one colour, to tell what hides what."""
    names, blank = ("means", "quats", "log_scales", "opacity_logits"), {"sh": (1, 3), "features": (0,)}
    tensors = {name: torch.from_numpy(np.ascontiguousarray(getattr(gmap, name))) for name in names}
    return HeldGaussians(**tensors, **{name: torch.zeros(len(gmap), *shape) for name, shape in blank.items()})


@torch.no_grad()
def shown_rows(gaussians: Gaussians, views: Sequence[TrainingView]) -> np.ndarray:
    """[N] bool: Gaussians that fill FAINTEST pixels of some view, or whose centre is not behind the surface there
    (`at_surface`); where those are nearly all in the frusta, all of these."""
    gaussians = HeldGaussians(**gaussians.named())
    means, scales = gaussians.means.double().numpy(), gaussians.scales.max(dim=1).values.numpy()
    shown, near = np.zeros(len(gaussians), bool), in_view(gaussians.means.numpy(), scales, views)
    for view in views:
        weights, seen = _weights(gaussians, view, means, scales)
        shown |= seen | (weights > FAINTEST)
    return shown if np.sum(near & ~shown) > MANY * near.sum() else near | shown


@torch.no_grad()
def told_rows(gaussians: Gaussians, views: Sequence[TrainingView]) -> np.ndarray:
    """[N] bool: Gaussians whose colours the views tell, see TOLD. Adam takes full steps for the least gradient: those
    of the others would change as much, as they did in other rooms of a made building, by up to 30 grey levels."""
    gaussians = HeldGaussians(**gaussians.named())
    means, scales = gaussians.means.double().numpy(), gaussians.scales.max(dim=1).values.numpy()
    filled, seen = np.zeros(len(gaussians)), np.zeros(len(gaussians), bool)
    for view in views:
        weights, sees = _weights(gaussians, view, means, scales)
        filled, seen = filled + weights, seen | sees
    return filled > np.where(seen, *TOLD)


def _weights(
    gaussians: Gaussians, view: TrainingView, means: np.ndarray, scales: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """[N] the weight of each Gaussian in the pixels of a view, summed: the gradient of the sum of a rendered feature
    (see `instances.votes`); [N] bool: those whose centre is not behind the surface there. means, scales: theirs."""
    rasterizer, (height, width) = rasterizer_for(gaussians.means.device), view.photo.shape[:2]
    settings = Settings(width, height, variance=False, eps2d=view.eps2d)
    inputs = gaussians.inputs(view.camera_from_world, view.K, torch.zeros(len(gaussians), 1))
    out, gradients = rasterizer.rasterize_forward(inputs, settings), Gradients.zeros(inputs, ["features"])
    cotangents = Cotangents(features=torch.ones(1, height, width, 1))
    rasterizer.rasterize_backward(inputs, settings, out, cotangents, gradients)
    assert gradients.features is not None  # for the type checker
    depth, seen = expected_depth(out).numpy(), np.zeros(len(means), bool)
    inside, (row, column), z = view.seen(means)
    seen[inside] = at_surface(depth[row, column], z[inside], scales[inside])
    return gradients.features[:, 0].numpy(), seen
