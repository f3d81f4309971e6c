"""Depth of every photo by multi-view stereo: plane sweep (Collins 1996) and semi-global matching (Hirschmüller 2008).

What a sensor measured is the depth. Depth rendered from a partly trained map fits colours and not surfaces, so it is
only a prior. Planes perpendicular to the optical axis, evenly spaced in inverse depth, warp neighbouring photos into
this one. The matching cost comes from zero-mean normalised cross-correlation. Semi-global aggregation along four
directions selects a smooth depth. Depths that no neighbour confirms are dropped.
"""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from perception.masks.stereo_views import StereoView
from perception.progress import Progress

PLANES = 96
NEIGHBOURS = 6
_WINDOW = 7  # pixels, side of the correlation window
_BEST = 2  # neighbours whose correlation counts per plane; the point may be occluded in the others
_P1, _P2 = 0.06, 0.6  # cost of a step to the next plane, and to any other plane, where the photo has no gradient
_PRIOR_COST = (0.02, 0.16)  # cost per plane of distance from the prior depth, and its upper limit
_CONFIRMED = 2  # photos that must agree with a depth before it contributes to the surface
_AGREE = 0.03  # largest relative difference of depths that confirm each other


def measure_depths(views: list[StereoView], progress: Progress | None = None) -> None:
    """Replaces the depths of all views by stereo depths, and marks the pixels confirmed by other views.

    Depths that a sensor measured are kept, averaged with those of the views that agree.
    """
    chosen = choose_neighbours(views)

    def depth_of(i: int) -> np.ndarray:
        swept = chosen[i] and not views[i].measured
        return sweep(views[i], [views[j] for j in chosen[i]]) if swept else views[i].depth

    depths = []
    pool = ThreadPoolExecutor(os.cpu_count())
    try:
        for done, depth in enumerate(pool.map(depth_of, range(len(views))), start=1):
            depths.append(depth)
            if progress is not None:
                progress.update("masks (stereo)", done, len(views))
    finally:
        pool.shutdown(cancel_futures=True)  # Ctrl-C waits only for photos already started
    for view, depth, near in zip(views, depths, chosen, strict=True):
        if near:
            agreeing, mean = confirmed(depth, view, [views[j] for j in near], [depths[j] for j in near])
            view.depth, view.confirmed = mean, agreeing >= min(_CONFIRMED, len(near))


def sweep(view: StereoView, others: list[StereoView]) -> np.ndarray:
    """[h, w] float32 depth of `view` from its neighbours `others`, dense."""
    inverse = plane_depths(view.prior)
    volume = matching_cost(view, others, inverse)
    expected = (1 / np.where(view.prior > 0, view.prior, np.inf) - inverse[0]) / (inverse[1] - inverse[0])
    away = np.abs(expected[..., None] - np.arange(PLANES)).astype(np.float32)
    volume += np.where(view.prior[..., None] > 0, np.minimum(_PRIOR_COST[0] * away, _PRIOR_COST[1]), 0).astype(
        np.float32
    )
    total = semi_global(volume, view.grey)
    return 1 / _between_planes(total, inverse)


def plane_depths(prior: np.ndarray) -> np.ndarray:
    """[PLANES] inverse depths, near to far, covering the prior's range with a margin."""
    near, far = np.percentile(prior[prior > 0], [1, 99])
    return np.linspace(1 / (0.75 * near), 1 / (1.35 * far), PLANES).astype(np.float32)


