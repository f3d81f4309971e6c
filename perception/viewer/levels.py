"""Levels of detail: a large map as fewer, larger Gaussians, each of one instance, for the viewer.

Gaussians of one instance in one cell of a grid become one, by moment matching with weights w = opacity · area:
    μ = Σ w μᵢ / Σ w     Σ = Σ w (Σᵢ + (μᵢ − μ)(μᵢ − μ)ᵀ) / Σ w     o = min(1, Σ w / A)
where the area A of a Gaussian is (det Σ)^⅓. Colours are means with the same weights.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from perception.geometry import sums_by

MOST = 1_000_000  # Gaussians that a page shows; browsers sort them anew for every change of the view
STEPS = 24  # halvings of the interval in which the cells' side is searched
TOO_FEW = 0.9  # share of the wanted count from which a side is good enough


@dataclass(frozen=True)
class Level:
    """M Gaussians instead of N. owner [N] int64: the row that each belongs to; weights [N] float32, w of the module;
    means [M, 3], covariances [M, 3, 3] float32; areas [M] float32."""

    owner: np.ndarray
    weights: np.ndarray
    means: np.ndarray
    covariances: np.ndarray
    areas: np.ndarray

    def __len__(self) -> int:
        return len(self.means)

    def colors(self, colors: np.ndarray) -> np.ndarray:
        """[M, 3] uint8 of colours [N, 3] uint8."""
        return np.rint(_means(self.owner, self.weights, colors, len(self))).astype(np.uint8)

    def opacities(self, shown: np.ndarray) -> np.ndarray:
        """[M] float32; shown [N] bool: Gaussians that are not hidden."""
        total = np.bincount(self.owner, self.weights * shown, len(self))
        return np.minimum(1.0, total / np.maximum(self.areas, 1e-30)).astype(np.float32)


def level(
    means: np.ndarray, covariances: np.ndarray, opacities: np.ndarray, ids: np.ndarray, most: int = MOST
) -> Level:
    """At most `most` Gaussians instead of N > `most`: means [N, 3], covariances [N, 3, 3], opacities [N]. ids [N]
    integers: Gaussians with different ids are never merged. Where there are more ids than `most`, so many remain."""
    areas = np.cbrt(np.maximum(np.linalg.det(covariances.astype(np.float64)), 1e-36))
    weights = np.maximum(opacities * areas, 1e-30)
    owner, count = _cells(means, ids, most)
    middles = _means(owner, weights, means, count)
    away = means - middles[owner]
    spreads = covariances + away[:, :, None] * away[:, None, :]
    merged = _means(owner, weights, spreads, count)
    area = np.cbrt(np.maximum(np.linalg.det(merged), 1e-36))
    return Level(owner, weights.astype(np.float32), *(array.astype(np.float32) for array in (middles, merged, area)))


def _cells(means: np.ndarray, ids: np.ndarray, most: int) -> tuple[np.ndarray, int]:
    """The cell [N] of each Gaussian, and their number: of the finest grid that has at most `most` cells with one id."""
    low, high = np.quantile(means, [0.001, 0.999], axis=0)
    inside = np.clip(means, low, high) - low
    names = np.unique(ids, return_inverse=True)[1].reshape(-1).astype(np.int64)
    fine, coarse = np.log(1e-4), 0.0  # of the side, as a share of the largest extent
    extent = max(float((high - low).max()), 1e-12)
    best: tuple[np.ndarray, int] | None = None
    for _ in range(STEPS):
        side = extent * np.exp((fine + coarse) / 2)
        cell = (inside / side).astype(np.int64)
        sizes = cell.max(axis=0) + 1
        key = ((names * sizes[0] + cell[:, 0]) * sizes[1] + cell[:, 1]) * sizes[2] + cell[:, 2]
        cells, owner = np.unique(key, return_inverse=True)
        if len(cells) <= most:
            best, coarse = (owner.reshape(-1), len(cells)), (fine + coarse) / 2
            if len(cells) >= TOO_FEW * most:
                break
        else:
            fine = (fine + coarse) / 2
    return best if best is not None else (names, int(names.max()) + 1)


def _means(owner: np.ndarray, weights: np.ndarray, values: np.ndarray, count: int) -> np.ndarray:
    """[count, ...] weighted means of values [N, ...]."""
    total = np.bincount(owner, weights, count)
    return sums_by(owner, values, count, weights) / total.reshape(-1, *[1] * (values.ndim - 1))
