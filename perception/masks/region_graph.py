"""A graph of image regions that knows how alike neighbours are, and merges them best first.

Everything a decision needs is a sum over pixels or over border pixels, so a merged region's evidence is the
sum of its parts' and never goes stale; the decision is a logistic regression over it, met again at every level of
merging (Nunez-Iglesias et al. 2013).
"""

from __future__ import annotations

import heapq
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np

from perception.masks.cues import COLOUR_WORDS, PhotoCues

PHOTO_FEATURES = 8
_THIN = 1.5  # pixels of area a pixel of border: a ribbon 3 px wide

# Columns of the sums over pixels, and over border pixels.
_AREA, _LAB, _TEXTURE, _WORDS = 0, slice(1, 4), 4, slice(5, None)
_LENGTH, _EDGE = range(2)


class RegionGraph:
    """sums: [R, C] over each region's pixels; borders: region -> neighbour -> [B] sums over their border."""

    def __init__(self, regions: np.ndarray, photo: PhotoCues) -> None:
        """regions: [h, w] int, ids 0..R−1 all in use."""
        self.pixels = regions.size
        self.sums = _region_sums(regions, photo)
        self.borders = _border_sums(regions, photo, len(self.sums))
        self.perimeters = np.array([sum(row[_LENGTH] for row in links.values()) for links in self.borders])

    def features(self, a: int, others: list[int]) -> np.ndarray:
        """Evidence that `a` and each of `others` are one object: [M, PHOTO_FEATURES]."""
        border = np.stack([self.borders[a][b] for b in others])
        length = border[:, _LENGTH]
        one, two = self.sums[a], self.sums[others]
        area_a, area_b = one[_AREA], two[:, _AREA]
        mean_a, mean_b = one / area_a, two / area_b[:, None]
        colour = (mean_b[:, _LAB] - mean_a[_LAB]) ** 2 @ np.array([0.5, 2.0, 2.0])
        columns = [
            np.ones(len(others)),
            np.log1p(border[:, _EDGE] / length),
            np.log1p(np.sqrt(colour)),
            1 - np.minimum(mean_a[_WORDS], mean_b[:, _WORDS]).sum(axis=1),
            np.abs(mean_a[_TEXTURE] - mean_b[:, _TEXTURE]),
            np.log(np.minimum(area_a, area_b) / self.pixels) + 7,
            length / np.minimum(self.perimeters[a], self.perimeters[others]),
            np.minimum(mean_a[_TEXTURE], mean_b[:, _TEXTURE]),
        ]
        return np.stack(columns, axis=1)

    def size(self, a: int) -> float:
        """Pixels: the larger of two lives on."""
        return float(self.sums[a, _AREA])

    def negligible(self, a: int, smallest: float) -> bool:
        """Under `smallest` pixels, or so thin that it is but the blur of a border."""
        area = self.sums[a, _AREA]
        return bool(area < smallest or area < _THIN * self.perimeters[a])

    def merge(self, a: int, b: int) -> None:
        """b becomes part of a."""
        self.perimeters[a] += self.perimeters[b] - 2 * self.borders[a].pop(b)[_LENGTH]
        join(self.sums, self.borders, a, b)


def join(sums: np.ndarray, borders: list[dict[int, np.ndarray]], a: int, b: int) -> None:
    """b's sums and borders are added to a's, in place; the border between the two is gone already from a's side."""
    sums[a] += sums[b]
    for other, row in borders[b].items():
        if other != a:
            del borders[other][b]
            total = borders[a][other] + row if other in borders[a] else row
            borders[a][other] = borders[other][a] = total
    borders[b] = {}


class MergingGraph(Protocol):
    """What `agglomerate` asks of a graph of regions of a photo or of patches of a surface."""

    sums: np.ndarray
    borders: list[dict[int, np.ndarray]]

    def features(self, a: int, others: list[int]) -> np.ndarray:
        """[M, F] evidence that `a` and each of `others` are one object."""
        ...

    def size(self, a: int) -> float:
        """The larger of two lives on."""
        ...

    def negligible(self, a: int, smallest: float) -> bool:
        """Too small to stand alone."""
        ...

    def merge(self, a: int, b: int) -> None:
        """b becomes part of a."""
        ...


Watcher = Callable[[Any, int, int], None]


def agglomerate(
    graph: MergingGraph, weights: np.ndarray, threshold: float, smallest: float, watch: Watcher | None = None
) -> np.ndarray:
    """Merges the likeliest pair until none scores `threshold` (log odds); what is negligible always merges.

    weights: [F]. smallest: see `negligible`. watch(graph, a, b) is called before every merge.
    Returns [R] the region that each one ended in.
    """
    parent = np.arange(len(graph.sums))
    version = np.zeros(len(parent), np.int64)
    queue: list[tuple[float, int, int, int, int]] = []

    def offer(a: int, others: list[int]) -> None:
        scores = graph.features(a, others) @ weights
        for b, score in zip(others, scores.tolist(), strict=True):
            if score >= threshold or graph.negligible(a, smallest) or graph.negligible(b, smallest):
                heapq.heappush(queue, (-score, a, b, int(version[a]), int(version[b])))

    for a, links in enumerate(graph.borders):
        if later := [b for b in links if b > a]:
            offer(a, later)
    while queue:
        _, a, b, version_a, version_b = heapq.heappop(queue)
        if version[a] != version_a or version[b] != version_b:
            continue
        if watch is not None:
            watch(graph, a, b)
        if graph.size(a) < graph.size(b):
            a, b = b, a
        graph.merge(a, b)
        parent[b] = a
        version[[a, b]] += 1
        if graph.borders[a]:
            offer(a, list(graph.borders[a]))
    while (parent != parent[parent]).any():
        parent = parent[parent]
    return parent


def _region_sums(regions: np.ndarray, photo: PhotoCues) -> np.ndarray:
    flat, count = regions.ravel(), int(regions.max()) + 1
    maps = [np.ones(regions.shape), *np.moveaxis(photo.lab, -1, 0), photo.texture]
    sums = [np.bincount(flat, weights=values.ravel(), minlength=count) for values in maps]
    words = np.bincount(flat * COLOUR_WORDS + photo.word.ravel(), minlength=count * COLOUR_WORDS)
    return np.concatenate([np.stack(sums, axis=1), words.reshape(count, COLOUR_WORDS)], axis=1)


def _border_sums(regions: np.ndarray, photo: PhotoCues, count: int) -> list[dict[int, np.ndarray]]:
    keys, rows = [], []
    for axis in (0, 1):
        first, second = neighbours(regions, axis)
        cut = first != second
        low, high = np.minimum(first, second)[cut], np.maximum(first, second)[cut]
        keys.append(low.astype(np.int64) * count + high)
        edge = np.maximum(*neighbours(photo.edge, axis))[cut]
        rows.append(np.stack([np.ones(len(edge)), edge], axis=1))
    unique, index = np.unique(np.concatenate(keys), return_inverse=True)
    values = np.concatenate(rows)
    sums = np.stack([np.bincount(index, weights=column) for column in values.T], axis=1)
    borders: list[dict[int, np.ndarray]] = [{} for _ in range(count)]
    for key, row in zip(unique.tolist(), sums, strict=True):
        a, b = divmod(key, count)
        borders[a][b] = borders[b][a] = row
    return borders


def neighbours(image: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray]:
    """Each pixel and its right (axis 0) or lower (axis 1) neighbour."""
    return (image[:, :-1], image[:, 1:]) if axis == 0 else (image[:-1], image[1:])
