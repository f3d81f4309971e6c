"""The compiled plane sweep against a plain float64 one, on photos of a textured plane seen from several places."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

_core = pytest.importorskip("perception._core")
FIRST, STEP, PLANES = 1.0, -0.02, 32


def texture(height: int, width: int, shift: tuple[float, float], contrast: float = 40) -> np.ndarray:
    """[height, width] uint8: waves that move with `shift` in pixels."""
    waves = np.random.default_rng(5).normal(0, 0.5, (2, 30))
    y, x = np.mgrid[:height, :width]
    phase = (x - shift[0])[..., None] * waves[0] + (y - shift[1])[..., None] * waves[1]
    return np.rint(128 + contrast * np.cos(phase + np.arange(30)).mean(axis=-1) * 3).clip(0, 255).astype(np.uint8)


def scene(height: int, width: int, neighbours: int, contrast: float = 40) -> dict[str, Any]:
    """A plane at inverse depth 0.7, neighbours of unequal sizes; the first maps turn and tilt the picture a little."""
    moves = [(9.0, 3.0), (-7.0, 5.0), (2.0, -11.0)][:neighbours]
    others, maps = [], np.zeros((neighbours, 2, 3, 3))
    for i, (a, b) in enumerate(moves):
        maps[i] = np.eye(3), [[0, 0, a], [0, 0, b], [0, 0, 0]]
        maps[i, 0, 2, 0] = (1e-4, 0, -0.03)[i]  # the third camera has a part of the photo behind it
        others.append(texture(height + 2 * i, width + 3 * i, (0.7 * a, 0.7 * b), contrast))
    y, x = np.mgrid[:height, :width]
    prior = (1.4 + 0.1 * np.sin(x / 5) * np.cos(y / 4)).astype(np.float32)
    prior[:, : width // 3] = 0
    return {"photo": texture(height, width, (0, 0), contrast), "others": others, "homographies": maps, "prior": prior}


def swept(given: dict[str, Any], **how: Any) -> np.ndarray:
    depth = np.zeros_like(given["prior"])
    _core.plane_sweep(**given, first=FIRST, step=STEP, planes=PLANES, depth=depth, **how)
    return depth


def windows(image: np.ndarray) -> np.ndarray:
    """[h, w, 7, 7]: the pixels around each, mirrored at the border."""
    padded = image  # numpy mirrors an image of one or two pixels as often as it takes
    for axis in (0, 1):
        index = np.pad(np.arange(image.shape[axis]), 3, "reflect" if image.shape[axis] > 1 else "edge")
        padded = np.take(padded, index, axis)
    return np.lib.stride_tricks.sliding_window_view(padded, (7, 7))


def correlation(photo: np.ndarray, other: np.ndarray, homography: np.ndarray) -> np.ndarray:
    """[h, w] zero-mean normalised cross-correlation, 1 grey value added to both deviations; 0 = window not seen."""
    y, x = np.mgrid[: photo.shape[0], : photo.shape[1]]
    u, v, scale = np.einsum("ij,jhw->ihw", homography, np.stack([x, y, np.ones_like(x)]))
    rows, columns = other.shape
    u, v = u / scale, v / scale
    seen = (scale > 1e-6) & (u >= 0) & (v >= 0) & (u <= columns - 1) & (v <= rows - 1)
    u, v = np.where(seen, u, 0), np.where(seen, v, 0)
    i, j = u.astype(int), v.astype(int)
    right, below = np.minimum(i + 1, columns - 1), np.minimum(j + 1, rows - 1)
    upper, lower = (other[k, i] + (u - i) * (other[k, right] - other[k, i]) for k in (j, below))
    a, b = windows(photo), windows(upper + (v - j) * (lower - upper))
    shared = (a * b).mean(axis=(2, 3)) - a.mean(axis=(2, 3)) * b.mean(axis=(2, 3))
    return np.where(windows(seen).all(axis=(2, 3)), shared / ((a.std(axis=(2, 3)) + 1) * (b.std(axis=(2, 3)) + 1)), 0)


def summed_paths(costs: np.ndarray, photo: np.ndarray) -> np.ndarray:
    """[h, w, PLANES] path costs from the four sides, every way from plane to plane tried."""
    total, steps = np.zeros_like(costs), np.abs(np.arange(PLANES)[:, None] - np.arange(PLANES))
    for turns in range(4):
        cost, grey, sums = (np.rot90(image, turns) for image in (costs, photo, total))
        for y in range(cost.shape[0]):
            path = cost[y, 0]
            sums[y, 0] += path
            for x in range(1, cost.shape[1]):
                large = max(0.6 / (1 + abs(grey[y, x] - grey[y, x - 1]) / 8), 0.09)
                price = np.where(steps == 0, 0, np.where(steps == 1, 0.06, large))
                path = cost[y, x] + (path[None] + price).min(axis=1) - path.min()
                sums[y, x] += path
    return total


def costs_of(given: dict[str, Any]) -> np.ndarray:
    """[h, w, PLANES] summed path costs."""
    photo, prior = given["photo"].astype(float), given["prior"].astype(float)
    index = (1 / np.where(prior > 0, prior, np.inf) - FIRST) / STEP
    costs = np.empty((*photo.shape, PLANES))
    for plane in range(PLANES):
        maps = [still + (FIRST + STEP * plane) * moving for still, moving in given["homographies"]]
        pairs = zip(given["others"], maps, strict=True)
        scores = np.sort([correlation(photo, other.astype(float), homography) for other, homography in pairs], axis=0)
        away = np.where(prior > 0, np.minimum(0.02 * np.abs(index - plane), 0.16), 0)
        costs[..., plane] = (1 - scores[-2:].mean(axis=0)) / 2 + away
    return summed_paths(costs, photo)


@pytest.mark.parametrize("size", [(43, 37, 3), (9, 50, 2), (20, 6, 1), (1, 2, 1)])
def test_depth_against_brute_force(size):
    given = scene(*size)
    total = costs_of(given)
    best = np.clip(total.argmin(axis=-1), 1, PLANES - 2)
    low, mid, high = (np.take_along_axis(total, best[..., None] + d, -1)[..., 0] for d in (-1, 0, 1))
    curvature = low - 2 * mid + high
    vertex = best + np.clip(0.5 * (low - high) / np.where(curvature > 1e-3, curvature, np.inf), -0.5, 0.5)
    for level in _core.simd_levels():
        depth = swept(given, level=level)
        found = (1 / depth.astype(float) - FIRST) / STEP
        chosen = np.clip(np.rint(found).astype(int), 1, PLANES - 2)
        excess = np.take_along_axis(total, chosen[..., None], -1)[..., 0] - np.minimum(mid, total.min(axis=-1))
        inner = best == total.argmin(axis=-1)
        assert excess[inner].max(initial=0) < 0.01  # of costs of about 4
        alike = (chosen == best) & (curvature > 0.02)
        error = np.abs(found - vertex)[alike]
        assert (error * curvature[alike]).max(initial=0) < 0.01 and np.quantile(error, 0.9, method="lower") < 0.02
        assert (chosen == best).mean() > 0.95  # the others lie midway between two planes


def test_any_number_of_threads_gives_the_same_bits():
    given = scene(43, 37, 3)
    for level in _core.simd_levels():
        depths = [swept(given, level=level, threads=threads).tobytes() for threads in (1, 2, 7)]
        assert len(set(depths)) == 1


def test_photos_without_texture_keep_the_prior():
    given = scene(40, 60, 3, contrast=0)
    depth, known = swept(given), given["prior"] > 0
    assert np.isfinite(depth).all()
    known[:, : 60 // 3 + 8] = False  # next to where there is none, the smoothness decides
    assert np.abs(depth[known] / given["prior"][known] - 1).max() < 0.1


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("others", []),
        ("others", [np.zeros((3, 0), np.uint8)] * 3),
        ("homographies", np.full((3, 2, 3, 3), np.nan)),
        ("homographies", np.zeros((2, 2, 3, 3))),
        ("prior", np.zeros((9, 11), np.float32)),
        ("photo", np.zeros((9, 11), np.uint8)),
    ],
)
def test_wrong_arguments_are_named(name, value):
    with pytest.raises(ValueError, match=name):
        swept({**scene(10, 11, 3), name: value})
