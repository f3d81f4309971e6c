"""Depth of photos from their neighbours where no sensor measured it, for scenes of which each point is in few photos.

Colours alone then leave free how far a surface is, and what fits one photo hangs as a veil before other cameras. The
depth is found as for the built-in masks, with the sparse cloud as what is known before, and kept where others agree.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
import torch

from perception.gaussians.views import TrainingView
from perception.io.memory import Keep
from perception.masks.cues import filled_depth
from perception.masks.stereo import SIDE, make_stereo_view, measure_depths
from perception.photos.depth import without_edges
from perception.progress import QUIET, Progress
from perception.types import View

GRID, HIDDEN = 16, 1.3  # a point is hidden if HIDDEN times as far as the nearest in its cell of GRID × GRID
FEW = 16  # photos of the median sparse point up to which stereo is used: more fix the depth by their colours
LEAST_POINTS = 100  # sparse points of a scene below which the range of depths is not known
CELLS = 64  # cells along a side of the photo in which the nearest visible point is what is known before

PATCH, FLAT = 7, 0.5
"""Side of a patch in pixels; standard deviation of grey levels below which it shows nothing but rounding,
and its depth is a guess: worth 0.5 dB and 4 dB in the worst view (every 6th photo of a bonsai)."""


def with_stereo(
    views: Sequence[View],
    decoded: list[TrainingView],
    points: np.ndarray,
    progress: Progress = QUIET,
    keep: Keep = np.asarray,
) -> list[TrainingView]:
    """The `decoded` photos of `views` with the depth [H, W] that stereo finds, to start Gaussians from; as given when
    any has measured depth or fewer than SIDE pixels on its long side, or where the median one of the sparse points
    [P, 3] is visible in more than FEW photos. keep: where images are held."""
    small = any(max(photo.photo.shape) < SIDE for photo in decoded)
    if len(points) < LEAST_POINTS or len(views) < 2 or small or any(view.depth is not None for view in views):
        return decoded
    seen = [visible_points(view, points) for view in views]
    count = np.sum(seen, axis=0)
    if np.median(count[count > 0]) > FEW:
        return decoded
    made = [
        make_stereo_view(view, photo.photo.numpy(), _prior(view, points[mine]), keep) if mine.any() else None
        for view, photo, mine in zip(views, decoded, seen, strict=True)
    ]
    measure_depths([stereo for stereo in made if stereo is not None], progress, "stereo")
    found = []
    for photo, stereo in zip(decoded, made, strict=True):
        if stereo is not None:
            kept = without_edges(stereo.depth) * (stereo.confirmed & _textured(stereo.grey))
            depth = cv2.resize(kept.astype(np.float32), photo.photo.shape[1::-1], interpolation=cv2.INTER_NEAREST)
            depth *= 1 if photo.weight is None else photo.weight.numpy() > 0
            photo = replace(photo, depth=torch.from_numpy(keep(depth)))
        found.append(photo)
    return found


def _textured(grey: np.ndarray) -> np.ndarray:
    """[h, w] bool: whether the patch around each pixel of grey [h, w] uint8 shows something that stereo can match."""
    levels = grey.astype(np.float32)
    variance = cv2.blur(levels * levels, (PATCH, PATCH)) - cv2.blur(levels, (PATCH, PATCH)) ** 2
    return np.asarray(variance > FLAT**2)


def _prior(view: View, points: np.ndarray) -> np.ndarray:
    """[CELLS, CELLS] depth of the nearest of points [P, 3] in each cell of the photo, elsewhere of the cell nearby."""
    u, v, depth = _projected(view, points)
    cells = np.full((CELLS, CELLS), np.inf)
    np.minimum.at(cells, ((v * CELLS).astype(int), (u * CELLS).astype(int)), depth)
    return filled_depth(cells)


def visible_points(view: View, points: np.ndarray) -> np.ndarray:
    """[P] bool: the points [P, 3] in the photo that no nearer points hide."""
    u, v, depth = _projected(view, points)
    inside = (depth > 1e-6) & (u >= 0) & (u < 1) & (v >= 0) & (v < 1)
    cell = (v[inside] * GRID).astype(int) * GRID + (u[inside] * GRID).astype(int)
    nearest = np.full(GRID * GRID, np.inf)
    np.minimum.at(nearest, cell, depth[inside])
    inside[inside] = depth[inside] <= HIDDEN * nearest[cell]
    return np.asarray(inside)


def _projected(view: View, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """u, v [P] as shares of the photo's width and height, and depth [P], of points [P, 3]."""
    pose = view.camera_from_world
    x, y, z = pose[:3, :3] @ points.T + pose[:3, 3:]
    depth = np.where(z > 1e-6, z, 1.0)
    u = (view.K[0, 0] * x / depth + view.K[0, 2]) / view.width
    return u, (view.K[1, 1] * y / depth + view.K[1, 2]) / view.height, z
