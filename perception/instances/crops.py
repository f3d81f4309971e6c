"""Selection of photos per instance, and the image crops for the encoder (§3.2.2, eq. 10).

    s_vi = (mask pixels of i in v / pixels of v) · (Gaussians of i visible in v / Gaussians of i)

The K views with the largest s_vi are kept. Each gives L square crops with growing margins (K = 5, L = 3 in the paper).
Views of different directions, and dimmed or blurred backgrounds, gained nothing over 211 prompts.
"""

from __future__ import annotations

import cv2
import numpy as np
from scipy import sparse

from perception.language.description import Box

EXPANSION = 0.3  # margin added per level, relative to the box's sides (OpenMask3D)
FILL = 127  # grey value of the padding: mid-range, near zero after any encoder's normalisation


def view_scores(mask_pixels: np.ndarray, image_pixels: np.ndarray, visible_fraction: np.ndarray) -> np.ndarray:
    """s_vi [I, V], or [L] of some pairs of both; visible_fraction: in [0, 1]. Arrays of this shape, or [V]."""
    return np.asarray(mask_pixels, np.float64) / np.asarray(image_pixels, np.float64) * visible_fraction


def choose_views(scores: np.ndarray | sparse.coo_matrix, k: int = 5) -> list[np.ndarray]:
    """The k views with the highest score of each instance, best first: I arrays of at most k view indices, int64.

    scores: [I, V] ≥ 0, dense or sparse. Views with score 0 are never chosen; of equal ones the first.
    """
    table = sparse.csr_matrix(scores)
    table.sort_indices()
    runs = (slice(*table.indptr[row : row + 2]) for row in range(table.shape[0]))
    return [table.indices[run][np.argsort(-table.data[run], kind="stable")[:k]].astype(np.int64) for run in runs]


def mask_box(mask: np.ndarray) -> Box | None:
    """Bounding box (x0, y0, x1, y1) in pixels, x1 and y1 exclusive, of a boolean mask [H, W]; None if it is empty."""
    x, y, width, height = cv2.boundingRect(mask.astype(np.uint8))
    return (x, y, x + width, y + height) if width else None


def expand_box(box: Box, ratio: float, width: int, height: int) -> Box:
    """The box enlarged by `ratio` of its sides at either end, clipped to the image."""
    x0, y0, x1, y1 = box
    dx, dy = round((x1 - x0) * ratio), round((y1 - y0) * ratio)
    return max(0, x0 - dx), max(0, y0 - dy), min(width, x1 + dx), min(height, y1 + dy)


def letterbox(image: np.ndarray) -> np.ndarray:
    """Pads an image [H, W, 3] to a square of side max(H, W), centred, without scaling."""
    rows, columns = (max(image.shape[:2]) - side for side in image.shape[:2])  # to be added
    ends = rows // 2, rows - rows // 2, columns // 2, columns - columns // 2
    return cv2.copyMakeBorder(image, *ends, cv2.BORDER_CONSTANT, value=(FILL,) * 3)


def crop_levels(photo: np.ndarray, mask: np.ndarray, levels: int = 3) -> list[np.ndarray]:
    """`levels` square crops [S, S, 3] uint8 around a mask [H, W], level l with margin l · EXPANSION; [] if empty."""
    box = mask_box(mask)
    if box is None:
        return []
    height, width = mask.shape
    boxes = (expand_box(box, level * EXPANSION, width, height) for level in range(levels))
    return [letterbox(photo[y0:y1, x0:x1]) for x0, y0, x1, y1 in boxes]
