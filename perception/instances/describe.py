"""Descriptions of instances: embeddings of their crops (§3.2.2, eq. 11) and a palette of their colours.

l_i = (1 / KL) Σ_k Σ_l l_ikl    over the L crops of the K best views, each of unit length; then scaled to length 1
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from perception.instances.crops import crop_levels, mask_box
from perception.language.base import Encoder, unit_rows
from perception.language.colors import palette
from perception.language.description import Box, InstanceDescription, unseen
from perception.progress import QUIET, Progress

COLOR_SAMPLES = 2000  # pixels of a mask per view, from which the palette is computed
AT_ONCE = 24  # crops from which they are encoded together, so that no thread waits at the end of each photo
Load = Callable[[int], tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True)
class Unread:
    """Stands for an encoder where only the views, boxes and colours of instances are wanted: embeddings are zeros."""

    dim: int
    identity: str = ""

    def encode_images(self, images: Sequence[np.ndarray]) -> np.ndarray:
        return np.zeros((len(images), self.dim), np.float32)


def describe_instances(
    encoder: Encoder | Unread,
    choices: Sequence[np.ndarray],
    load: Load,
    view_names: Sequence[str],
    levels: int = 3,
    progress: Progress = QUIET,
) -> list[InstanceDescription]:
    """Descriptions of the I instances whose views `choices` lists (see `crops.choose_views`).

    load(view) → photo [H, W, 3] uint8 and instance image [H, W] int32: silhouettes with occlusion, value = index in
    `choices`, −1 = none. Only one photo at a time is kept in memory.
    """
    wanted: dict[int, list[tuple[int, int]]] = {}
    for instance, views in enumerate(choices):
        for rank, view in enumerate(views):
            wanted.setdefault(int(view), []).append((instance, rank))
    seen: list[dict[int, tuple[str, Box | None, np.ndarray, np.ndarray]]] = [{} for _ in choices]
    crops: list[np.ndarray] = []
    waiting: list[tuple[int, int, str, Box | None, slice, np.ndarray]] = []
    for done, view in enumerate(sorted(wanted), start=1):
        photo, ids = load(view)
        for instance, rank in wanted[view]:
            mask = ids == instance
            if own := crop_levels(photo, mask, levels):
                rows = slice(len(crops), len(crops) + len(own))
                waiting.append((instance, rank, view_names[view], mask_box(mask), rows, _color_sample(photo, mask)))
                crops += own
        if len(crops) >= AT_ONCE or (crops and done == len(wanted)):
            embedded = encoder.encode_images(crops)
            for instance, rank, name, box, rows, colors in waiting:
                seen[instance][rank] = (name, box, embedded[rows], colors)
            crops, waiting = [], []
        progress.update("language", done, len(wanted))
    return [_summary(views, encoder.dim) for views in seen]


def _summary(views: dict[int, Any], dim: int) -> InstanceDescription:
    """views: by rank, name, box, embeddings of its crops [L, D], and pixels [P, 3] of the instance."""
    if not views:
        return unseen(dim)
    names, boxes, crops, pixels = zip(*(views[rank] for rank in sorted(views)), strict=True)
    per_view = unit_rows(np.stack([rows.mean(axis=0) for rows in crops]))
    embedding = unit_rows(np.concatenate(crops).mean(axis=0)[None])[0]
    return InstanceDescription(embedding, per_view, palette(np.concatenate(pixels)), list(names), list(boxes))


def _color_sample(photo: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Up to COLOR_SAMPLES pixels [P, 3] of the mask without its rim of mixed colours; the full mask if it is thin."""
    inner = cv2.erode(mask.astype(np.uint8), np.ones((5, 5), np.uint8)).astype(bool)
    pixels = photo[inner] if inner.sum() >= 50 else photo[mask]
    step = max(1, -(-len(pixels) // COLOR_SAMPLES))
    return pixels[::step]
