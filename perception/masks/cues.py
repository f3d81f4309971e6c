"""Pixel features that indicate object borders: colour and texture of the photo, steps and creases of the depth."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.ndimage import distance_transform_edt

_REACH = 4  # pixels to either side, used to measure steps and creases
_SIDE = 3  # pixels ahead and behind, used to measure tangents
_SMOOTH = 0.01  # relative to the depth: steps of both sides that differ by less are of one surface
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
    """Surface geometry per pixel in the camera frame, float32: points, normals [h, w, 3] (normals face the camera).

    step: [2, h, w] depth discontinuity across the pixel, relative to its depth; bend: [2, h, w] cosine-like,
    > 0 convex, < 0 concave. Index 0 is along x, index 1 along y.
    """

    points: np.ndarray
    normals: np.ndarray
    step: np.ndarray
    bend: np.ndarray


def photo_cues(photo: np.ndarray) -> PhotoCues:
    """photo: [h, w, 3] uint8 RGB."""
    lab = cv2.cvtColor(photo, cv2.COLOR_RGB2LAB).astype(np.float32)
    fine = cv2.GaussianBlur(lab, (0, 0), 1.0)
    edge = 2.0 * _gradient(cv2.GaussianBlur(lab, (0, 0), 2.0))
    return PhotoCues(lab, np.log1p(_gradient(fine)), edge, _colour_bins(fine))


def depth_cues(depth: np.ndarray, K: np.ndarray) -> DepthCues:
    """depth: [h, w] z-depth in any unit; 0 or non-finite = none, filled from the nearest pixel. K: [3, 3]."""
    z = cv2.medianBlur(filled_depth(depth), 5)
    z = np.exp(cv2.bilateralFilter(np.log(z), 9, 0.03, 4))  # smooths noise, keeps steps of more than 3 %
    y, x = np.mgrid[: z.shape[0], : z.shape[1]].astype(np.float32) + np.float32(0.5)
    points = np.stack([(x - K[0, 2]) / K[0, 0] * z, (y - K[1, 2]) / K[1, 1] * z, z], axis=-1).astype(np.float32)
    normals = np.cross(_tangent(points, 1), _tangent(points, 0))
    normals = cv2.ximgproc.jointBilateralFilter(np.log(z), _unit(normals).astype(np.float32), 9, 0.02, 4)
    normals = _unit(normals).astype(np.float32)
    across = [_across(points, normals, axis) for axis in (0, 1)]
    step, bend = (np.stack([pair[i] for pair in across]) for i in (0, 1))
    return DepthCues(points, normals, step, bend)


def _gradient(image: np.ndarray) -> np.ndarray:
    """[h, w] gradient magnitude over all channels."""
    x, y = cv2.Sobel(image, -1, 1, 0) / 8, cv2.Sobel(image, -1, 0, 1) / 8
    return np.sqrt(_dot(x, x) + _dot(y, y))


def _colour_bins(lab: np.ndarray) -> np.ndarray:
    """[h, w] int64 index of a coarse Lab bin. Values of a and b beyond ±50 count in the outermost bin."""
    middle, width, first = np.array([[0, 128, 128], [256, 100, 100], [0, 0.5, 0.5]], np.float32)
    bins = np.array(_BINS, np.float32)
    index = np.clip(((lab - middle) / width + first) * bins, 0, bins - 1).astype(np.int64)
    return np.asarray(index @ np.array([_BINS[1] * _BINS[2], _BINS[2], 1]))


def filled(image: np.ndarray, known: np.ndarray) -> np.ndarray:
    """image [h, w] whose pixels outside `known` take the value of the nearest pixel inside."""
    if known.all():
        return image
    return image[tuple(distance_transform_edt(~known, return_distances=False, return_indices=True))]


def filled_depth(depth: np.ndarray) -> np.ndarray:
    """[h, w] float32 > 0. Pixels without depth take the depth of the nearest pixel that has one."""
    return filled(depth, np.isfinite(depth) & (depth > 0)).astype(np.float32)


def _tangent(points: np.ndarray, axis: int) -> np.ndarray:
    """[h, w, 3] tangent along x (axis 0) or y (axis 1): central difference if smooth, else the smaller side's."""
    along = 1 - axis
    first, last = (slice(None),) * along + (slice(-_SIDE),), (slice(None),) * along + (slice(_SIDE, None),)
    chord = points[last] - points[first]
    ahead, behind = (
        np.pad(chord, [side if i == along else (0, 0) for i in range(3)], "edge") for side in ((0, _SIDE), (_SIDE, 0))
    )
    z_ahead, z_behind = ahead[..., 2], behind[..., 2]
    share = (np.abs(z_ahead) <= np.abs(z_behind)).astype(np.float32)
    share[np.abs(z_ahead - z_behind) < _SMOOTH * points[..., 2]] = 0.5
    return behind + share[..., None] * (ahead - behind)


def _across(points: np.ndarray, normals: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray]:
    """Step and bend over ±_REACH pixels, each [h, w]. a, b: the points on both sides, n_a, n_b: their normals.

    chord = b − a   off_a = n_a · chord   off_b = n_b · chord    distance of a point from the other's plane
    step = min(|off_a|, |off_b|) / depth                          on a crease one of them is small
    bend = (off_b − off_a) / |chord|
    """
    a, b = _both_sides(points, axis)
    normal_a, normal_b = _both_sides(normals, axis)
    chord = b - a
    off_a, off_b = _dot(normal_a, chord), _dot(normal_b, chord)
    step = np.minimum(np.abs(off_a), np.abs(off_b)) / points[..., 2]
    return step, (off_b - off_a) / (np.sqrt(_dot(chord, chord)) + 1e-9)


def _both_sides(image: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray]:
    """The values _REACH pixels before and after each pixel along x (axis 0) or y (axis 1), the border replicated."""
    h, w = image.shape[:2]
    padded = np.pad(image, ((_REACH * axis,) * 2, (_REACH * (1 - axis),) * 2, (0, 0)), "edge")
    return padded[:h, :w], padded[-h:, -w:]


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """[h, w] scalar products of vectors [h, w, C]."""
    return np.asarray(np.einsum("hwc,hwc->hw", a, b))


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / (np.sqrt(_dot(vectors, vectors))[..., None] + 1e-12)
