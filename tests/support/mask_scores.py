"""Masks of one photo against its truth, and sums over the regions of a tree of merges."""

from __future__ import annotations

import numpy as np

from perception.masks.merging import MergeTree


def best_ious(labels: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """[G] best IoU of each true instance over the masks. labels, truth: [h, w] integers >= 0, 0 = none."""
    best = []
    for instance in np.unique(truth[truth > 0]):
        true = truth == instance
        masks = [labels == label for label in np.unique(labels[true & (labels > 0)])]
        best.append(max(((mask & true).sum() / (mask | true).sum() for mask in masks), default=0.0))
    return np.array(best)


def leaf_sums(tree: MergeTree, values: np.ndarray) -> np.ndarray:
    """[R + M, C] sum over the leaves of each region. values: [R, C]."""
    sums = np.concatenate([values, np.zeros((len(tree.children), values.shape[1]), values.dtype)])
    for k, pair in enumerate(tree.children, start=tree.leaves):
        sums[k] = sums[pair[0]] + sums[pair[1]]
    return sums
