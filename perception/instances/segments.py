"""Over-segmentation: groups of Gaussians with similar feature and position, many more than there are objects."""

from __future__ import annotations

import numpy as np
from scipy import sparse
from scipy.spatial import cKDTree

from perception.geometry import AT_ONCE, nearest, sums_by

ROUNDS = 12  # iterations of Lloyd's algorithm; groups are merged later, so convergence is not needed
SAMPLE = 50_000  # rows from which the centres are computed; all rows are then assigned to the nearest centre
TOGETHER = 1000  # groups of one k-means
CHUNK = 1 << 11  # rows; their distances to all centres stay in the cache


def over_segment(means: np.ndarray, features: np.ndarray, count: int, seed: int = 0) -> np.ndarray:
    """Group [N] int64, 0 … S − 1 with S ≤ count, by k-means (Lloyd) on concatenated features and positions.

    means [N, 3], features [N, D]. Positions are scaled so that 90 % of the Gaussians lie within 1 of the median. This
    is also the loss's margin between features, so distant Gaussians are separated even if their features agree.
    For more than TOGETHER groups, the Gaussians are halved at the median of the axis on which they extend farthest.
    """
    if count > TOGETHER:
        axis = int(np.ptp(np.quantile(means, [0.05, 0.95], axis=0), axis=0).argmax())
        order = np.argsort(means[:, axis], kind="stable")
        halves = np.array_split(order, 2)
        pair = [over_segment(means[half], features[half], -(-count // 2), seed) for half in halves]
        groups = np.empty(len(means), np.int64)
        groups[order] = np.concatenate([pair[0], pair[1] + pair[0].max() + 1])
        return groups
    centred = means - np.median(means, axis=0)
    radius = float(np.quantile(np.linalg.norm(centred, axis=1), 0.9)) if len(means) else 1.0
    rows = np.concatenate([features, centred / max(radius, 1e-12)], axis=1).astype(np.float32)
    rng = np.random.default_rng(seed)
    sample = rows if len(rows) <= SAMPLE else rows[np.sort(rng.choice(len(rows), SAMPLE, replace=False))]
    centres = sample[np.sort(rng.choice(len(sample), min(count, len(sample)), replace=False))]
    for _ in range(ROUNDS):
        owner = nearest_centres(sample, centres)
        sizes = np.bincount(owner, minlength=len(centres))
        sums = sums_by(owner, sample, len(centres))
        centres = (sums[sizes > 0] / sizes[sizes > 0, None]).astype(np.float32)
    return np.unique(nearest_centres(rows, centres), return_inverse=True)[1].reshape(-1)


def nearest_centres(rows: np.ndarray, centres: np.ndarray) -> np.ndarray:
    """[N] int64: the nearest of centres [K, D] to each of rows [N, D], the first of equals."""
    half = 0.5 * (centres**2).sum(axis=1)
    owner = np.zeros(len(rows), np.int64)
    for begin in range(0, len(rows), CHUNK):
        product = rows[begin : begin + CHUNK] @ centres.T
        owner[begin : begin + CHUNK] = np.subtract(half, product, out=product).argmin(axis=1)
    return owner


def touching(means: np.ndarray, groups: np.ndarray, count: int) -> sparse.csr_matrix:
    """[S, S] bool, sparse: whether at least three pairs of nearby Gaussians connect the two groups.

    Nearby: among the 7 nearest, and within 3 × max(nearest-neighbour distance of the Gaussian, its median over all).
    """
    k = min(8, len(means))
    if k < 2:
        return sparse.csr_matrix((count, count), dtype=bool)
    distance, neighbour = nearest(cKDTree(means), means, range(1, k + 1))
    typical, pairs = np.median(distance[:, 1]), sparse.csr_matrix((count, count), dtype=np.int64)
    for at in range(0, len(means), AT_ONCE):
        piece = slice(at, at + AT_ONCE)
        reach = 3 * np.maximum(distance[piece, 1:2], typical)
        row, column = np.nonzero(distance[piece, 1:] <= reach)
        a, b = groups[piece][row], groups[neighbour[piece][row, column + 1]]
        apart = a != b
        pairs += sparse.csr_matrix((np.ones(apart.sum(), np.int64), (a[apart], b[apart])), shape=(count, count))
    return (pairs + pairs.T >= 3).tocsr()
