"""What of a finished Gaussian scene is surface: floaters and haze, recognised by their neighbours, are hidden."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from perception.geometry import nearest
from perception.splats.read import PARKED, Splat

OPAQUE = 0.3
"""Opacity from which a Gaussian is evidence of a surface for its neighbours."""
NEIGHBOURS, APART, ALONE = 8, 6.0, 4.0
"""A Gaussian is hidden if its NEIGHBOURS-th opaque neighbour is farther than APART times its own largest σ and ALONE
times the median of that distance: specks in the air are smaller groups, and a wall's Gaussians are as large as their
distances."""
LARGEST = 10.0
"""Multiple of the median σ that counts as a Gaussian's own: no veil vouches for itself."""


def hide(splat: Splat, hidden: np.ndarray) -> np.ndarray:
    """Opacity logits [N] with which hidden rows are never drawn."""
    return np.where(hidden, np.float32(PARKED), splat.opacity_logits)


def floaters(splat: Splat) -> np.ndarray:
    """[N] bool: Gaussians without enough opaque ones around them (see NEIGHBOURS), and parked ones."""
    opaque = np.flatnonzero((splat.opacity_logits > np.log(OPAQUE / (1 - OPAQUE))) & ~splat.parked)
    if len(opaque) <= NEIGHBOURS:
        return splat.parked.copy()
    distance = nearest(cKDTree(splat.means[opaque]), splat.means, [NEIGHBOURS + 1])[0][:, 0].astype(np.float32)
    sigma = np.exp(splat.log_scales.max(axis=1))
    own = np.minimum(sigma, LARGEST * np.median(sigma[opaque]))
    return np.asarray(splat.parked | (distance > np.maximum(APART * own, ALONE * np.median(distance[opaque]))))


def sampled(rows: np.ndarray, most: int) -> np.ndarray:
    """At most about `most` of `rows`, evenly."""
    return rows[:: -(-len(rows) // most)] if len(rows) else rows
