"""Depth of every photo by multi-view stereo: plane sweep (Collins 1996) and semi-global matching (Hirschmüller 2008).

What a sensor measured is the depth. Depth rendered from a partly trained map fits colours and not surfaces, so it is
only a prior. Planes perpendicular to the optical axis, evenly spaced in inverse depth, warp neighbouring photos into
this one. The matching cost comes from zero-mean normalised cross-correlation. Semi-global aggregation along four
directions selects a smooth depth. Depths that no neighbour confirms are dropped.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np

from perception import _core
from perception.io.memory import Keep
from perception.masks.cues import DepthCues, PhotoCues, depth_cues, filled_depth, photo_cues
from perception.photos.decode import scaled_K
from perception.progress import QUIET, Progress
from perception.types import View

PLANES = 96
NEAREST, FARTHEST = 0.75, 1.35  # of the planes, relative to the prior's range
NEIGHBOURS = 6  # photos that a photo is matched with, at most
_CONFIRMED = 2  # photos that must agree with a depth before it contributes to the surface
_AGREE = 0.03  # largest relative difference of depths that confirm each other
SIDE = 320  # pixels of the long side at stereo resolution
_LEAST_DEPTH = 0.05  # share of a photo's pixels that must have depth; other photos are not used
_GRID = 24  # pixels between the points by which neighbours are chosen
_LEAST_GAIN = 1e-3  # mean usefulness that one more neighbour must add
ANGLE, NARROWER, WIDER = 12.0, 5.0, 10.0  # degrees between rays: best one, standard deviations below and above it
_LEAST_COSINE = 0.6  # of an angle, 53°: from there on two photos of a point add less than _LEAST_GAIN to one another


@dataclass
class StereoView:
    """One photo. photo: [h, w, 3] uint8 RGB; grey: [h, w] uint8; K: [3, 3]; camera_from_world: [4, 4] float64.

    prior: [h, w] depth known before stereo, 0 = none. preferred: the prior where stereo prefers it, 0 = nowhere near.
    depth: [h, w] current best depth. confirmed: [h, w] bool, pixels whose depth other photos agree with. measured: the
    prior comes from a sensor. learned: [3, h, w] float16, see `boundaries`, set by `fuse`. voxel: [h, w] int32, the
    voxel of the surface that each pixel shows, −1 = none, set by `surface_graphs`. keep: where images that are made
    later are kept.
    """

    name: str
    photo: np.ndarray
    grey: np.ndarray
    K: np.ndarray
    camera_from_world: np.ndarray
    prior: np.ndarray
    preferred: np.ndarray
    depth: np.ndarray
    confirmed: np.ndarray
    measured: bool = False
    voxel: np.ndarray = field(default_factory=lambda: np.zeros((0, 0), np.int32))
    learned: np.ndarray = field(default_factory=lambda: np.zeros((3, 0, 0), np.float16))
    keep: Keep = np.asarray

    @property
    def center(self) -> np.ndarray:
        """[3] camera centre in the world frame."""
        return -self.camera_from_world[:3, :3].T @ self.camera_from_world[:3, 3]

    @property
    def world_from_camera(self) -> np.ndarray:
        """[4, 4]."""
        return np.asarray(np.linalg.inv(self.camera_from_world))

    def cues(self) -> tuple[PhotoCues, DepthCues]:
        """Cues of photo and depth. They are recomputed at every call, because they take 20 times the photo's memory."""
        return photo_cues(self.photo), depth_cues(self.depth, self.K)


def make_stereo_view(view: View, photo: np.ndarray, depth: np.ndarray, keep: Keep = np.asarray) -> StereoView | None:
    """photo: [H, W, 3] uint8 RGB; depth: [H, W] prior, 0 = none. Returns None if too few pixels have depth."""
    height, width = photo.shape[:2]
    ratio = SIDE / max(height, width)
    size = (max(1, round(width * ratio)), max(1, round(height * ratio)))
    known = np.isfinite(depth) & (depth > 0)
    prior = cv2.resize(np.where(known, depth, 0).astype(np.float32), size, interpolation=cv2.INTER_NEAREST)
    if known.mean() < _LEAST_DEPTH or not prior.any():
        return None
    small = cv2.resize(photo, size, interpolation=cv2.INTER_AREA if ratio < 1 else cv2.INTER_LINEAR)
    K = scaled_K(view, *size)
    grey = cv2.cvtColor(small, cv2.COLOR_RGB2GRAY)
    pose = np.asarray(view.camera_from_world, np.float64)
    measured = view.depth is not None
    filled, known, prior = keep(filled_depth(prior)), keep(prior > 0), keep(prior)
    return StereoView(view.name, keep(small), keep(grey), K, pose, prior, prior, filled, known, measured, keep=keep)


