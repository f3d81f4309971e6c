"""Starts Gaussians on the surface that depth sensors measured: the depth images of all views, fused into voxels.

The noise of a triangulating sensor grows with the square of the distance, so a pixel counts z⁻⁴, the inverse of its
variance. Voxels that other cameras look through are noise, reflections or moving things, and are dropped.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from perception.gaussians.model import Gaussians, from_points
from perception.gaussians.views import TrainingView, unprojected
from perception.geometry import sums_by
from perception.machine import in_threads
from perception.masks.surface import voxel_keys

SAMPLES = 1_500_000  # most pixels that are fused; an even grid of pixels is taken from more
FINEST = 2.0  # least voxel side in pixel footprints at the median depth
LEAST_PIXELS = 2  # samples that a voxel needs: fewer are mostly noise
REACH = 4  # pixels to either side between which the slope of the surface is measured
AGREE = 0.04  # relative difference of depths up to which a view sees a voxel; beyond, it looks through it
STEEPEST = 0.2  # least cosine between a pixel's ray and the surface normal: steeper surfaces are measured badly
OPACITY, WIDTH, THICKNESS, NEIGHBOURS = 0.9, 0.7, 0.1, 9
"""The first Gaussians are nearly opaque discs: WIDTH of the voxels' spacing, THICKNESS of that along the normal of
their nearest NEIGHBOURS. Balls hide what lies behind slanted surfaces: their depth is 5 cm too short in the median, and
that of discs 3 cm (kitchen_rgbd, voxels of 6 cm, before training)."""
SHARE = 0.5  # share of the budget for the surface; the rest grows where the photos need it


@dataclass(frozen=True)
class DepthCloud:
    """side: of the voxels; points [P, 3] float64 in the world frame, one per voxel; colors [P, 3] uint8."""

    side: float
    points: np.ndarray
    colors: np.ndarray


def start_on_surface(
    views: Sequence[TrainingView], points: np.ndarray, colors: np.ndarray, budget: int, feature_dim: int, seed: int
) -> Gaussians | None:
    """One Gaussian per voxel of the fused depth of `views`, and per sparse point where no depth was measured.

    points [P, 3], colors [P, 3] uint8: sparse points. None when no depth was measured. At most SHARE of the budget is
    used, but eight Gaussians where that is less.
    """
    most = max(8, int(SHARE * budget))  # the voxels that meet at the origin are eight, whatever their side
    cloud = fuse_depth(views, most)
    if cloud is None:
        return None
    balls = from_points(cloud.points, cloud.colors, feature_dim=feature_dim, seed=seed, opacity=OPACITY)
    surface = _discs(balls)
    away = cKDTree(cloud.points).query(points)[0] > 4 * cloud.side if len(points) else np.zeros(0, bool)
    rest = np.flatnonzero(away)[: most - len(surface)]
    if len(rest) == 0:
        return surface
    return Gaussians.concatenate([surface, from_points(points[rest], colors[rest], feature_dim=feature_dim, seed=seed)])


def _discs(gaussians: Gaussians) -> Gaussians:
    """The Gaussians as discs in the planes of their nearest neighbours, sizes as WIDTH and THICKNESS say."""
    means = gaussians.means.double().numpy()
    near = means[cKDTree(means).query(means, k=min(NEIGHBOURS, len(means)))[1].reshape(len(means), -1)]
    offset = near - near.mean(axis=1, keepdims=True)
    covariance = np.stack([(offset * offset[..., i : i + 1]).sum(axis=1) for i in range(3)], axis=1)
    axes = np.linalg.eigh(covariance)[1]  # columns, by ascending variance: the first is the normal
    axes *= np.linalg.det(axes)[:, None, None]
    quats = Rotation.from_matrix(axes).as_quat()[:, [3, 0, 1, 2]]
    log_scales = gaussians.log_scales + math.log(WIDTH) + torch.tensor([math.log(THICKNESS), 0, 0])
    return replace(gaussians, quats=torch.from_numpy(np.ascontiguousarray(quats, np.float32)), log_scales=log_scales)


def fuse_depth(views: Sequence[TrainingView], most: int) -> DepthCloud | None:
    """At most `most` points of the surface that the depth images of `views` show; None when they show none."""
    measured = [view for view in views if view.depth is not None and bool((view.depth > 0).any())]
    if not measured:
        return None
    pixels = sum(view.photo.shape[0] * view.photo.shape[1] for view in measured)
    every = max(1, int(np.ceil(np.sqrt(pixels / SAMPLES))))
    samples = [_samples(view, every) for view in measured]
    points, colors, weights, footprints = (np.concatenate(parts) for parts in zip(*samples, strict=True))
    if len(points) == 0:
        return None
    side = FINEST * float(np.median(footprints))
    while True:
        cloud = _voxels(points, colors, weights, side, measured)
        if len(cloud.points) <= most:
            return cloud if len(cloud.points) else None
        side *= max(1.05, float(np.sqrt(len(cloud.points) / most)))


def _samples(view: TrainingView, every: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """World points [P, 3], colours [P, 3], weights [P] and pixel footprints [P] of every `every`-th measured pixel."""
    assert view.depth is not None
    z, K = view.depth.double().numpy(), view.K.double().numpy()
    row, column = np.mgrid[every // 2 : z.shape[0] : every, every // 2 : z.shape[1] : every].reshape(2, -1)
    known = (z[row, column] > 0) & (_facing(z, K)[row, column] > STEEPEST)
    row, column = row[known], column[known]
    depth = z[row, column]
    points = unprojected(*view.camera, column + 0.5, row + 0.5, depth)
    return points, view.photo.numpy()[row, column], depth**-4.0, depth / K[0, 0]


def _facing(z: np.ndarray, K: np.ndarray) -> np.ndarray:
    """[H, W] cosine between ray and surface normal, from depths z [H, W]; 1 where a depth at ± REACH pixels is missing.

    cos = 1 / √(1 + s_x² + s_y²), s_x = f_x / z ∂z/∂x the slope along the image's columns, f_x the focal length.
    """
    slopes = []
    for axis, focal in ((0, K[1, 1]), (1, K[0, 0])):
        ahead, behind = np.roll(z, -REACH, axis), np.roll(z, REACH, axis)
        known = (ahead > 0) & (behind > 0)
        for edge in (slice(None, REACH), slice(-REACH, None)):
            np.moveaxis(known, axis, 0)[edge] = False
        slopes.append(np.where(known, (ahead - behind) * focal / (2 * REACH * np.where(z > 0, z, 1)), 0))
    return 1 / np.sqrt(1 + slopes[0] ** 2 + slopes[1] ** 2)


def _voxels(
    points: np.ndarray, colors: np.ndarray, weights: np.ndarray, side: float, views: list[TrainingView]
) -> DepthCloud:
    """Weighted means of the samples in each voxel of LEAST_PIXELS or more that no majority of views looks through."""
    _, index, count = np.unique(voxel_keys(points, side), return_inverse=True, return_counts=True)
    values = np.concatenate([points, colors], axis=1)
    means = sums_by(index, values, len(count), weights) / np.bincount(index, weights)[:, None]
    means = means[count >= LEAST_PIXELS]
    means = means[_consistent(means[:, :3], side, views)]
    return DepthCloud(side, means[:, :3], np.rint(means[:, 3:]).astype(np.uint8))


def _consistent(points: np.ndarray, side: float, views: list[TrainingView]) -> np.ndarray:
    """[P] bool: whether at least as many views measured each point as measured something behind it."""
    points = np.asfortranarray(points)  # by column, as they are read

    def judged(view: TrainingView) -> tuple[np.ndarray, np.ndarray]:
        """Points [M] in the image, and whether the view measured each there (1) or something behind it (−1)."""
        assert view.depth is not None
        shown, pixels, z = view.seen(points)
        theirs = view.depth.numpy()[tuple(pixels)].astype(np.float64)
        slack, behind = AGREE * theirs + side / 2, theirs - z[shown]
        return shown, np.where(theirs > 0, (np.abs(behind) <= slack) * 1 - (behind > slack), 0)

    seen, through = np.zeros(len(points), np.int32), np.zeros(len(points), np.int32)
    for shown, sign in in_threads(judged, views):
        seen[shown] += sign > 0
        through[shown] += sign < 0
    return seen >= np.maximum(through, 1)
