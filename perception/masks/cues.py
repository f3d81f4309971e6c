"""Features of pixels that tell borders of objects: colour and texture of the photo, steps and creases of depth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

_REACH = 4  # pixels to either side over which steps and creases are measured
_BINS = (4, 6, 6)  # of L, a, b
COLOUR_BINS = 4 * 6 * 6


@dataclass(frozen=True)
class PhotoCues:
    """lab: [h, w, 3], 8-bit scale; texture (log gradient), edge (gradient, σ = 2), colour_bin: [h, w]."""

    lab: np.ndarray
    texture: np.ndarray
    edge: np.ndarray
    colour_bin: np.ndarray


@dataclass(frozen=True)
class DepthCues:
    """The surface seen in each pixel, camera frame, float32: points, normals [h, w, 3] (facing the camera).

    step: [2, h, w] how far the surface jumps across the pixel, in units of its depth; bend: [2, h, w] > 0
    convex, < 0 concave, cosine-like. Index 0 looks along x, index 1 along y.
    """

    points: np.ndarray
    normals: np.ndarray
    step: np.ndarray
    bend: np.ndarray


def photo_cues(photo: np.ndarray) -> PhotoCues:
    """photo: [h, w, 3] uint8 RGB."""
    import cv2

    lab = cv2.cvtColor(photo, cv2.COLOR_RGB2LAB).astype(np.float32)
    fine = cv2.GaussianBlur(lab, (0, 0), 1.0)
    edge = 2.0 * _gradient(cv2.GaussianBlur(lab, (0, 0), 2.0))
    return PhotoCues(lab, np.log1p(_gradient(fine)), edge, _colour_bins(fine))


def depth_cues(depth: np.ndarray, K: np.ndarray) -> DepthCues:
    """depth: [h, w] z-depth in any unit, 0 or not finite = none (filled in); K: [3, 3]."""
    import cv2

    z = cv2.medianBlur(filled_depth(depth), 5)
    z = np.exp(cv2.bilateralFilter(np.log(z), 9, 0.03, 4))  # smooths noise, keeps steps of more than 3 %
    points = _unproject(z, K)
    normals = np.cross(_tangent(points, 1), _tangent(points, 0))
    normals = cv2.ximgproc.jointBilateralFilter(np.log(z), _unit(normals).astype(np.float32), 9, 0.02, 4)
    normals = _unit(normals).astype(np.float32)
    across = [_across(points, normals, axis) for axis in (0, 1)]
    step, bend = (np.stack([pair[i] for pair in across]) for i in (0, 1))
    return DepthCues(points, normals, step, bend)


def _gradient(image: np.ndarray) -> np.ndarray:
    """[h, w] gradient length over all channels, per pixel."""
    import cv2

    x, y = cv2.Sobel(image, -1, 1, 0) / 8, cv2.Sobel(image, -1, 0, 1) / 8
    return np.sqrt((x * x + y * y).sum(axis=-1))


def _colour_bins(lab: np.ndarray) -> np.ndarray:
    """[h, w] int64 index of a coarse Lab bin; values beyond ±50 of a and b count to the last bin."""
    scaled = [lab[..., 0] / 256, (lab[..., 1] - 128) / 100 + 0.5, (lab[..., 2] - 128) / 100 + 0.5]
    index = np.zeros(lab.shape[:2], np.int64)
    for value, bins in zip(scaled, _BINS, strict=True):
        index = index * bins + np.clip(value * bins, 0, bins - 1).astype(np.int64)
    return index


def filled_depth(depth: np.ndarray) -> np.ndarray:
    """[h, w] float32 > 0: pixels without depth take that of the nearest pixel that has one."""
    from scipy.ndimage import distance_transform_edt

    known = np.isfinite(depth) & (depth > 0)
    if known.all():
        return depth.astype(np.float32)
    nearest = distance_transform_edt(~known, return_distances=False, return_indices=True)
    return depth[tuple(nearest)].astype(np.float32)


def _unproject(z: np.ndarray, K: np.ndarray) -> np.ndarray:
    y, x = np.mgrid[: z.shape[0], : z.shape[1]].astype(np.float32) + np.float32(0.5)
    return np.stack([(x - K[0, 2]) / K[0, 0] * z, (y - K[1, 2]) / K[1, 1] * z, z], axis=-1).astype(np.float32)


def _tangent(points: np.ndarray, axis: int, reach: int = 3) -> np.ndarray:
    """[h, w, 3] along x (axis 0) or y (axis 1): central where smooth, else of the side with less change."""
    along = 1 - axis
    chord = np.take(points, range(reach, points.shape[along]), along)
    chord = chord - np.take(points, range(points.shape[along] - reach), along)
    ahead, behind = (
        np.pad(chord, [side if i == along else (0, 0) for i in range(3)], "edge") for side in ((0, reach), (reach, 0))
    )
    one_sided = np.where(np.abs(ahead[..., 2:]) <= np.abs(behind[..., 2:]), ahead, behind)
    smooth = np.abs(ahead[..., 2:] - behind[..., 2:]) < 0.01 * points[..., 2:]
    return np.where(smooth, (ahead + behind) / 2, one_sided)


def _across(points: np.ndarray, normals: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray]:
    """Step and bend over ±_REACH pixels, each [h, w]."""
    a, b = (_shifted(points, axis, d) for d in (-_REACH, _REACH))
    normal_a, normal_b = (_shifted(normals, axis, d) for d in (-_REACH, _REACH))
    chord = b - a
    off_a, off_b = (np.abs((normal * chord).sum(axis=-1)) for normal in (normal_a, normal_b))
    bend = ((normal_b - normal_a) * chord).sum(axis=-1) / (np.linalg.norm(chord, axis=-1) + 1e-9)
    return np.minimum(off_a, off_b) / points[..., 2], bend


def _shifted(image: np.ndarray, axis: int, by: int) -> np.ndarray:
    """image[y, x + by] (axis 0) or image[y + by, x] (axis 1), the border repeated."""
    along = 1 - axis
    index = np.clip(np.arange(image.shape[along]) + by, 0, image.shape[along] - 1)
    return np.take(image, index, axis=along)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / (np.linalg.norm(vectors, axis=-1, keepdims=True) + 1e-12)
