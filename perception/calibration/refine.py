"""Corners of a ChArUco board to a twentieth of a pixel, from the board's known print.

OpenCV refines a corner within the white rim between it and the markers, a few pixels, and that biases it by a tenth of
a pixel. Here a patch of the print around each corner, markers and all, is laid over the picture by the homography of
the corners nearby and moved until it fits (Lucas-Kanade with gain and offset, 4 unknowns).
"""

from __future__ import annotations

import cv2
import numpy as np

_HALF, _SAMPLES = 0.3, 17  # of a square to either side; samples along a side
_NEAR = 1.6  # squares: corners whose homography lays the patch
_ITERATIONS = 8
_MOST = 1.5  # pixels that a corner may move; beyond, the detection stays


def refine(
    picture: np.ndarray,
    board_points: np.ndarray,
    pixels: np.ndarray,
    square: float,
    texture: np.ndarray,
    per_square: float,
    margin: float,
) -> np.ndarray:
    """Refined pixels [N, 2] of board points [N, 3] found at `pixels` in a grey picture.

    texture: the print, `per_square` pixels a square, the board's origin `margin` pixels from its corner.
    """
    image = picture.astype(np.float32)
    slopes = [cv2.Sobel(image, cv2.CV_32F, dx, 1 - dx, ksize=3, scale=1 / 8) for dx in (1, 0)]
    flat = board_points[:, :2].astype(np.float64)
    offsets = np.linspace(-_HALF, _HALF, _SAMPLES) * square
    patch = np.stack(np.meshgrid(offsets, offsets), axis=-1).reshape(-1, 2)
    refined = np.array(pixels, np.float64)
    smooth = {}
    for i, corner in enumerate(flat):
        near = np.abs(flat - corner).max(axis=1) < _NEAR * square
        near = near if near.sum() >= 5 else np.ones(len(flat), bool)
        laid = cv2.findHomography(flat[near], pixels[near].astype(np.float64), 0)[0]
        if laid is None:
            continue
        at = _apply(laid, corner + patch)
        side = np.sqrt(np.abs(_area(laid, corner, square)))
        # The print is seen through a pixel's square: blur it alike, in steps of a quarter octave.
        blur = float(2 ** (np.round(4 * np.log2(max(0.5 * per_square / max(side, 1), 0.3))) / 4))
        if blur not in smooth:
            smooth[blur] = cv2.GaussianBlur(texture.astype(np.float32), (0, 0), blur)
        template = _sample(smooth[blur], (corner + patch) / square * per_square + margin - 0.5)
        moved = _fit(image, slopes, at, template)
        if moved is not None:
            refined[i] = _apply(laid, corner[None])[0] + moved
            if np.linalg.norm(refined[i] - pixels[i]) > _MOST:
                refined[i] = pixels[i]
    return refined


def _fit(image: np.ndarray, slopes: list[np.ndarray], at: np.ndarray, template: np.ndarray) -> np.ndarray | None:
    """The shift [2] that lays picture positions `at` [S, 2] onto what the template shows; None where it slips."""
    inside = (at.min(axis=0) > 2).all() and (at.max(axis=0) < np.array(image.shape[::-1]) - 3).all()
    if not inside:
        return None
    shift = np.zeros(2)
    for _ in range(_ITERATIONS):
        here = at + shift
        seen = _sample(image, here)
        columns = np.column_stack([template, np.ones(len(template)), *(-_sample(s, here) for s in slopes)])
        solution = np.linalg.lstsq(columns, seen, rcond=None)[0]
        step = solution[2:]
        shift += step
        if solution[0] <= 0 or np.abs(shift).max() > _MOST:
            return None
        if np.abs(step).max() < 1e-3:
            break
    return shift


def _sample(image: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Bilinear values [S] at positions [S, 2] (x, y), pixel centres at whole numbers."""
    where = np.ascontiguousarray(at, np.float32).reshape(-1, 1, 2)
    return cv2.remap(image, where, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).ravel().astype(np.float64)  # type: ignore[call-overload]


def _apply(homography: np.ndarray, points: np.ndarray) -> np.ndarray:
    mapped = np.column_stack([points, np.ones(len(points))]) @ homography.T
    return np.asarray(mapped[:, :2] / mapped[:, 2:])


def _area(homography: np.ndarray, corner: np.ndarray, square: float) -> float:
    """Signed area in pixels of the parallelogram that a square at `corner` is seen as."""
    base, right, down = _apply(homography, corner + np.array([[0, 0], [square, 0], [0, square]]))
    return float((right - base)[0] * (down - base)[1] - (right - base)[1] * (down - base)[0])