def measure_depths(views: list[StereoView], progress: Progress = QUIET, stage: str = "masks (stereo)") -> None:
    """Replaces the depths of all views by stereo depths, and marks the pixels confirmed by other views.
    Depths that a sensor measured are kept, averaged with those of the views that agree."""
    chosen = choose_neighbours(views)
    depths = []
    for i, (view, near) in enumerate(zip(views, chosen, strict=True), start=1):
        swept = near and not view.measured
        depths.append(view.keep(sweep(view, [views[j] for j in near])) if swept else view.depth)
        progress.update(stage, i, len(views))
    for view, depth, near in zip(views, depths, chosen, strict=True):
        if near:
            agreeing, mean = confirmed(depth, view, [views[j] for j in near], [depths[j] for j in near])
            view.depth, view.confirmed = view.keep(mean), view.keep(agreeing >= min(_CONFIRMED, len(near)))


def sweep(view: StereoView, others: list[StereoView]) -> np.ndarray:
    """[h, w] float32 depth of `view` from its neighbours `others`, dense.

    The matching cost of a pixel at a plane is (1 − mean of its two best correlations over 7×7 pixels) / 2, plus a cost
    per plane of distance from the preferred depth. Semi-global aggregation (Hirschmüller 2008, eq. 13) sums the costs
    of paths from the left, the right, above and below; steps to distant planes cost less where the photo has a
    gradient.
    """
    inverse = plane_depths(view.prior)
    depth = np.empty_like(view.prior)
    maps = np.array([homographies(view, other) for other in others])
    step = (inverse[-1] - inverse[0]) / (PLANES - 1)
    greys = [other.grey for other in others]
    _core.plane_sweep(view.grey, greys, maps, view.preferred, inverse[0], step, PLANES, depth)
    return depth


def plane_depths(prior: np.ndarray) -> np.ndarray:
    """[PLANES] inverse depths, near to far, covering the prior's range with a margin."""
    near, far = np.percentile(prior[prior > 0], [1, 99])
    return np.linspace(1 / (NEAREST * near), 1 / (FARTHEST * far), PLANES)


def homographies(view: StereoView, other: StereoView) -> tuple[np.ndarray, np.ndarray]:
    """(A, B): A + B / z maps pixels of `view` to `other` for the plane at depth z; pixel centres at +0.5."""
    other_from_view = other.camera_from_world @ np.linalg.inv(view.camera_from_world)
    half = np.array([[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1.0]])  # OpenCV's pixel centres are at whole numbers
    inverse_K = np.linalg.inv(half @ view.K)
    A = half @ other.K @ other_from_view[:3, :3] @ inverse_K
    B = half @ other.K @ np.outer(other_from_view[:3, 3], [0, 0, 1.0]) @ inverse_K
    return A, B


def choose_neighbours(views: list[StereoView]) -> list[list[int]]:
    """Up to NEIGHBOURS other views per view that jointly observe its points, preferably at angles of 5° to 25°."""
    chosen: list[list[int]] = []
    centers = np.array([view.center for view in views])
    for i, view in enumerate(views):
        points = _sample(view)
        ratio, cosine = _rays(points, view.center, centers)
        near = np.flatnonzero((cosine > _LEAST_COSINE).any(axis=1))
        near = near[near != i]
        useful = _usefulness(points, [views[n] for n in near], ratio[near], cosine[near])
        first = second = np.zeros(len(points))  # usefulness of the best two chosen views for each point
        best_views: list[int] = []
        while len(best_views) < min(NEIGHBOURS, len(near)):
            gain = np.maximum(useful, first) + np.clip(np.minimum(useful, first), second, None) - first - second
            gain = gain.sum(axis=1) / len(points)
            gain[best_views] = -1
            best = int(gain.argmax())
            if gain[best] < _LEAST_GAIN:
                break
            best_views.append(best)
            second = np.maximum(second, np.minimum(useful[best], first))
            first = np.maximum(first, useful[best])
        chosen.append(near[best_views].tolist())
    return chosen


