"""`sam:PATH`: automatic mask generation with Segment Anything (Kirillov et al. 2023, app. B) in onnxruntime.

A grid of points prompts the model. Masks are filtered by predicted IoU, by stability, and by non-maximum suppression.
Rules and defaults are those of the published `SamAutomaticMaskGenerator` without crops, as used in the paper (§4).
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from perception.masks.sam_models import SamModel, open_sam
from perception.types import View

POINTS_PER_BATCH = 64
STABILITY_OFFSET = 1.0  # added to and subtracted from the logit threshold
BOX_NMS = 0.7  # box IoU above which two masks are duplicates
_BATCH_BYTES = 512 << 20  # masks of one batch; some graphs return them at full size


@dataclass(frozen=True)
class SamSettings:
    """points_per_side: of the prompt grid. pred_iou, stability: minimum values of a mask."""

    points_per_side: int = 32
    pred_iou: float = 0.88
    stability: float = 0.95


@dataclass(frozen=True)
class SamMask:
    """A mask of a photo. packed: its bits, compressed with deflate; shape: (h, w); box: [4] int64, see `mask_box`;
    pred_iou: IoU predicted by the model; point: [2] (x, y), the prompt in pixels."""

    packed: bytes
    shape: tuple[int, int]
    box: np.ndarray
    pred_iou: np.float32
    stability: np.float32
    point: np.ndarray

    def pixels(self) -> np.ndarray:
        """[h, w] bool."""
        bits = np.frombuffer(zlib.decompress(self.packed), np.uint8)
        return np.unpackbits(bits, count=self.shape[0] * self.shape[1]).reshape(self.shape).astype(bool)


class SamSource:
    """The mask source of `sam:PATH`. The constructor opens the models and checks their signatures."""

    def __init__(self, spec: str) -> None:
        self.model = open_sam(spec)
        self.settings = SamSettings()
        self.name = f"sam ({self.model.family}, {self.model.provider})"
        self.identity = f"sam {self.model.fingerprint} {self.settings}"

    def check(self, views: list[View]) -> list[str]:
        """Returns warnings about an accelerator that could not be loaded."""
        return list(self.model.warnings)

    def label_image(self, view: View, photo: np.ndarray) -> np.ndarray:
        """photo: [h, w, 3] uint8 RGB. Returns [h, w] int32, 0 where there is no mask."""
        return paint(automatic_masks(self.model, photo, self.settings), (photo.shape[0], photo.shape[1]))


def automatic_masks(model: SamModel, photo: np.ndarray, settings: SamSettings) -> list[SamMask]:
    """Masks of photo [h, w, 3] uint8 RGB, sorted by falling predicted IoU."""
    height, width = photo.shape[:2]
    embedding = model.encode(np.ascontiguousarray(photo))
    points = point_grid(settings.points_per_side) * np.array([width, height])
    step = max(1, min(POINTS_PER_BATCH, _BATCH_BYTES // (width * height * 4 * 4)))
    found: list[SamMask] = []
    for start in range(0, len(points), step):
        found += _good_masks(model, embedding, points[start : start + step], settings)
    boxes, scores = (np.array([getattr(mask, name) for mask in found]) for name in ("box", "pred_iou"))
    return [found[row] for row in box_nms(boxes.reshape(-1, 4), scores, BOX_NMS)]


def paint(masks: list[SamMask], shape: tuple[int, int]) -> np.ndarray:
    """Label image [h, w] int32. Masks are painted by ascending pred_iou · stability: the best one gets a pixel (§4)."""
    labels = np.zeros(shape, np.int32)
    scores = np.array([mask.pred_iou * mask.stability for mask in masks])
    for label, row in enumerate(np.argsort(scores, kind="stable"), start=1):
        labels[masks[row].pixels()] = label
    return labels


def point_grid(side: int) -> np.ndarray:
    """[side², 2] float64 (x, y) in (0, 1), row by row, at the centres of an even grid."""
    centres = np.linspace(1 / (2 * side), 1 - 1 / (2 * side), side)
    x, y = np.meshgrid(centres, centres)
    return np.stack([x.ravel(), y.ravel()], axis=1)


def stability(logits: np.ndarray) -> np.float32:
    """IoU of the masks of `logits` [h, w] thresholded at ± STABILITY_OFFSET, in float32; NaN where both are empty."""
    inner, outer = (np.count_nonzero(logits > offset) for offset in (STABILITY_OFFSET, -STABILITY_OFFSET))
    return np.float32(inner) / np.float32(outer) if outer else np.float32(math.nan)


def mask_box(mask: np.ndarray) -> np.ndarray:
    """mask: [h, w] bool. [4] int64 (x0, y0, x1, y1) in pixels, ends inclusive; all zero for an empty mask."""
    columns, rows = np.flatnonzero(mask.any(axis=0)), np.flatnonzero(mask.any(axis=1))
    if not len(rows):
        return np.zeros(4, np.int64)
    return np.array([columns[0], rows[0], columns[-1], rows[-1]], np.int64)


def box_nms(boxes: np.ndarray, scores: np.ndarray, threshold: float) -> np.ndarray:
    """Greedy non-maximum suppression. Returns the kept indices, best score first; ties keep the input order.

    boxes: [M, 4], scores: [M]. IoU in float32 with areas (x1 − x0)(y1 − y0), as in torchvision.
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


def _good_masks(model: SamModel, embedding: Any, points: np.ndarray, settings: SamSettings) -> Iterator[SamMask]:
    """Masks for points [P, 2] that pass both thresholds. One mask at a time is upscaled to the photo's size."""
    raw, pred_iou = model.decode(embedding, points)
    for point, which in np.argwhere(pred_iou > settings.pred_iou):
        logits = model.upscale(embedding, raw[point, which])
        stable = stability(logits)
        if stable >= np.float32(settings.stability):  # compared in float32, as published; false for NaN
            mask = logits > 0
            packed = zlib.compress(np.packbits(mask).tobytes(), 1)
            shape = (mask.shape[0], mask.shape[1])
            yield SamMask(packed, shape, mask_box(mask), pred_iou[point, which], stable, points[point])