def matching_cost(view: StereoView, others: list[StereoView], inverse: np.ndarray) -> np.ndarray:
    """[h, w, PLANES] float32 in [0, 1]: (1 − mean of the _BEST best correlations with `others`) / 2."""
    import cv2

    h, w = view.grey.shape
    volume = np.empty((h, w, len(inverse)), np.float32)
    box = (_WINDOW, _WINDOW)
    mean = cv2.blur(view.grey, box)
    deviation = np.sqrt(np.maximum(cv2.blur(view.grey * view.grey, box) - mean * mean, 0)) + 1.0
    warps = [homographies(view, other) for other in others]
    for plane, one_over_z in enumerate(inverse):
        scores = np.empty((len(others), h, w), np.float32)
        for score, other, (still, moving) in zip(scores, others, warps, strict=True):
            seen = cv2.warpPerspective(
                other.grey, still + one_over_z * moving, (w, h), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
                borderMode=cv2.BORDER_CONSTANT, borderValue=-1000.0,
            )  # fmt: skip
            seen_mean = cv2.blur(seen, box)
            spread = np.sqrt(np.maximum(cv2.blur(seen * seen, box) - seen_mean * seen_mean, 0)) + 1.0
            score[:] = (cv2.blur(seen * view.grey, box) - seen_mean * mean) / (spread * deviation)
            score[seen_mean < 0] = 0.0  # outside the image: no evidence
        best = min(_BEST, len(others))
        chosen = np.partition(scores, len(others) - best, axis=0)[-best:]
        volume[..., plane] = 0.5 - 0.5 * chosen.mean(axis=0)
    return volume


def homographies(view: StereoView, other: StereoView) -> tuple[np.ndarray, np.ndarray]:
    """(A, B): A + B / z maps pixels of `view` to `other` for the plane at depth z; pixel centres at +0.5."""
    other_from_view = other.camera_from_world @ np.linalg.inv(view.camera_from_world)
    half = np.array([[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1.0]])  # OpenCV's pixel centres are at whole numbers
    inverse_K = np.linalg.inv(half @ view.K)
    still = half @ other.K @ other_from_view[:3, :3] @ inverse_K
    moving = half @ other.K @ np.outer(other_from_view[:3, 3], [0, 0, 1.0]) @ inverse_K
    return still, moving


def semi_global(volume: np.ndarray, grey: np.ndarray) -> np.ndarray:
    """[h, w, D] sums over the directions r = left, right, up, down of the path costs (Hirschmüller 2008, eq. 13):

    L_r(p, d) = C(p, d) + min(L_r(q, d), L_r(q, d ± 1) + P1, min_k L_r(q, k) + P2(p, q)) − min_k L_r(q, k),   q = p − r

    volume: C [h, w, D]; grey: [h, w], whose gradient lowers P2.
    """
    total = np.zeros_like(volume)
    for axis in (0, 1):
        step = np.abs(np.diff(grey, axis=axis))
        large = np.maximum(_P2 / (1 + step / 8), 1.5 * _P1).astype(np.float32)
        costs, sums = np.moveaxis(volume, axis, 0), np.moveaxis(total, axis, 0)
        jumps = np.moveaxis(large, axis, 0)[..., None]
        for order in (range(1, len(costs)), range(len(costs) - 2, -1, -1)):
            path = costs[0 if order.step > 0 else -1].copy()
            sums[0 if order.step > 0 else -1] += path
            for i in order:
                least = path.min(axis=1, keepdims=True)
                best = np.minimum(path, least + jumps[i - 1 if order.step > 0 else i])
                np.minimum(best[:, 1:], path[:, :-1] + _P1, out=best[:, 1:])
                np.minimum(best[:, :-1], path[:, 1:] + _P1, out=best[:, :-1])
                path = costs[i] + best - least
                sums[i] += path
    return total


def _between_planes(total: np.ndarray, inverse: np.ndarray) -> np.ndarray:
    """[h, w] inverse depth at the vertex of the parabola through the cheapest plane and its two neighbours."""
    best = np.clip(total.argmin(axis=2), 1, len(inverse) - 2)[..., None]
    low, mid, high = (np.take_along_axis(total, best + d, axis=2)[..., 0] for d in (-1, 0, 1))
    curvature = low - 2 * mid + high
    shift = np.clip(np.where(curvature > 1e-6, 0.5 * (low - high) / np.maximum(curvature, 1e-6), 0), -0.5, 0.5)
    return inverse[best[..., 0]] + shift * (inverse[1] - inverse[0])


