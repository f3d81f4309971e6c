"""Skipped prompts: a segmenter whose masks of a point are nested (part, thing, group) gives the same masks without."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pytest

from perception.config import SamConfig
from perception.masks.sam import SamMask, automatic_masks, paint

SIZE, SIDE = (300, 400), 16  # of the photo, of the grid of prompts


@dataclass
class Nested:
    """Answers a point with its part, thing and group of a scene, ragged at the rim by `jitter` pixels, as SAM does.

    batched: as `SamModel`'s. A small part has a good score, a group a worse one; a seam between parts gives no mask.
    """

    parts: np.ndarray
    thing_of: np.ndarray
    group_of: np.ndarray
    jitter: int = 0
    batched: bool = False
    asked: list[int] = field(default_factory=list)

    def encode(self, photo: np.ndarray) -> None:
        return None

    def decode(self, embedding: None, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        import cv2

        self.asked.append(len(points))
        logits, scores = np.full((len(points), 3, *self.parts.shape), -9.0, np.float32), np.zeros((len(points), 3))
        things, groups = self.thing_of[self.parts], self.group_of[self.thing_of[self.parts]]
        for row, (x, y) in enumerate(points.astype(int)):
            if self.parts[y, x] == 0:
                continue
            for level, labels in enumerate((self.parts, things, groups)):
                moved, shift = labels == labels[y, x], np.zeros(2)
                if self.jitter:
                    shift = np.random.default_rng([x, y, level]).integers(-self.jitter, self.jitter + 1, 2)
                    by = np.array([[1, 0, shift[0]], [0, 1, shift[1]]], float)
                    moved = cv2.warpAffine(moved.astype(np.uint8), by, moved.shape[::-1]) > 0
                logits[row, level][moved] = 9.0
                scores[row, level] = 0.97 - 0.02 * level - 0.0001 * self.jitter * np.abs(shift).sum()
        return logits, scores.astype(np.float32)

    def upscale(self, embedding: None, raw: np.ndarray) -> np.ndarray:
        return raw


def scene(seed: int) -> Nested:
    """Rectangular things on a table before a wall; each thing has one or two parts, some things lie in a tray."""
    rng = np.random.default_rng(seed)
    parts = np.zeros(SIZE, np.int64)
    parts[:170], parts[175:] = 1, 2  # wall, table, and a seam that is neither
    thing_of, group_of = [0, 1, 2], {0: 0, 1: 1, 2: 2}
    cells = [(y, x) for y in range(20, 260, 60) for x in range(20, 360, 70)]
    for y, x in rng.permutation(cells)[:14]:
        thing = max(thing_of) + 1
        group_of[thing] = 100 if x < 160 and y > 180 else thing
        h, w = rng.integers(24, 52), rng.integers(24, 60)
        parts[y : y + h, x : x + w] = len(thing_of)
        thing_of.append(thing)
        if rng.random() < 0.5:
            parts[y + h // 3 : y + h, x + w // 2 : x + w] = len(thing_of)
            thing_of.append(thing)
    groups = np.array([group_of.get(n, n) for n in range(max(thing_of) + 1)])
    return Nested(parts, np.array(thing_of), groups)


def pixels(masks: list[SamMask]) -> set[bytes]:
    return {mask.pixels().tobytes() for mask in masks}


@pytest.mark.parametrize("seed", range(2))
def test_the_masks_of_the_full_grid_from_a_fraction_of_its_prompts(seed: int) -> None:
    model, photo = scene(seed), np.zeros((*SIZE, 3), np.uint8)
    full = automatic_masks(model, photo, SamConfig(points_per_side=SIDE, skip_covered=False))
    assert sum(model.asked) == SIDE**2
    for batched in (False, True):
        model.asked, model.batched = [], batched
        fewer = automatic_masks(model, photo, SamConfig(points_per_side=SIDE))
        print(f"{len(full)} masks, {sum(model.asked)} of {SIDE**2} prompts")
        assert pixels(fewer) == pixels(full) and len(fewer) == len(full) > 20
        assert sum(model.asked) < (120 if batched else 80) and max(model.asked) == (8 if batched else 1)


@pytest.mark.parametrize("seed", range(2))
def test_ragged_masks_agree_too(seed: int) -> None:
    """Each prompt's masks lie a pixel off; each mask of the full grid has its counterpart, and back."""
    model, photo = scene(seed), np.zeros((*SIZE, 3), np.uint8)
    model.jitter = 1
    full, fewer = (
        automatic_masks(model, photo, SamConfig(points_per_side=SIDE, skip_covered=skip)) for skip in (False, True)
    )
    a, b = (np.stack([mask.pixels().ravel() for mask in masks]).astype(np.float32) for masks in (full, fewer))
    shared = a @ b.T
    iou = shared / (a.sum(1)[:, None] + b.sum(1)[None] - shared)
    assert iou.max(axis=1).min() > 0.7 and iou.max(axis=0).min() > 0.7
    labels = [paint(masks, SIZE) for masks in (full, fewer)]
    same = sum(np.bincount(labels[0][labels[1] == n]).max() for n in np.unique(labels[1]))
    assert same > 0.97 * labels[0].size
