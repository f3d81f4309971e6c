"""Agreement of each Gaussian's masks with its instance, and reassignment of Gaussians that disagree."""

from __future__ import annotations

import numpy as np
from scipy import sparse

from perception.instances.votes import MaskVotes, Table

CHUNK, ENTRIES = 20_000, 10_000_000  # Gaussians, and their affinities with all instances or 4 × weights, at once
NEIGHBOURS = 8
LEAST_AGREEMENT = 0.5
MARGIN = 0.15


def mask_shares(table: Table) -> sparse.csr_matrix:
    """[K, M]: of the pixels of instance k under masks of a view, the fraction in each mask of that view."""
    _, _, first, labelled = table.runs()
    shares = table.pixels.copy()
    shares.data /= np.maximum(table.per_entry(first, labelled), 1e-12).astype(np.float32)
    return shares


def affinities(votes: MaskVotes, shares: sparse.csr_matrix, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean of `shares` over the pixels of each Gaussian [R, K], and its number of pixels under masks [R]."""
    weights = votes.weights[rows]
    pixels = np.asarray(weights.sum(axis=1)).reshape(-1)
    return (weights @ shares.T).toarray() / np.maximum(pixels, 1e-12)[:, None], pixels


def _at_once(votes: MaskVotes, count: int) -> int:
    """The number of Gaussians whose affinities with `count` instances are computed together."""
    return min(CHUNK, ENTRIES // max(1, count, 4 * votes.weights.nnz // max(1, votes.weights.shape[0])) + 1)


def memberships(ids: np.ndarray, votes: MaskVotes) -> np.ndarray:
    """[N] float32 in [0, 1]: agreement of each Gaussian's masks with its instance (`affinities`); 0 for noise."""
    count = int(ids.max(initial=-1)) + 1
    shares = mask_shares(votes.table(ids, count))
    found = np.zeros(len(ids), np.float32)
    chunk = _at_once(votes, count)
    for begin in range(0, len(ids), chunk):
        rows = begin + np.flatnonzero(ids[begin : begin + chunk] >= 0)
        if len(rows):
            found[rows] = affinities(votes, shares, rows)[0][np.arange(len(rows)), ids[rows]]
    return np.clip(found, 0, 1)


def reassign(
    ids: np.ndarray, means: np.ndarray, opacities: np.ndarray, votes: MaskVotes, min_opacity: float
) -> np.ndarray:
    """Assigns unassigned Gaussians and corrects misassigned ones, where masks and spatial neighbours agree.

    ids [N] int32 (−1 = none), means [N, 3], opacities [N]. Voters are assigned Gaussians with at least `min_opacity`.
    The candidate is the instance of at least half of a Gaussian's 8 nearest voters, with affinity ≥ LEAST_AGREEMENT. An
    unassigned Gaussian joins it if no other instance has an affinity higher by more than MARGIN. An assigned one moves
    if the candidate's affinity is higher than its instance's by MARGIN. Others are unchanged. Returns ids [N] int32.
    """
    count = int(ids.max(initial=-1)) + 1
    assigned = ids.astype(np.int32)
    voters = np.flatnonzero((ids >= 0) & (opacities >= min_opacity))
    if count == 0 or len(voters) < 2:
        return assigned
    from scipy.spatial import cKDTree

    shares = mask_shares(votes.table(ids, count))
    tree = cKDTree(means[voters])
    near = min(NEIGHBOURS + 1, len(voters))
    finite = np.flatnonzero(np.isfinite(means).all(axis=1))
    chunk = _at_once(votes, count)
    for begin in range(0, len(finite), chunk):
        rows = finite[begin : begin + chunk]
        affinity, pixels = affinities(votes, shares, rows)
        _, found = tree.query(means[rows], k=near, workers=-1)
        around = ids[voters[found]]
        around[voters[found] == rows[:, None]] = -1  # a Gaussian is not its own neighbour
        popular, support = _mode(around)
        at, own = np.arange(len(rows)), ids[rows]
        mine = np.where(own >= 0, affinity[at, own], 0)
        theirs = np.where(popular >= 0, affinity[at, popular], 0)
        backed = (2 * support >= near - 1) & (pixels > 0) & (theirs >= LEAST_AGREEMENT)
        joins = backed & (own < 0) & (theirs >= affinity.max(axis=1) - MARGIN)
        moves = backed & (own >= 0) & (theirs >= mine + MARGIN)
        assigned[rows] = np.where(joins | moves, popular, own)
    return assigned


def _mode(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Most frequent id ≥ 0 of each row [R, k] (ties: the nearer one) and its count; −1 and 0 where there is none."""
    equal = (values[:, :, None] == values[:, None, :]) & (values[:, :, None] >= 0)
    counts = equal.sum(axis=2)
    first = counts.argmax(axis=1)
    at = np.arange(len(values))
    return np.where(counts[at, first] > 0, values[at, first], -1), counts[at, first]
