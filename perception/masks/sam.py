"""`sam:PATH`: automatic masks of a Segment Anything model (Kirillov et al. 2023, app. B) in onnxruntime."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from perception.masks.sam_steps import (
    Box,
    PackedMask,
    box_nms,
    clean_mask,
    crop_boxes,
    mask_box,
    point_grid,
    stability,
    touches_crop,
)
from perception.types import View

_BATCH_BYTES = 512 << 20  # of one batch's masks, which some graphs give at full size


@dataclass(frozen=True)
class SamSettings:
    """The published defaults. min_area: pixels under which holes are filled, islands dropped."""

    points_per_side: int = 32
    points_per_batch: int = 64
    pred_iou: float = 0.88
    stability: float = 0.95
    stability_offset: float = 1.0
    box_nms: float = 0.7
    crop_layers: int = 0
    crop_nms: float = 0.7
    crop_overlap: float = 512 / 1500
    crop_points_downscale: int = 1
    min_area: int = 0


class Segmenter(Protocol):
    """A promptable model."""

    def encode(self, photo: np.ndarray) -> Any:
        """photo: [h, w, 3] uint8 RGB. Returns what decode needs."""
        ...

    def decode(self, embedding: Any, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """points: [P, 2] float64 (x, y) in photo pixels. Raw masks [P, m, ?, ?], predicted IoU [P, m]."""
        ...

    def upscale(self, embedding: Any, raw: np.ndarray) -> np.ndarray:
        """raw: [?, ?], one mask of decode. Returns its logits [h, w] float32 at the photo's size."""
        ...


@dataclass
class Masks:
    """Candidates, row by row: what it looks like, where, how good, and the crop it came from."""

    packed: list[PackedMask] = field(default_factory=list)
    boxes: np.ndarray = field(default_factory=lambda: np.zeros((0, 4), np.int64))
    pred_iou: np.ndarray = field(default_factory=lambda: np.zeros(0, np.float32))
    stability: np.ndarray = field(default_factory=lambda: np.zeros(0, np.float32))
    points: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    crop_area: np.ndarray = field(default_factory=lambda: np.zeros(0))

    def __len__(self) -> int:
        return len(self.packed)

    def take(self, rows: np.ndarray) -> Masks:
        """rows: indices, in the order wanted."""
        arrays = (self.boxes, self.pred_iou, self.stability, self.points, self.crop_area)
        return Masks([self.packed[i] for i in rows], *(array[rows] for array in arrays))

    @staticmethod
    def of(rows: list[tuple[PackedMask, np.ndarray, Any, Any, np.ndarray]], crop_area: float) -> Masks:
        """rows: (mask, box, predicted IoU, stability, point) of one crop."""
        if not rows:
            return Masks()
        packed, boxes, pred_iou, stable, points = zip(*rows, strict=True)
        scores = (np.array(pred_iou, np.float32), np.array(stable, np.float32))
        return Masks(list(packed), np.stack(boxes), *scores, np.stack(points), np.full(len(rows), crop_area))

    @staticmethod
    def join(parts: list[Masks]) -> Masks:
        parts = [Masks(), *parts]
        names = ("boxes", "pred_iou", "stability", "points", "crop_area")
        arrays = [np.concatenate([getattr(part, name) for part in parts]) for name in names]
        return Masks([mask for part in parts for mask in part.packed], *arrays)


