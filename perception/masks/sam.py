"""`sam:PATH`: automatic mask generation with Segment Anything (Kirillov et al. 2023, app. B) in onnxruntime.

A grid of points prompts the model. Masks are filtered by predicted IoU, by stability, and by non-maximum suppression.
Rules and defaults are those of the published `SamAutomaticMaskGenerator`, used without crops in the paper (§4).

On a CPU nearly all time goes into the prompts. With `skip_covered` they come in random order, and a prompt is left out
where the smallest good mask of an earlier prompt lies: SAM's masks of a point are nested (part, thing, group), so that
a point in the same smallest part asks for the same masks again.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from itertools import chain
from typing import Any

import cv2
import numpy as np

from perception.config import SamConfig
from perception.machine import cores
from perception.masks.base import MaskSource
from perception.masks.sam_models import SamModel, open_sam
from perception.types import View

POINTS_PER_BATCH = 64
COVERING_BATCH = 8  # prompts of one call with `skip_covered`: those of a call do not see each other's masks
STABILITY_OFFSET = 1.0  # added to and subtracted from the logit threshold
BOX_NMS = 0.7  # box IoU above which two masks are duplicates
AT_ONCE = 4  # photos, at most: each needs the encoder's working memory
_BATCH_BYTES = 512 << 20  # masks of one batch; some graphs return them at full size


@dataclass(frozen=True)
class SamMask:
    """A mask of a photo. packed: its bits, compressed with deflate; shape: (h, w); area: in pixels; box: [4] int64, see
    `mask_box`; pred_iou: IoU predicted by the model; point: [2] (x, y), the prompt in pixels."""

    packed: bytes
    shape: tuple[int, int]
    area: int
    box: np.ndarray
    pred_iou: np.float32
    stability: np.float32
    point: np.ndarray

    def pixels(self) -> np.ndarray:
        """[h, w] bool."""
        bits = np.frombuffer(zlib.decompress(self.packed), np.uint8)
        return np.unpackbits(bits, count=self.shape[0] * self.shape[1]).reshape(self.shape).astype(bool)


class SamSource(MaskSource):
    """The mask source of `sam:PATH`. The constructor opens the models and checks their signatures."""

    remote = True

    def __init__(self, spec: str, settings: SamConfig) -> None:
        self.photos_at_once = min(cores(), AT_ONCE)
        self.model = open_sam(spec, threads=-(-cores() // self.photos_at_once))
        if "CPU" not in self.model.provider:
            self.photos_at_once = 1
        self.settings = settings
        self.name = f"sam ({self.model.family}, {self.model.provider})"
        self.identity = f"sam {self.model.fingerprint} {self.settings}"

    def check(self, views: list[View]) -> list[str]:
        """Returns warnings about an accelerator that could not be loaded and a decoder of single masks."""
        return list(self.model.warnings)

    def label_image(self, view: View, photo: np.ndarray) -> np.ndarray:
        """photo: [h, w, 3] uint8 RGB. Returns [h, w] int32, 0 where there is no mask."""
        return paint(automatic_masks(self.model, photo, self.settings), (photo.shape[0], photo.shape[1]))


def automatic_masks(model: SamModel, photo: np.ndarray, settings: SamConfig) -> list[SamMask]:
    """Masks of photo [h, w, 3] uint8 RGB from one grid of prompts, sorted by falling predicted IoU."""
    height, width = photo.shape[:2]
    embedding = model.encode(photo)
    side = settings.points_per_side
    centres = np.linspace(1 / (2 * side), 1 - 1 / (2 * side), side)  # of an even grid, row by row
    points = np.stack(np.meshgrid(centres, centres), axis=-1).reshape(-1, 2) * np.array([width, height])
    covered = np.zeros((height, width), bool)
    at_once = POINTS_PER_BATCH
    if settings.skip_covered:
        points = points[np.random.default_rng(0).permutation(len(points))]
        at_once = COVERING_BATCH if model.batched else 1
    step = max(1, min(at_once, _BATCH_BYTES // (width * height * 4 * 4)))
    masks: list[SamMask] = []
    while len(points):
        good = _good_masks(model, embedding, points[:step], settings)
        masks += chain(*good)
        points = points[step:]
        if settings.skip_covered:
            for nested in filter(None, good):
                covered |= min(nested, key=lambda mask: mask.area).pixels()
            points = points[~covered[points[:, 1].astype(int), points[:, 0].astype(int)]]
    boxes = np.array([mask.box for mask in masks]).reshape(-1, 4)
    return [masks[row] for row in box_nms(boxes, np.array([mask.pred_iou for mask in masks]), BOX_NMS)]


def paint(masks: list[SamMask], shape: tuple[int, int]) -> np.ndarray:
    """Label image [h, w] int32. Masks are painted by ascending pred_iou · stability: the best one gets a pixel (§4)."""
    labels = np.zeros(shape, np.int32)
    scores = np.array([mask.pred_iou * mask.stability for mask in masks])
    for label, row in enumerate(np.argsort(scores, kind="stable"), start=1):
        labels[masks[row].pixels()] = label
    return labels


def stability(logits: np.ndarray) -> np.float32:
    """IoU of the masks of `logits` [h, w] thresholded at ± STABILITY_OFFSET, in float32; NaN where both are empty."""
    inner, outer = (np.count_nonzero(logits > offset) for offset in (STABILITY_OFFSET, -STABILITY_OFFSET))
    return np.float32(inner) / np.float32(outer) if outer else np.float32("nan")


def mask_box(mask: np.ndarray) -> np.ndarray:
    """mask: [h, w] bool. [4] int64 (x0, y0, x1, y1) in pixels, ends inclusive; all zero for an empty mask."""
    x, y, width, height = cv2.boundingRect(mask.astype(np.uint8))
    return np.array([x, y, x + width - 1, y + height - 1] if width else [0] * 4, np.int64)


def box_nms(boxes: np.ndarray, scores: np.ndarray, threshold: float) -> np.ndarray:
    """Greedy non-maximum suppression. Returns the kept indices, best score first; ties keep the input order.
    boxes: [M, 4], scores: [M]. IoU in float32 with areas (x1 − x0)(y1 − y0), as in torchvision."""
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


def _good_masks(model: SamModel, embedding: Any, points: np.ndarray, settings: SamConfig) -> list[list[SamMask]]:
    """For each of points [P, 2], the masks that pass both thresholds. One mask at a time has the photo's size."""
    raw, pred_iou = model.decode(embedding, points)
    good: list[list[SamMask]] = [[] for _ in points]
    for point, which in np.argwhere(pred_iou > settings.pred_iou):
        logits = model.upscale(embedding, raw[point, which])
        stable = stability(logits)
        if stable >= np.float32(settings.stability):  # compared in float32, as published; false for NaN
            mask = logits > 0
            shape, area = (mask.shape[0], mask.shape[1]), int(np.count_nonzero(mask))
            scores, packed = (pred_iou[point, which], stable), zlib.compress(np.packbits(mask).tobytes(), 1)
            good[point].append(SamMask(packed, shape, area, mask_box(mask), *scores, points[point]))
    return good
