"""Refines corners of a ChArUco board to 0.05 pixels, using the known printed pattern.

OpenCV refines a corner in the few white pixels between it and the markers, which biases it by 0.1 pixels. Here the
pattern around each corner, including markers, is warped into the image by the homography of nearby corners. It is then
aligned by Lucas-Kanade with gain and offset (4 unknowns).
"""

from __future__ import annotations

import cv2
import numpy as np

_HALF, _SAMPLES = 0.3, 17  # half side of the patch in squares; samples along a side
_NEAR = 1.6  # squares: distance of the corners used for the homography
_ITERATIONS = 8
_MOST = 1.5  # pixels: if a corner moves farther, the detection is kept


def refine(
    picture: np.ndarray,
    board_points: np.ndarray,
    pixels: np.ndarray,
    square: float,
    texture: np.ndarray,
    per_square: float,
    margin: float,
) -> np.ndarray:
    """Refined pixels [N, 2] of board points [N, 3] detected at `pixels` in a grey image.

    texture: printed pattern with `per_square` pixels a square; the board's origin is `margin` pixels from its corner.
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
        base, right, down = _apply(laid, corner + np.array([[0, 0], [square, 0], [0, square]]))
        side = np.sqrt(np.abs(np.linalg.det([right - base, down - base])))  # of a square in the image, pixels
        # A pixel averages over its area: the texture is blurred accordingly, in steps of a quarter octave.
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
    """The shift [2] that aligns the image at positions `at` [S, 2] with the template; None if it diverges."""
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
    """Bilinear values [S] at positions [S, 2] (x, y), pixel centres at integers."""
    where = np.ascontiguousarray(at, np.float32).reshape(-1, 1, 2)
    return cv2.remap(image, where, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).ravel().astype(np.float64)  # type: ignore[call-overload]


def _apply(homography: np.ndarray, points: np.ndarray) -> np.ndarray:
    mapped = np.column_stack([points, np.ones(len(points))]) @ homography.T
    return np.asarray(mapped[:, :2] / mapped[:, 2:])
