"""Steps of Segment Anything's automatic masks that need no model: grids, crops, filters, box NMS, packing.

The rules are those of Kirillov et al. 2023 (appendix B) as implemented by `SamAutomaticMaskGenerator`. Boxes
are [x0, y0, x1, y1] in pixels, both ends inclusive, as there.
"""

from __future__ import annotations

import math
import zlib
from dataclasses import dataclass

import numpy as np

Box = tuple[int, int, int, int]


def point_grid(side: int) -> np.ndarray:
    """[side², 2] float64 (x, y) in (0, 1), row by row, at the centres of an even grid."""
    centres = np.linspace(1 / (2 * side), 1 - 1 / (2 * side), side)
    x, y = np.meshgrid(centres, centres)
    return np.stack([x.ravel(), y.ravel()], axis=1)


def crop_boxes(height: int, width: int, layers: int, overlap_ratio: float) -> list[tuple[Box, int]]:
    """(x0, y0, x1, y1), ends exclusive, and layer of every crop: the image, then (2^i)² crops in layer i."""
    boxes: list[tuple[Box, int]] = [((0, 0, width, height), 0)]
    for layer in range(1, layers + 1):
        n = 2**layer
        overlap = int(overlap_ratio * min(height, width) * (2 / n))
        w, h = (math.ceil((overlap * (n - 1) + length) / n) for length in (width, height))
        for i in range(n):
            for j in range(n):
                x0, y0 = (w - overlap) * i, (h - overlap) * j
                boxes.append(((x0, y0, min(x0 + w, width), min(y0 + h, height)), layer))
    return boxes


def stability(logits: np.ndarray, offset: float, threshold: float = 0.0) -> np.float32:
    """logits: [h, w]. IoU of the masks cut at threshold ± offset, in float32; NaN where both are empty."""
    inner, outer = (np.count_nonzero(logits > threshold + d) for d in (offset, -offset))
    return np.float32(inner) / np.float32(outer) if outer else np.float32(math.nan)


def mask_box(mask: np.ndarray) -> np.ndarray:
    """mask: [h, w] bool. [4] int64, all zero for an empty mask."""
    columns, rows = np.flatnonzero(mask.any(axis=0)), np.flatnonzero(mask.any(axis=1))
    if not len(rows):
        return np.zeros(4, np.int64)
    return np.array([columns[0], rows[0], columns[-1], rows[-1]], np.int64)


def touches_crop(box: np.ndarray, crop: Box, height: int, width: int, tolerance: int = 20) -> bool:
    """box: [4] in the crop. Whether a side lies at a border of the crop that is not the image's."""
    whole = box + np.array([crop[0], crop[1], crop[0], crop[1]])
    at_crop = np.abs(whole - np.array(crop)) <= tolerance
    at_image = np.abs(whole - np.array([0, 0, width, height])) <= tolerance
    return bool((at_crop & ~at_image).any())


def box_nms(boxes: np.ndarray, scores: np.ndarray, threshold: float) -> np.ndarray:
    """Greedy non-maximum suppression: indices kept, best score first, ties in input order.

    boxes: [M, 4], scores: [M]. IoU in float32 with areas (x1 − x0)(y1 − y0), as torchvision computes it.
    """
    x0, y0, x1, y1 = boxes.astype(np.float32).T
    areas = (x1 - x0) * (y1 - y0)
    order = np.argsort(-scores, kind="stable")
    keep = []
    while len(order):
        first, rest = order[0], order[1:]
        keep.append(first)
        w = np.minimum(x1[first], x1[rest]) - np.maximum(x0[first], x0[rest])
        h = np.minimum(y1[first], y1[rest]) - np.maximum(y0[first], y0[rest])
        shared = w.clip(min=0) * h.clip(min=0)
        with np.errstate(invalid="ignore"):
            iou = shared / (areas[first] + areas[rest] - shared)
        order = rest[~(iou.astype(np.float64) > threshold)]
    return np.array(keep, dtype=np.int64)


def clean_mask(mask: np.ndarray, smallest: int) -> tuple[np.ndarray, bool]:
    """Fills holes and drops islands under `smallest` pixels (8-neighbours); the largest island always stays.

    mask: [h, w] bool. Returns the mask and whether it changed.
    """
    filled, had_holes = _without_small(mask, smallest, holes=True)
    cleaned, had_islands = _without_small(filled, smallest, holes=False)
    return cleaned, had_holes or had_islands


def _without_small(mask: np.ndarray, smallest: int, holes: bool) -> tuple[np.ndarray, bool]:
    import cv2

    count, regions, stats, _ = cv2.connectedComponentsWithStats((mask ^ holes).astype(np.uint8), connectivity=8)
    areas = stats[1:, cv2.CC_STAT_AREA]
    small = np.flatnonzero(areas < smallest) + 1
    if not len(small):
        return mask, False
    if holes:
        return np.isin(regions, [0, *small]), True
    large = np.setdiff1d(np.arange(1, count), small)
    return np.isin(regions, large if len(large) else [int(areas.argmax()) + 1]), True


@dataclass(frozen=True)
class PackedMask:
    """A binary mask as deflated bits: at most an eighth of a byte a pixel, mostly a thousandth."""

    bits: bytes
    shape: tuple[int, int]

    @staticmethod
    def pack(mask: np.ndarray) -> PackedMask:
        """mask: [h, w] bool."""
        return PackedMask(zlib.compress(np.packbits(mask).tobytes(), 1), (mask.shape[0], mask.shape[1]))

    def unpack(self) -> np.ndarray:
        """[h, w] bool."""
        flat = np.unpackbits(np.frombuffer(zlib.decompress(self.bits), np.uint8), count=self.shape[0] * self.shape[1])
        return flat.reshape(self.shape).astype(bool)
