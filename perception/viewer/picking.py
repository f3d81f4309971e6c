"""Picking: the instance, and the point, that a ray through the map shows."""

from __future__ import annotations

import numpy as np

from perception.geometry import rotations, transform
from perception.map.write import Map

PIXEL = 0.0015  # angle of a click in radians: about a pixel of a laptop's window
SEEN = 0.15  # smallest weight in the picture, in [0, 1], at which an instance or a point is picked


def pick(gmap: Map, ids: np.ndarray, shown: np.ndarray, origin: np.ndarray, direction: np.ndarray) -> int | None:
    """The instance id that a ray (origin [3], direction [3], map frame) shows, None when it meets none.

    A pixel is rendered along the ray: the instance with the largest weight in it. shown [N] bool: Gaussians that are
    visible.
    """
    rows, weights = _weights(gmap, shown, origin, direction)
    known, owner = np.unique(ids[rows], return_inverse=True)
    total = np.where(known >= 0, np.bincount(owner.reshape(-1), weights, len(known)), 0)
    return int(known[total.argmax()]) if total.max(initial=0) >= SEEN else None


def pick_point(gmap: Map, shown: np.ndarray, origin: np.ndarray, direction: np.ndarray) -> np.ndarray | None:
    """The point [3] float64 of the surface that a ray shows, as `pick`; None when it meets none.

    A Gaussian is densest on o + t d at t = dᵀ Σ⁻¹ (μ − o) / dᵀ Σ⁻¹ d: there the ray crosses a flat one. The median of t
    by weight in the pixel is used; at an edge the mean lies between the surfaces.
    """
    rows, weights = _weights(gmap, shown, origin, direction)
    if weights.sum() < SEEN:
        return None
    rows, weights = rows[weights > 0], weights[weights > 0]
    turns = rotations(gmap.quats[rows])
    inverse = np.exp(-gmap.log_scales[rows].astype(np.float64))  # Σ⁻¹ = A Aᵀ with A = R S⁻¹
    along = np.einsum("nij,i->nj", turns, direction) * inverse
    away = np.einsum("nij,ni->nj", turns, gmap.means[rows] - np.asarray(origin)) * inverse
    t = (along * away).sum(axis=1) / (along**2).sum(axis=1)
    order = np.argsort(t)
    middle = order[np.searchsorted(np.cumsum(weights[order]), weights.sum() / 2)]
    return np.asarray(origin + t[middle] * direction)


def _weights(gmap: Map, shown: np.ndarray, origin: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows of the Gaussians near a ray, and the weight of each in the pixel rendered along it; empty for none."""
    import torch

    from perception.rasterizer.rasterize import rasterize

    origin, direction = np.asarray(origin, np.float64), np.asarray(direction, np.float64)
    usable = np.isfinite([origin, direction]).all() and direction.any()
    # A cheap test first: only Gaussians within four radii of the ray contribute.
    unit = direction / np.linalg.norm(direction) if usable else np.full(3, np.nan)
    away = gmap.means - origin
    along = away @ unit
    off = np.linalg.norm(away - along[:, None] * unit, axis=1)
    near = np.flatnonzero(shown & (along > 0) & (off < 4 * (gmap.scales.max(axis=1) + PIXEL * along)))
    if not len(near):
        return near, np.empty(0)
    side = np.cross(unit, np.eye(3)[np.abs(unit).argmin()])
    axes = np.stack([side, np.cross(unit, side), unit])
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    pose = transform(axes, -axes @ origin)
    K = np.array([[1 / PIXEL, 0, 0.5], [0, 1 / PIXEL, 0.5], [0, 0, 1]])
    arrays = (gmap.means[near], gmap.quats[near], gmap.scales[near], gmap.opacities[near], pose[None], K[None])
    means, quats, scales, opacities, camera, lens = (torch.from_numpy(array.astype(np.float32)) for array in arrays)
    colors = torch.zeros_like(means, requires_grad=True)
    out = rasterize(means, quats, scales, opacities, colors, camera, lens, 1, 1, depth=False)
    (weights,) = torch.autograd.grad(out.colors[..., 0].sum(), colors)  # colour = Σ weight · colour of each
    return near, weights[:, 0].numpy().astype(np.float64)


def covariances(gmap: Map) -> np.ndarray:
    """[N, 3, 3] float32 covariance matrices R S Sᵀ Rᵀ of the Gaussians."""
    axes = rotations(gmap.quats) * gmap.scales[:, None]
    return (axes @ axes.transpose(0, 2, 1)).astype(np.float32)
