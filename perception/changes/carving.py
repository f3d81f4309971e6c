"""The surface of new things that stereo does not measure, from their outlines in several photos.

Stereo asks for two photos from similar directions, of which a dozen photos around a room have few. Along the rays of a
new thing's mask in one photo, a point may be on it where the other photos that see so far show something new, too
(space carving, Kutulakos & Seitz 2000). Its surface is where their colours agree best, if better than at the map's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from perception.changes.evidence import AGREE, LEAST_PIXELS, mask_odds
from perception.changes.look import Look
from perception.gaussians.depth_start import DepthCloud
from perception.gaussians.views import unprojected
from perception.geometry import inverse_se3, sums_by
from perception.machine import in_threads
from perception.masks.surface import voxel_keys

RAYS, STEPS, FINER, NEAREST = 300, 64, 9, 0.3
"""Rays of a mask; points on each, evenly in inverse depth, from the map's surface to NEAREST of its depth; finer ones
around the best."""
UNMEASURED, CHANGED, COVERED = 0.5, 0.5, 0.3
"""Share of a mask's changed pixels that are not measured, and of its pixels that changed, from which its rays are
searched; share of them that is covered by what other photos measured, from which they are not."""
OTHERS = 16
"""Most other photos by which the rays of a mask are judged."""
SUPPORT = (2, 0.3), (1, 0.7)
"""Other photos that must show something new at a point, and the share of the rays of a mask with such a point, below
which it is an error or a shadow. The second is for masks of which the first finds nothing, as two photos alone may show
a small thing: of made rooms things have .97 and more, errors .3 to .9."""
LEAST_ANGLE, AGAINST = 10.0, 0.2
"""Degrees by which one of them is apart; share of those that see so far which may show what the map does, as masks have
errors."""
BLUR, UNLIKE = 1.5, 0.3
"""Standard deviation in pixels of the window in which colours are compared; their largest difference that counts."""
PER_AGAINST, PER_SUPPORT, MANY = 0.1, 0.02, 6
"""Difference of colour that all photos against a point are worth, and one that supports it, up to MANY."""
FOOTPRINT = 2.0
"""Distance between the points that are returned, in pixels."""


@dataclass(frozen=True)
class _Photo:
    """A look with its pixels that count and that changed [h, w] bool, its smoothed colours [h, w, 3] in [0, 1] and its
    centre [3]."""

    look: Look
    counts: np.ndarray
    changed: np.ndarray
    colors: np.ndarray
    centre: np.ndarray


def carved_surface(looks: Sequence[Look], changed: Sequence[np.ndarray], known: np.ndarray) -> DepthCloud:
    """Points on new things of which stereo measured little. changed: pixels [h, w] bool of each look whose surface the
    map lacks. known [M, 3]: what was measured of it, evenly spread."""
    from scipy.spatial import cKDTree

    photos = [_photo(*pair) for pair in zip(looks, changed, strict=True)]
    spacing = float(np.median(cKDTree(known).query(known, k=2)[0][:, 1])) if len(known) > 1 else 0.0

    def found_in(photo: _Photo) -> list[np.ndarray]:
        masks = _unmeasured_masks(photo, known, spacing)
        tried = ((_on_rays(photo, label, photos, *support) for support in SUPPORT) for label in masks)
        return [next(filter(len, points), np.zeros((0, 7))) for points in tried]

    parts = [part for each in in_threads(found_in, photos) for part in each if len(part)]
    if not parts:
        return DepthCloud(0.0, np.zeros((0, 3)), np.zeros((0, 3), np.uint8))
    rows = np.concatenate(parts)
    side = FOOTPRINT * float(np.median(rows[:, 6]))
    _, voxel, count = np.unique(voxel_keys(rows[:, :3], side), return_inverse=True, return_counts=True)
    means = sums_by(voxel.reshape(-1), rows[:, :6], len(count)) / count[:, None]
    return DepthCloud(side, means[:, :3], np.rint(255 * means[:, 3:].clip(0, 1)).astype(np.uint8))


def _photo(look: Look, changed: np.ndarray) -> _Photo:
    colors = cv2.GaussianBlur(look.view.photo.numpy().astype(np.float32) / 255, (0, 0), BLUR)
    counts = (look.mapped > 0) & look.counts
    centre = inverse_se3(look.view.camera[1])[:3, 3]
    return _Photo(look, counts, changed & counts, np.asarray(colors), centre)


def _unmeasured_masks(photo: _Photo, known: np.ndarray, spacing: float) -> list[int]:
    """The masks that are mostly new, also where the map is too blurred to tell, and mostly measured in no photo.
    known [M, 3], spacing: see `carved_surface`."""
    labels = photo.look.labels
    areas = np.bincount(labels.ravel())
    new = np.bincount(labels[photo.changed], minlength=len(areas))
    bare = np.bincount(labels[photo.changed & (photo.look.measured == 0)], minlength=len(areas))
    chosen = (new >= LEAST_PIXELS) & (bare > UNMEASURED * new) & (new > CHANGED * areas)
    chosen &= mask_odds(photo.look)[1] < 0
    inside, (row, column), z = photo.look.view.seen(known)
    square = (spacing * float(photo.look.view.K[0, 0]) / z[inside]) ** 2  # pixels that a point stands for
    covered = np.bincount(labels[row, column], square, minlength=len(areas))
    return np.flatnonzero(chosen & (covered < COVERED * areas)).tolist()


def _on_rays(photo: _Photo, label: int, photos: Sequence[_Photo], least: int, share: float) -> np.ndarray:
    """[R, 7] point, colour and pixel footprint on rays of a mask; of none, where few of them have such a point. least,
    share: see SUPPORT."""
    look = photo.look
    row, column = np.nonzero(photo.changed & (look.labels == label))
    thin = slice(None, None, max(1, len(row) // RAYS))
    row, column = row[thin], column[thin]
    each, own = np.arange(len(row)), photo.colors[row, column]
    K, pose = look.view.camera

    def swept(nearer: np.ndarray) -> tuple[np.ndarray, ...]:
        """Points [S, R, 3] and depths, costs and differences [S, R] at 0 (on the map's surface) to 1 (NEAREST)."""
        z = look.mapped[row, column] / (1 + nearer * (1 / NEAREST - 1))
        x, y = (np.broadcast_to(at + 0.5, z.shape).ravel() for at in (column, row))
        points = unprojected(K, pose, x, y, z.ravel())
        others = _others(photo, points[len(row) // 2 :: len(row)], photos)
        judged = _judged(points, np.tile(own, (len(z), 1)), photo, others, least)
        return points.reshape(*z.shape, 3), z, *(values.reshape(z.shape) for values in judged)

    nearer = np.repeat(np.linspace(0, 1, STEPS)[:, None], len(row), axis=1)
    _, _, cost, _, flat = swept(nearer)
    between = np.linspace(-1, 1, FINER)[:, None] / (STEPS - 1)
    points, z, cost, difference, _ = swept(nearer[cost.argmin(axis=0), each] + between)
    best = cost.argmin(axis=0), each
    found = np.isfinite(cost[best]) & (difference[best] < flat[0])
    if found.mean() < share:
        return np.zeros((0, 7))
    return np.column_stack([points[best], own, z[best] / K[0, 0]])[found]


def _others(photo: _Photo, ray: np.ndarray, photos: Sequence[_Photo]) -> list[_Photo]:
    """The OTHERS photos in which most of the points [S, 3] of a ray lie."""
    counts = [0 if other is photo else len(other.look.view.seen(ray)[0]) for other in photos]
    order = np.argsort(counts, kind="stable")[::-1][:OTHERS]
    return [photos[n] for n in order.tolist() if counts[n] > 0]


def _judged(
    points: np.ndarray, colors: np.ndarray, photo: _Photo, others: Sequence[_Photo], least: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of points on rays of a photo, with its colours there [P, 3], each [P]: what counts against them, infinite where
    they are on no new thing; mean difference of colour to the `least` photos likest there;
    the same to those in which they lie on the map's surface, infinite where there are none."""
    support, against, apart, near, flat = np.zeros((5, len(points)))
    best = np.full((least, len(points)), UNLIKE)  # other photos see other sides of it
    rays = _unit(points - photo.centre)
    for other in others:
        look, (at, (row, column), depth) = other.look, other.look.view.seen(points)
        z = depth[at]
        mapped, measured = look.mapped[row, column], look.measured[row, column]
        reached = (z < mapped * (1 - AGREE / 2)) & ~((measured > 0) & (measured < z * (1 - AGREE)))
        reached &= other.counts[row, column]
        shows = reached & other.changed[row, column] & ~(measured > z * (1 + AGREE))
        support[at] += shows
        against[at] += reached & ~shows
        unlike = np.minimum(np.abs(other.colors[row, column] - colors[at]).mean(axis=1), UNLIKE)
        worst = best[:, at].argmax(axis=0)
        best[worst, at] = np.minimum(best[worst, at], np.where(shows, unlike, UNLIKE))
        on = np.abs(z / np.maximum(mapped, 1e-9) - 1) < AGREE
        near[at] += on
        flat[at] += np.where(on, unlike, 0)
        angle = np.arccos(np.clip((rays[at] * _unit(points[at] - other.centre)).sum(axis=1), -1, 1))
        apart[at] = np.maximum(apart[at], np.where(shows, np.degrees(angle), 0))
    seen = np.maximum(support + against, 1)
    good = (support >= least) & (apart > LEAST_ANGLE) & (against <= AGAINST * seen)
    difference = best.mean(axis=0)
    cost = difference + PER_AGAINST * against / seen - PER_SUPPORT * np.minimum(support, MANY)
    return np.where(good, cost, np.inf), difference, np.where(near > 0, flat / np.maximum(near, 1), np.inf)


def _unit(rays: np.ndarray) -> np.ndarray:
    return np.asarray(rays / np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-12))