class AutomaticMasks:
    """Prompts a model with a grid of points and keeps the masks that are sure, stable and no duplicates."""

    def __init__(self, model: Segmenter, settings: SamSettings | None = None) -> None:
        self.model = model
        self.settings = settings or SamSettings()

    def __call__(self, photo: np.ndarray) -> Masks:
        """photo: [h, w, 3] uint8 RGB."""
        s = self.settings
        crops = crop_boxes(photo.shape[0], photo.shape[1], s.crop_layers, s.crop_overlap)
        masks = Masks.join([self._crop(photo, crop, layer) for crop, layer in crops])
        if len(crops) > 1:  # masks of smaller crops are preferred
            masks = masks.take(box_nms(masks.boxes, 1.0 / masks.crop_area, s.crop_nms))
        return self._clean(masks) if s.min_area > 0 else masks

    def _crop(self, photo: np.ndarray, crop: Box, layer: int) -> Masks:
        x0, y0, x1, y1 = crop
        window = np.ascontiguousarray(photo[y0:y1, x0:x1])
        side = int(self.settings.points_per_side / self.settings.crop_points_downscale**layer)
        points = point_grid(side) * np.array([x1 - x0, y1 - y0])
        embedding = self.model.encode(window)
        found = Masks.join([self._batch(embedding, batch, crop, photo.shape) for batch in self._batches(points, crop)])
        found = found.take(box_nms(found.boxes, found.pred_iou, self.settings.box_nms))
        found.boxes = found.boxes + np.array([x0, y0, x0, y0])
        found.points = found.points + np.array([x0, y0])
        return found

    def _batches(self, points: np.ndarray, crop: Box) -> Iterator[np.ndarray]:
        pixels = (crop[2] - crop[0]) * (crop[3] - crop[1])
        size = max(1, min(self.settings.points_per_batch, _BATCH_BYTES // (pixels * 4 * 4)))
        for start in range(0, len(points), size):
            yield points[start : start + size]

    def _batch(self, embedding: Any, points: np.ndarray, crop: Box, shape: tuple[int, ...]) -> Masks:
        """Masks of some points that are sure, stable and not cut by the crop; at full size one at a time."""
        raw, pred_iou = self.model.decode(embedding, points)
        found = []
        for point, which in np.argwhere(pred_iou > self.settings.pred_iou):
            logits = self.model.upscale(embedding, raw[point, which])
            stable = stability(logits, self.settings.stability_offset)
            if not stable >= np.float32(self.settings.stability):  # in float32, as published; refuses NaN too
                continue
            mask = logits > 0
            box = mask_box(mask)
            if not touches_crop(box, crop, shape[0], shape[1]):
                packed = PackedMask.pack(_uncrop(mask, crop, shape))
                found.append((packed, box, pred_iou[point, which], stable, points[point]))
        return Masks.of(found, float((crop[2] - crop[0]) * (crop[3] - crop[1])))

    def _clean(self, masks: Masks) -> Masks:
        """Small holes and islands go; of masks that then coincide the untouched one stays."""
        boxes, untouched = np.zeros((len(masks), 4), np.int64), np.ones(len(masks), np.float32)
        for row, packed in enumerate(masks.packed):
            mask, changed = clean_mask(packed.unpack(), self.settings.min_area)
            masks.packed[row] = PackedMask.pack(mask)
            boxes[row], untouched[row] = mask_box(mask), float(not changed)
        masks.boxes = boxes
        return masks.take(box_nms(boxes, untouched, max(self.settings.box_nms, self.settings.crop_nms)))


def paint(masks: Masks, shape: tuple[int, int]) -> np.ndarray:
    """Label image [h, w] int32: masks painted in ascending pred_iou · stability, so the best wins a pixel."""
    labels = np.zeros(shape, np.int32)
    for label, row in enumerate(np.argsort(masks.pred_iou * masks.stability, kind="stable"), start=1):
        labels[masks.packed[row].unpack()] = label
    return labels


def _uncrop(mask: np.ndarray, crop: Box, shape: tuple[int, ...]) -> np.ndarray:
    if mask.shape == tuple(shape[:2]):
        return mask
    whole = np.zeros(shape[:2], bool)
    whole[crop[1] : crop[3], crop[0] : crop[2]] = mask
    return whole


class SamSource:
    """The mask source of `sam:PATH`."""

    def __init__(self, spec: str, settings: SamSettings | None = None) -> None:
        from perception.masks.sam_models import open_sam

        self.model = open_sam(spec)
        self.generator = AutomaticMasks(self.model, settings)
        self.name = f"sam ({self.model.family}, {self.model.provider})"
        self.identity = f"sam {self.model.fingerprint} {self.generator.settings}"

    def check(self, views: list[View]) -> list[str]:
        """The models were opened and recognised already; warns of an accelerator that did not come up."""
        return list(self.model.warnings)

    def label_image(self, view: View, photo: np.ndarray) -> np.ndarray:
        """photo: [h, w, 3] uint8 RGB. Returns [h, w] int32, 0 where no mask lies."""
        return paint(self.generator(photo), (photo.shape[0], photo.shape[1]))
