"""What the 2D masks say of every Gaussian: how much of it each mask of each photo shows.

The weight of Gaussian n in mask m is Σ_{p ∈ m} w_n(p), w_n(p) = its alpha times the transmittance before it: the very
weight with which its colour enters the picture. Rendering is linear in features, so these sums are the gradient of the
rendered mask indicator with respect to features, and one backward pass yields 16 masks for all Gaussians.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy import sparse

from perception.gaussians.model import Gaussians
from perception.gaussians.rasterize import Settings, rasterize_backward, rasterize_forward
from perception.gaussians.train import TrainingView

BLOCK = 16  # masks a pass: a feature width the kernel is specialised for
FAINTEST = 0.02  # pixels; less than that is no evidence and only fills the matrix


@dataclass(frozen=True)
class MaskVotes:
    """weights [N, M] float32 sparse, in pixels; per mask: view [M] int64 ascending, area [M] float64 pixels."""

    weights: sparse.csr_matrix
    view: np.ndarray
    area: np.ndarray

    @property
    def starts(self) -> np.ndarray:
        """First mask of each view that has any, for `np.add.reduceat`."""
        return np.flatnonzero(np.diff(self.view, prepend=-1) > 0)

    def table(self, ids: np.ndarray, count: int) -> np.ndarray:
        """[count, M] float32: the pixels of each mask that the Gaussians of each id (−1 = none) fill."""
        rows = np.flatnonzero(ids >= 0)
        ones = np.ones(len(rows), np.float32)
        gather = sparse.csr_matrix((ones, (ids[rows], rows)), shape=(count, len(ids)))
        return (gather @ self.weights).toarray()


def mask_votes(
    gaussians: Gaussians,
    views: Sequence[TrainingView],
    *,
    half_resolution: bool = True,
    progress: Callable[[int, int], object] | None = None,
) -> MaskVotes:
    """The votes of all masks of all views; label 0 (unlabelled) says nothing.

    half_resolution: masks are smooth enough for every other pixel, at a quarter of the time; areas are then in
    pixels of that size too.
    """
    parts, owner, areas = [], [], []
    for index, view in enumerate(views):
        if view.labels is not None and bool((view.labels > 0).any()):
            shown = view.halved() if half_resolution and min(view.photo.shape[:2]) > 1 else view
            weights, area = _of_view(gaussians, shown)
            parts.append(weights)
            areas.append(area)
            owner.append(np.full(len(area), index, np.int64))
        if progress is not None:
            progress(index + 1, len(views))
    if not parts:
        return MaskVotes(sparse.csr_matrix((len(gaussians), 0), dtype=np.float32), np.zeros(0, np.int64), np.zeros(0))
    return MaskVotes(sparse.hstack(parts, format="csr"), np.concatenate(owner), np.concatenate(areas))


@torch.no_grad()
def _of_view(gaussians: Gaussians, view: TrainingView) -> tuple[sparse.csr_matrix, np.ndarray]:
    assert view.labels is not None  # told by the caller
    height, width = view.photo.shape[:2]
    names, dense, counts = torch.unique(view.labels, return_inverse=True, return_counts=True)
    masks = torch.nonzero(names > 0)[:, 0].tolist()
    inputs = (
        gaussians.means,
        gaussians.quats,
        gaussians.scales,
        gaussians.opacities,
        gaussians.base_colors,
        torch.zeros(len(gaussians), BLOCK),
        view.camera_from_world[None].contiguous(),
        view.K[None].contiguous(),
    )
    settings = Settings(width, height, variance=False, depth=False)
    forward = rasterize_forward(inputs, None, settings)
    columns = []
    for first in range(0, len(masks), BLOCK):
        block = masks[first : first + BLOCK]
        inside = torch.zeros(1, height, width, BLOCK)
        for channel, mask in enumerate(block):
            inside[0, ..., channel] = dense == mask
        wanted = tuple(name == 5 for name in range(7))  # the gradient of features, and no other
        gradients, _ = rasterize_backward(inputs, None, settings, forward, (None, None, None, inside, None), wanted)
        assert gradients[5] is not None  # wanted
        weights = gradients[5][:, : len(block)].numpy()
        columns.append(sparse.csr_matrix(np.where(weights > FAINTEST, weights, 0)))
    return sparse.hstack(columns, format="csr"), counts[masks].numpy().astype(np.float64)
