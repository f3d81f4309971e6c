"""A score in [0, 1] for each instance, from what is known without truth.

    score = geometric mean of  membership · agreement · views / (views + 2) · solidity

membership: mean HDBSCAN strength of its Gaussians. agreement: over the training views, how well its silhouette matches
the best 2D mask under it (IoU weighted by silhouette size). views: photos that show it. solidity: mean opacity.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from perception.instances.silhouettes import Silhouettes


class Agreement:
    """Accumulates, view by view, the IoU of each instance's silhouette with the best 2D mask under it."""

    def __init__(self, count: int):
        self.weight = np.zeros(count)
        self.total = np.zeros(count)
        self.views = np.zeros(count, np.int64)

    def add(self, silhouettes: Silhouettes, labels: np.ndarray | None) -> None:
        """labels [H, W] int, 0 = unlabelled; None when the photo has no masks."""
        self.views += silhouettes.pixels > 0
        if labels is None:
            return
        ids = silhouettes.ids
        names, dense = np.unique(labels, return_inverse=True)
        dense = dense.reshape(labels.shape)
        table = np.zeros((len(self.weight) + 1, len(names)))
        np.add.at(table, (ids, dense), 1)  # row −1 (no instance) is the last one
        areas = table.sum(axis=0)
        inside = table[:-1]
        union = inside.sum(axis=1, keepdims=True) + areas[None] - inside
        overlap = np.where(names[None] > 0, inside / np.maximum(union, 1), 0)
        self.weight += silhouettes.pixels
        self.total += silhouettes.pixels * overlap.max(axis=1, initial=0)

    def mean(self) -> np.ndarray:
        """[M] in [0, 1]; 1 where no photo had masks to compare with."""
        return np.where(self.weight > 0, self.total / np.maximum(self.weight, 1), 1.0)


def scores(ids: np.ndarray, membership: np.ndarray, opacities: np.ndarray, agreement: Agreement) -> np.ndarray:
    """[M] float64 in [0, 1]: one score an instance, as told above."""
    count = len(agreement.views)
    member = ids >= 0
    sizes = np.maximum(np.bincount(ids[member], minlength=count), 1)
    strength = np.bincount(ids[member], weights=membership[member], minlength=count) / sizes
    solidity = np.bincount(ids[member], weights=opacities[member], minlength=count) / sizes
    factors: Iterable[np.ndarray] = (
        strength,
        agreement.mean(),
        agreement.views / (agreement.views + 2.0),
        solidity,
    )
    product = np.ones(count)
    for factor in factors:
        product *= np.clip(factor, 0, 1)
    return product**0.25
