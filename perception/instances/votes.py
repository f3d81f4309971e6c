"""The weight of every Gaussian in every 2D mask of every photo.

The weight of Gaussian n in mask m is Σ_{p ∈ m} w_n(p), with w_n(p) = alpha · transmittance, the weight of its colour in
pixel p. Rendering is linear in the features, so these sums are the gradient of the sum of the rendered features over
the mask. One backward pass computes BLOCK masks for all Gaussians.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy import sparse

from perception.gaussians.model import Nearby
from perception.gaussians.views import TrainingView
from perception.io.memory import Keep
from perception.machine import return_free_memory, torch_on_one_thread
from perception.masks.votes import MaskVotes
from perception.progress import QUIET, Progress
from perception.rasterizer.rasterize import rasterizer_for
from perception.rasterizer.types import Cotangents, Gradients, Settings

BLOCK = 16  # masks per pass: a feature width that the kernel is specialised for
TRIM = 16  # views between which freed memory is returned: the kept votes split what one view's arrays filled
FEW = 0.25  # share of the Gaussians; a view of fewer is rendered of these alone
FAINTEST = 0.02  # pixels; smaller weights are dropped to keep the matrix sparse


@dataclass(frozen=True)
class ViewVotes:
    """Votes of one view. weights [N, 1 + M]: of its masks, in column 0 where it has none; labels, areas [1 + M]."""

    weights: sparse.csc_matrix
    labels: np.ndarray
    areas: np.ndarray


def mask_votes(
    nearby: Nearby,
    views: Sequence[TrainingView],
    *,
    half_resolution: bool = True,
    progress: Progress = QUIET,
    keep: Keep = np.asarray,
) -> MaskVotes:
    """The votes of all masks of all views, by `view_votes`. keep: where the weights are kept, which grow with photos ×
    visible Gaussians."""
    found = nearby.each(lambda view: view_votes(nearby, view, half_resolution), views)
    return joined_votes(found, len(nearby.gaussians), len(views), progress, keep)


def joined_votes(
    found: Iterable[ViewVotes | None], count: int, views: int, progress: Progress = QUIET, keep: Keep = np.asarray
) -> MaskVotes:
    """The votes of all masks from those of each of that many views, None for one without masks; count: of Gaussians."""
    parts: list[sparse.csc_matrix] = []  # by column: a row pointer per view would be as large as the model
    voids: list[sparse.csc_matrix] = []
    columns: list[tuple[np.ndarray, ...]] = []  # view, area and label of each mask
    for index, one in enumerate(found):
        if one is not None:
            parts.append(_kept(one.weights[:, 1:], keep))
            voids.append(_kept(one.weights[:, :1], keep))
            areas, labels = one.areas[1:], one.labels[1:].astype(np.int64)
            columns.append((np.full(len(areas), len(columns), np.int64), areas, labels))
        del one
        if index % TRIM == TRIM - 1:
            return_free_memory()
        progress.update("mask votes", index + 1, views)
    if not parts:
        none = sparse.csr_matrix((count, 0), dtype=np.float32)
        return MaskVotes(none, none, np.zeros(0, np.int64), np.zeros(0))
    return MaskVotes(beside(parts, keep), beside(voids, keep), *map(np.concatenate, zip(*columns, strict=True)))


def _kept(part: sparse.csc_matrix, keep: Keep) -> sparse.csc_matrix:
    return sparse.csc_matrix((keep(part.data), keep(part.indices), part.indptr), shape=part.shape)


def beside(parts: list[sparse.csc_matrix], keep: Keep = np.asarray) -> sparse.csr_matrix:
    """The matrices [N, M_i] beside each other, by row. Empties `parts` on the way, so that nothing is in memory twice;
    scipy's functions hold three copies."""
    starts = np.zeros(parts[0].shape[0] + 1, np.int64)
    for part in parts:
        starts[1:] += np.bincount(part.indices, minlength=len(starts) - 1)
    starts = starts.cumsum()
    columns, values = keep(np.zeros(starts[-1], np.int32)), keep(np.zeros(starts[-1], np.float32))
    free, width = starts[:-1].copy(), 0
    for index, part in enumerate(parts):
        order = np.argsort(part.indices, kind="stable")
        rows = part.indices[order]
        first = np.flatnonzero(np.diff(rows, prepend=-1))
        runs = np.diff(np.append(first, len(rows)))
        entry = np.arange(len(rows)) + np.repeat(free[rows[first]] - first, runs)
        columns[entry] = width + np.repeat(np.arange(part.shape[1]), np.diff(part.indptr))[order]
        values[entry] = part.data[order]
        free[rows[first]] += runs
        width += part.shape[1]
        parts[index] = None
        if index % TRIM == TRIM - 1:
            return_free_memory()
    parts.clear()
    return sparse.csr_matrix((values, columns, starts), shape=(len(free), width))


@torch_on_one_thread()
@torch.no_grad()
def view_votes(nearby: Nearby, view: TrainingView, half_resolution: bool = True) -> ViewVotes | None:
    """The votes of the masks of one view, None if it has none. Label 0 means unlabelled: such pixels count as void.

    half_resolution: uses every other pixel per axis, at a quarter of the time. Masks are smooth enough for this. Areas
    are then in pixels of that size too.
    """
    if half_resolution and min(view.photo.shape[:2]) > 1:
        view = view.halved()
    if view.labels is None or not bool((view.labels > 0).any()):
        return None
    height, width = view.photo.shape[:2]
    names, dense = np.unique(np.append(view.labels.numpy(), 0), return_inverse=True)
    labels = torch.from_numpy(dense.reshape(-1)[:-1].reshape(height, width))
    masks = range(len(names))
    gaussians, rows = nearby.of(view.name)
    device, camera = gaussians.means.device, (view.camera_from_world, view.K)
    rasterizer = rasterizer_for(device)
    settings = Settings(width, height, variance=False, depth=False, eps2d=view.eps2d)
    forward = rasterizer.rasterize_forward(gaussians.inputs(*camera), settings)
    seen = forward.visible[0].cpu().numpy().nonzero()[0]
    if len(seen) < FEW * len(gaussians):  # a pass over all would take longer than what they show
        gaussians, rows = gaussians.rows(torch.from_numpy(seen).to(device)), rows[seen]
        forward = rasterizer.rasterize_forward(gaussians.inputs(*camera), settings)
        seen = np.arange(len(seen))
    inputs = gaussians.inputs(*camera, torch.zeros(len(gaussians), BLOCK, device=device))
    blocks: list[tuple[np.ndarray, ...]] = []
    for first in range(0, len(masks), BLOCK):
        block = masks[first : first + BLOCK]
        inside = torch.zeros(1, height, width, BLOCK)
        for channel, mask in enumerate(block):
            inside[0, ..., channel] = labels == mask
        gradients = Gradients.zeros(inputs, ["features"])
        rasterizer.rasterize_backward(inputs, settings, forward, Cotangents(features=inside.to(device)), gradients)
        assert gradients.features is not None  # for the type checker
        weights = gradients.features.cpu().numpy()[seen]
        row, column = np.nonzero(weights > FAINTEST)
        blocks.append((weights[row, column], rows[seen[row]], column + first))
    weights, row, column = map(np.concatenate, zip(*blocks, strict=True))
    table = sparse.csc_matrix((weights, (row, column)), shape=(len(nearby.gaussians), len(names)))
    return ViewVotes(table, names, np.bincount(dense.reshape(-1)[:-1], minlength=len(names)).astype(float))
