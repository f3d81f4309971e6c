"""Masks of one photo against its truth."""

from __future__ import annotations

import numpy as np


def best_ious(labels: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """[G] best IoU of each true instance over the masks. labels, truth: [h, w] integers >= 0, 0 = none."""
    best = []
    for instance in np.unique(truth[truth > 0]):
        true = truth == instance
        masks = [labels == label for label in np.unique(labels[true & (labels > 0)])]
        best.append(max(((mask & true).sum() / (mask | true).sum() for mask in masks), default=0.0))
    return np.array(best)