def _sample(view: StereoView) -> np.ndarray:
    """[P, 3] world points of a coarse grid of pixels."""
    y, x = np.mgrid[tuple(slice(_GRID // 2, side, _GRID) for side in view.prior.shape)]
    z = view.prior[y, x]
    rays = np.stack([x + 0.5, y + 0.5, np.ones(x.shape)], axis=-1) @ np.linalg.inv(view.K).T
    points = (rays * z[..., None])[z > 0]
    return (points - view.camera_from_world[:3, 3]) @ view.camera_from_world[:3, :3]


def _rays(points: np.ndarray, center: np.ndarray, centers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How points [P, 3] lie to the centre of a view and to those [V, 3] of all views: the ratio of the smaller to the
    larger distance, and the cosine of the angle between both rays, [V, P] each."""
    a = [points[:, k] - center[k] for k in range(3)]
    b = [points[:, k] - centers[:, k, None] for k in range(3)]
    far_a, far_b = (np.sqrt(x * x + y * y + z * z) for x, y, z in (a, b))
    cosine = (a[0] * b[0] + a[1] * b[1] + a[2] * b[2]) / np.maximum(far_a * far_b, 1e-12)
    closeness = far_b / np.maximum(far_a, 1e-12)
    return np.minimum(closeness, 1 / np.maximum(closeness, 1e-12)), cosine


def _usefulness(points: np.ndarray, others: list[StereoView], ratio: np.ndarray, cosine: np.ndarray) -> np.ndarray:
    """[V, P] in [0, 1]: 0 where one of `others` does not see a point, else r exp(−((α − ANGLE) / σ)² / 2).

    r, α: ratio and angle, degrees, of `_rays` of the others; σ: NARROWER below ANGLE, else WIDER. r is there because at
    twice the distance the resolution is half.
    """
    poses = np.array([other.camera_from_world for other in others]).reshape(-1, 4, 4)
    Ks = np.array([other.K for other in others]).reshape(-1, 3, 3)
    h, w = np.array([other.grey.shape for other in others]).reshape(-1, 2, 1).transpose(1, 0, 2)
    local = points @ poses[:, :3, :3].transpose(0, 2, 1) + poses[:, None, :3, 3]
    x, y, _ = np.moveaxis(local @ Ks.transpose(0, 2, 1) / np.maximum(local[..., 2:], 1e-9), 2, 0)
    seen = (local[..., 2] > 0) & (x > 0) & (y > 0) & (x < w) & (y < h)
    angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    width = np.where(angle < ANGLE, NARROWER, WIDER)
    return np.asarray(seen * ratio * np.exp(-(((angle - ANGLE) / width) ** 2) / 2))


def confirmed(
    depth: np.ndarray, view: StereoView, others: list[StereoView], their_depths: list[np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Number of `others` that agree with each depth [h, w] int32, and the mean [h, w] of it and the agreeing depths."""
    h, w = depth.shape
    pixels = np.stack([*np.mgrid[:h, :w][::-1], np.ones((h, w), np.int64)]).reshape(3, -1)
    count, ratios = np.zeros(h * w, np.int32), np.ones(h * w)
    for other, theirs in zip(others, their_depths, strict=True):
        A, B = homographies(view, other)
        u, v, nearer = A @ pixels + B[:, 2:] / depth.reshape(-1)  # nearer: their depth over this one
        rows, columns = theirs.shape
        with np.errstate(divide="ignore", invalid="ignore"):
            column, row = np.rint(u / nearer), np.rint(v / nearer)
        inside = (nearer > 0) & (column >= 0) & (row >= 0) & (column < columns) & (row < rows)
        pixel = np.where(inside, row * columns + column, 0).astype(np.int64)
        ratio = theirs.reshape(-1)[pixel] / np.where(inside, nearer * depth.reshape(-1), 1)
        agrees = inside & (np.abs(ratio - 1) < _AGREE)
        count += agrees
        ratios += np.where(agrees, ratio, 0)  # for similar view directions, both depths scale by the same ratio
    return count.reshape(h, w), (depth * (ratios / (1 + count)).reshape(h, w)).astype(np.float32)
