"""Gaussians for masks that have too few of their own, such as that of a coin, whose Gaussians straddle its border.

Such Gaussians belong to the coin in part and to the table in part, so no grouping can give the coin any. Once growth
has ended, a mask of LEAST_PIXELS or more gets WANTED Gaussians on its surface if fewer than OWN lie within it, and if
another photo shows their points inside one mask of about that size. Training then fits them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch

from perception.gaussians.model import Gaussians, isotropic
from perception.gaussians.views import TrainingView, surface_depth, unprojected
from perception.machine import in_threads

LEAST_PIXELS = 60  # of a mask; smaller ones are noise of the segmentation as often as things
OWN, WANTED = 16, 24  # Gaussians: a segment of the grouping has 16
SOLID = 0.1  # least opacity of a Gaussian that counts
NEAR = 0.03  # relative difference of depths of one surface
WITHIN = 0.5  # largest scale of a Gaussian of a mask, over the radius of a disc of the mask's area
AGREE = 0.4  # share of the points that another photo must show in one mask; a pixel off, it misses half of a fork
ALIKE = 4.0  # factor within which the areas of both masks agree, seen from the same distance
MOST = 0.05  # of all Gaussians are placed
OPACITY = 0.9  # of those placed; training has little time left to strengthen them against what they stand before


@dataclass(frozen=True)
class _Seen:
    """A photo as the map shows it. labels [H, W] int; depth [H, W] float16, 0 = none, over `unit`, the median; area [M]
    and own [M]: pixels and Gaussians of each mask, 0 for label 0; focal length in pixels."""

    view: TrainingView
    labels: np.ndarray
    depth: np.ndarray  # of all photos at once, so in half precision: a hundredth of NEAR
    unit: float
    area: np.ndarray
    own: np.ndarray
    focal: float

    def depth_at(self, pixel: tuple[np.ndarray, ...]) -> np.ndarray:
        """Depth [P] float32 in scene units of pixels, their rows [P] and columns [P]."""
        return self.depth[pixel].astype(np.float32) * np.float32(self.unit)

    def shown(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Label [P] and depth z [P] of each of points [P, 3]; label 0 where the photo does not show its surface."""
        inside, pixels, z = self.view.seen(points)
        pixel, label = tuple(pixels), np.zeros(len(points), self.labels.dtype)
        near = np.abs(self.depth_at(pixel) - z[inside]) < NEAR * z[inside]
        label[inside] = np.where(near, self.labels[pixel], 0)
        return label, z


@torch.no_grad()
def for_starved_masks(gaussians: Gaussians, views: list[TrainingView], seed: int) -> Gaussians:
    """The Gaussians to add; at most MOST of the N given."""
    like = gaussians.to(torch.device("cpu"))
    labelled = [view for view in views if view.labelled]
    means, widest = like.means.double().numpy(), like.log_scales.amax(dim=1).exp().numpy()
    seen = list(in_threads(partial(_seen, like, means, widest, like.opacities.numpy() >= SOLID), labelled))
    lacking = [np.flatnonzero((one.area >= LEAST_PIXELS) & (one.own < OWN)).tolist() for one in seen]
    starved = [(k, mask) for k, masks in enumerate(lacking) for mask in masks]
    starved.sort(key=lambda km: (-seen[km[0]].area[km[1]], km))
    placed: list[tuple[int, np.ndarray]] = []  # of each mask, the photo and its pixels [P, 2], row and column
    points, most = np.zeros((0, 3)), int(MOST * len(like))
    for k, mask in starved:
        if len(points) + WANTED > most:
            break
        pixels = _spread(seen[k].labels == mask, seen[k].depth)
        served = seen[k].own[mask] + (seen[k].shown(points)[0] == mask).sum()
        if served >= OWN or len(pixels) < OWN / 2:
            continue
        z = seen[k].depth_at(tuple(pixels.T))
        new = unprojected(*seen[k].view.camera, pixels[:, 1] + 0.5, pixels[:, 0] + 0.5, z)
        pixel = float(np.median(z)) / seen[k].focal
        if any(_confirms(other, new, pixel, int(seen[k].area[mask])) for j, other in enumerate(seen) if j != k):
            placed.append((k, pixels))
            points = np.concatenate([points, new])
    return _made(like, seen, placed, points, seed)


def _seen(gaussians: Gaussians, means: np.ndarray, widest: np.ndarray, solid: np.ndarray, view: TrainingView) -> _Seen:
    """means [N, 3], widest [N], the largest scales, and solid [N], whether each counts, are of all Gaussians."""
    assert view.labels is not None  # checked by the caller
    labels = view.labels.numpy()
    depth = surface_depth(gaussians, replace(view, depth=None))
    unit = float(np.median(depth[depth > 0])) if (depth > 0).any() else 1.0
    half = np.minimum(depth / np.float32(unit), np.finfo(np.float16).max).astype(np.float16)
    area = np.bincount(labels.ravel())
    area[0] = 0
    one = _Seen(view, labels, half, unit, area, np.zeros(len(area), np.int64), float(view.K[0, 0]))
    label, z = one.shown(means)
    fits = solid & (widest * one.focal / np.maximum(z, 1e-6) <= WITHIN * np.sqrt(area[label] / np.pi))
    return replace(one, own=np.bincount(label[fits], minlength=len(area)))


def _spread(mask: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """About WANTED pixels [P, 2] of `mask` [H, W] with depth, on a grid."""
    rows, columns = np.nonzero(mask & (depth > 0))
    step = max(1.0, np.sqrt(len(rows) / WANTED))
    cell = np.floor(rows / step).astype(np.int64) * mask.shape[1] + np.floor(columns / step).astype(np.int64)
    first = np.unique(cell, return_index=True)[1]
    return np.stack([rows, columns], axis=1)[np.sort(first)][: 2 * WANTED]


def _confirms(other: _Seen, points: np.ndarray, pixel: float, area: int) -> bool:
    """Whether `other` shows points [P, 3] of a mask in one mask that is as large as it should be there.

    area: of the mask in pixels, whose side is `pixel` at its median depth, in scene units.
    """
    label, z = other.shown(points)
    if np.count_nonzero(label) < AGREE * len(points):
        return False
    expected = area * (pixel * other.focal / float(np.median(z))) ** 2
    alike = (other.area >= max(LEAST_PIXELS, expected / ALIKE)) & (other.area <= expected * ALIKE)
    return bool((np.bincount(label, minlength=len(alike)) * alike).max() >= AGREE * len(points))


def _made(
    like: Gaussians, seen: list[_Seen], placed: list[tuple[int, np.ndarray]], points: np.ndarray, seed: int
) -> Gaussians:
    """Balls at points [P, 3], which are those of the pixels in `placed`, as large as their distance there."""
    colors, sizes = [np.zeros((0, 3))], [np.zeros(0)]
    for k, pixels in placed:
        view, depth = seen[k].view, seen[k].depth_at(tuple(pixels.T))
        gain = 1.0 if view.gain is None else view.gain.numpy()
        colors.append(view.photo.numpy()[tuple(pixels.T)] / 255 / gain)
        step = np.sqrt(seen[k].area[seen[k].labels[tuple(pixels.T)]] / len(pixels))
        sizes.append(0.5 * step * depth / seen[k].focal)
    rgb, scale = (torch.from_numpy(np.concatenate(rows).astype(np.float32)) for rows in (colors, sizes))
    generator = torch.Generator().manual_seed(seed)
    balls = isotropic(points, scale.clamp(min=1e-9).log(), rgb, OPACITY, like.features.shape[1], generator)
    return balls.with_coefficients(like.sh.shape[1])
