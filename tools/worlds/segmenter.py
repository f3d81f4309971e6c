"""Label images for one photo as a 2D segmenter would give them: without errors, and with typical errors."""

from __future__ import annotations

import cv2
import numpy as np

SMALL = 150  # pixels; smaller objects are missed with probability MISSED_SMALL
MISSED_SMALL = 0.8
MISSED = 0.04
CUT_INTO_PARTS = 0.35
CUT_BACKGROUND = 0.3
MERGED = 0.08
RAGGED = 1.3  # pixels: standard deviation of a border's displacement
HOLES = 1 / 9000  # per pixel
_PART = 100  # pixels; smaller parts keep the label of the largest part


def perfect_labels(ids: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """ids [H, W] with randomly permuted labels, so that labels do not correspond across photos; 0 stays 0. uint16."""
    names = np.unique(ids[ids > 0])
    shuffled = np.zeros(int(ids.max()) + 1, np.uint16)
    shuffled[names] = 1 + rng.permutation(len(names))
    return shuffled[ids]


def erring_labels(ids: np.ndarray, parts: np.ndarray, stuff: set[int], rng: np.random.Generator) -> np.ndarray:
    """Label image with errors, [H, W] uint16: objects cut into parts, merged with a neighbour or missed, backgrounds
    cut in two, ragged borders, holes.

    ids, parts [H, W]: visible instance, and index of its visible surface. stuff: ids of backgrounds.
    """
    labels = ids.astype(np.int32)
    for name in np.unique(ids[ids > 0]).tolist():
        inside = ids == name
        if name in stuff:
            if rng.random() < CUT_BACKGROUND:
                labels[inside & (_smooth(rng, ids.shape, 60) > 0)] = labels.max() + 1
        elif inside.sum() < SMALL or rng.random() < MISSED:
            if inside.sum() >= SMALL or rng.random() < MISSED_SMALL:
                labels[inside] = 0
        elif rng.random() < CUT_INTO_PARTS:
            _cut_into_parts(labels, inside, parts)
    for name in np.unique(labels[labels > 0]).tolist():
        if rng.random() < MERGED:
            _merge(labels, name, rng)
    return perfect_labels(_with_holes(_ragged(labels, rng), rng), rng)


def _cut_into_parts(labels: np.ndarray, inside: np.ndarray, parts: np.ndarray) -> None:
    """Gives a new label to every part with at least _PART pixels, except the largest."""
    numbers, counts = np.unique(parts[inside], return_counts=True)
    for number in numbers[np.argsort(-counts)][1:][: int((counts >= _PART).sum())]:
        part = inside & (parts == number)
        if part.sum() >= _PART:
            labels[part] = labels.max() + 1


def _merge(labels: np.ndarray, name: int, rng: np.random.Generator) -> None:
    """Gives one label to an object and one of its neighbours."""
    inside = (labels == name).astype(np.uint8)
    rim = (cv2.dilate(inside, np.ones((5, 5), np.uint8)) > 0) & (inside == 0) & (labels > 0)
    neighbours = np.unique(labels[rim])
    if len(neighbours):
        labels[labels == name] = rng.choice(neighbours)


def _ragged(labels: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Displaces borders by smooth noise and removes the label of half of the border pixels."""
    rows, columns = np.mgrid[: labels.shape[0], : labels.shape[1]].astype(np.float32)
    moved = [axis + RAGGED * _smooth(rng, labels.shape, 2.0) for axis in (columns, rows)]
    ragged = cv2.remap(
        labels.astype(np.float32), moved[0], moved[1], cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE
    ).astype(np.int32)
    border = (cv2.dilate(ragged.astype(np.float32), np.ones((3, 3))) != ragged) & (rng.random(labels.shape) < 0.5)
    ragged[border] = 0
    return ragged


def _with_holes(labels: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    height, width = labels.shape
    mask = np.zeros((height, width), np.uint8)
    for _ in range(rng.poisson(HOLES * labels.size)):
        center = int(rng.integers(width)), int(rng.integers(height))
        axes = int(rng.integers(2, 6)), int(rng.integers(2, 6))
        cv2.ellipse(mask, center, axes, float(rng.uniform(0, 180)), 0, 360, 1, -1)
    return np.where(mask > 0, 0, labels)


def _smooth(rng: np.random.Generator, shape: tuple[int, ...], sigma: float) -> np.ndarray:
    """Gaussian-filtered noise [H, W] float32 with unit standard deviation. sigma: of the filter, pixels."""
    noise = cv2.GaussianBlur(rng.standard_normal(shape).astype(np.float32), (0, 0), sigma)
    return noise / noise.std()