def choose_neighbours(views: list[StereoView]) -> list[list[int]]:
    """Up to NEIGHBOURS other views per view that jointly observe its points, preferably at angles of 5° to 25°."""
    chosen: list[list[int]] = []
    for i, view in enumerate(views):
        points = _sample(view)
        useful = np.stack([_usefulness(view, other, points) for other in views])
        useful[i] = 0
        first = second = np.zeros(len(points))  # usefulness of the best two chosen views for each point
        found: list[int] = []
        while len(found) < min(NEIGHBOURS, len(views) - 1):
            gain = np.maximum(useful, first) + np.clip(np.minimum(useful, first), second, None) - first - second
            gain = gain.mean(axis=1)
            gain[found] = -1
            best = int(gain.argmax())
            if gain[best] < 1e-3:
                break
            found.append(best)
            second = np.maximum(second, np.minimum(useful[best], first))
            first = np.maximum(first, useful[best])
        chosen.append(found)
    return chosen


def _sample(view: StereoView, every: int = 24) -> np.ndarray:
    """[P, 3] world points of a coarse grid of pixels."""
    y, x = np.mgrid[every // 2 : view.prior.shape[0] : every, every // 2 : view.prior.shape[1] : every]
    z = view.prior[y, x]
    rays = np.stack([x + 0.5, y + 0.5, np.ones(x.shape)], axis=-1) @ np.linalg.inv(view.K).T
    points = (rays * z[..., None])[z > 0]
    return (points - view.camera_from_world[:3, 3]) @ view.camera_from_world[:3, :3]


def _usefulness(view: StereoView, other: StereoView, points: np.ndarray) -> np.ndarray:
    """[P] in [0, 1]: 0 where `other` does not see a point, else a weight from ray angle and distance ratio."""
    local = points @ other.camera_from_world[:3, :3].T + other.camera_from_world[:3, 3]
    z = np.maximum(local[:, 2], 1e-9)
    pixel = local @ other.K.T / z[:, None]
    h, w = other.grey.shape
    inside = (local[:, 2] > 0) & (pixel[:, 0] > 0) & (pixel[:, 1] > 0) & (pixel[:, 0] < w) & (pixel[:, 1] < h)
    a, b = points - view.center, points - other.center
    cosine = (a * b).sum(axis=1) / np.maximum(np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1), 1e-12)
    angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    width = np.where(angle < 12, 5.0, 10.0)
    closeness = np.linalg.norm(b, axis=1) / np.maximum(np.linalg.norm(a, axis=1), 1e-12)
    alike = np.minimum(closeness, 1 / np.maximum(closeness, 1e-12))  # at twice the distance the resolution is half
    return np.asarray(inside * alike * np.exp(-(((angle - 12) / width) ** 2) / 2))


def confirmed(
    depth: np.ndarray, view: StereoView, others: list[StereoView], their_depths: list[np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Number of `others` that agree with each depth [h, w] int32, and the mean [h, w] of it and the agreeing depths."""
    h, w = depth.shape
    y, x = np.mgrid[:h, :w]
    rays = np.stack([x + 0.5, y + 0.5, np.ones((h, w))], axis=-1) @ np.linalg.inv(view.K).T
    world = (rays * depth[..., None] - view.camera_from_world[:3, 3]) @ view.camera_from_world[:3, :3]
    count, ratios = np.zeros((h, w), np.int32), np.ones((h, w))
    for other, theirs in zip(others, their_depths, strict=True):
        local = world @ other.camera_from_world[:3, :3].T + other.camera_from_world[:3, 3]
        z = np.maximum(local[..., 2], 1e-9)
        pixel = np.floor(local @ other.K.T / z[..., None])[..., :2]
        inside = (local[..., 2] > 0) & (pixel >= 0).all(axis=-1) & (pixel < np.array(theirs.shape[::-1])).all(axis=-1)
        column, row = (np.where(inside, pixel[..., i], 0).astype(np.int64) for i in (0, 1))
        ratio = theirs[row, column] / z  # for similar view directions, both depths scale by the same ratio
        agrees = inside & (np.abs(ratio - 1) < _AGREE)
        count += agrees
        ratios += np.where(agrees, ratio, 0)
    return count, (depth * ratios / (1 + count)).astype(np.float32)
