"""A score in [0, 1] per instance, computed without ground truth and calibrated to the probability of being correct.

    raw = geometric mean of agreement, membership and (support + ½) / (support + 2½)

agreement: IoU with the 2D mask at each of its pixels, mean over its pixels in the training views. membership: mean
of `assign.memberships` over its Gaussians. support: number of photos in which one mask matches it.
"""

from __future__ import annotations

import numpy as np

from perception.masks.consensus import Evidence

CALIBRATION = (
    (0.0, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.85, 1.0),
    (0.0, 0.011, 0.545, 0.553, 0.572, 0.828, 0.921, 0.983, 1.0),
)
"""Raw scores, and the probability of IoU > 0.5 with a true object at each: fitted to 983 instances of 15 made places
with perfect masks and with a segmenter's errors, faint ones among them (`python tools score.places --fit`)."""


def raw_scores(ids: np.ndarray, membership: np.ndarray, seen: Evidence) -> np.ndarray:
    """[K] float64 in [0, 1] from ids [N] int32, membership [N] in [0, 1] and the evidence of the K instances."""
    count = len(seen.pixels)
    member = ids >= 0
    sizes = np.maximum(np.bincount(ids[member], minlength=count), 1)
    strength = np.bincount(ids[member], weights=membership[member], minlength=count) / sizes
    factors = (seen.agreement, strength, (seen.support + 0.5) / (seen.support + 2.5))
    product = np.prod([np.clip(factor, 0, 1) for factor in factors], axis=0)
    return np.asarray(product ** (1 / len(factors)))


def calibrated(raw: np.ndarray) -> np.ndarray:
    """Probability that an instance has IoU > 0.5 with a true object; monotone in the raw score."""
    return np.interp(raw, *CALIBRATION)
