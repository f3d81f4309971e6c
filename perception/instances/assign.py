"""Agreement of each Gaussian's masks with its instance, and reassignment of Gaussians that disagree."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph
from scipy.spatial import cKDTree

from perception.geometry import nearest
from perception.masks.votes import MaskVotes

CHUNK, ENTRIES = 20_000, 10_000_000  # Gaussians, and their affinities with instances or 4 × weights, at once
NEIGHBOURS = 8  # nearest voters of a Gaussian
LEAST_AGREEMENT = 0.5  # affinity with an instance that a Gaussian may join: half of its pixels are in its masks
MARGIN = 0.15  # affinity by which another instance must be better
STRAYS, STRAY_SHARE = 16, 0.1  # Gaussians of a piece, and its share of its instance's largest, from which it may stay


def mask_shares(groups: MaskVotes) -> sparse.csr_matrix:
    """[K, M]: of the pixels of instance k under masks of a view, the fraction in each mask of that view."""
    _, _, first, labelled = groups.runs()
    shares = groups.pixels.copy()
    shares.data /= np.maximum(groups.per_entry(first, labelled), 1e-12).astype(np.float32)
    return shares


def affinities(votes: MaskVotes, shares: sparse.csr_matrix, rows: np.ndarray) -> tuple[sparse.csr_matrix, np.ndarray]:
    """Mean of `shares` over the pixels of each Gaussian [R, K], and its number of pixels under masks [R]."""
    pixels = votes.pixels[rows]
    total = np.asarray(pixels.sum(axis=1)).reshape(-1)
    mean = (pixels @ shares.T).tocsr()
    mean.data /= np.repeat(np.maximum(total, 1e-12), np.diff(mean.indptr))
    return mean, total


def _in_chunks(rows: np.ndarray, votes: MaskVotes, count: int) -> Iterator[np.ndarray]:
    """Parts of rows [R] whose affinities, with `count` instances each, are computed together."""
    size = min(CHUNK, ENTRIES // max(1, count, 4 * votes.pixels.nnz // max(1, votes.pixels.shape[0])) + 1)
    yield from (rows[begin : begin + size] for begin in range(0, len(rows), size))


def memberships(ids: np.ndarray, votes: MaskVotes) -> np.ndarray:
    """[N] float32 in [0, 1]: agreement of each Gaussian's masks with its instance (`affinities`); 0 for noise."""
    count = int(ids.max(initial=-1)) + 1
    shares = mask_shares(votes.of_groups(ids, count))
    agreement = np.zeros(len(ids), np.float32)
    for rows in _in_chunks(np.flatnonzero(ids >= 0), votes, int(np.diff(shares.indptr).max(initial=0))):
        pixels = votes.pixels[rows]
        own, total = (np.asarray(x.sum(axis=1)).reshape(-1) for x in (pixels.multiply(shares[ids[rows]]), pixels))
        agreement[rows] = own / np.maximum(total, 1e-12)
    return np.clip(agreement, 0, 1)


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

    shares = mask_shares(votes.of_groups(ids, count))
    tree = cKDTree(means[voters])
    near = min(NEIGHBOURS + 1, len(voters))
    holders = np.bincount(shares.indices, minlength=shares.shape[1])  # of each mask, instances that share it
    most = min(count, int(holders[votes.pixels.indices].sum()) // len(ids))  # affinities above 0, in the mean
    for rows in _in_chunks(np.flatnonzero(np.isfinite(means).all(axis=1)), votes, most):
        affinity, pixels = affinities(votes, shares, rows)
        neighbours = voters[nearest(tree, means[rows], range(1, near + 1))[1]]
        around = ids[neighbours]
        around[neighbours == rows[:, None]] = -1  # a Gaussian is not its own neighbour
        popular, support = _mode(around)
        at, own = np.arange(len(rows)), ids[rows]
        mine, theirs = (np.where(of >= 0, np.asarray(affinity[at, of]).reshape(-1), 0) for of in (own, popular))
        backed = (2 * support >= near - 1) & (pixels > 0) & (theirs >= LEAST_AGREEMENT)
        joins = backed & (own < 0) & (theirs >= affinity.max(axis=1).toarray().reshape(-1) - MARGIN)
        moves = backed & (own >= 0) & (theirs >= mine + MARGIN)
        assigned[rows] = np.where(joins | moves, popular, own)
    return assigned


def without_strays(ids: np.ndarray, means: np.ndarray, opacities: np.ndarray, min_opacity: float) -> np.ndarray:
    """ids [N] int32 without small pieces apart from their instance: floaters on the rays to it, which lie in its masks.

    means [N, 3], opacities [N]. A Gaussian is linked to those of its NEIGHBOURS nearest voters (`reassign`) that are of
    its instance. A piece of less than STRAYS Gaussians and STRAY_SHARE of the instance's largest piece gets id −1.
    """
    rows = np.flatnonzero((ids >= 0) & np.isfinite(means).all(axis=1))
    voters = rows[opacities[rows] >= min_opacity]
    near = min(NEIGHBOURS + 1, len(voters))
    if near < 2:
        return ids
    others = voters[nearest(cKDTree(means[voters]), means[rows], range(1, near + 1))[1]]
    row, column = np.nonzero(ids[others] == ids[rows][:, None])
    links = sparse.coo_matrix((np.ones(len(row), bool), (rows[row], others[row, column])), shape=(len(ids), len(ids)))
    piece = csgraph.connected_components(links, directed=False)[1]
    size = np.bincount(piece)[piece]
    largest = np.zeros(ids.max() + 1, np.int64)
    np.maximum.at(largest, ids[rows], size[rows])
    strays = (ids >= 0) & (size < STRAYS) & (size < STRAY_SHARE * largest[np.maximum(ids, 0)])
    return np.where(strays, -1, ids).astype(np.int32)


def _mode(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Most frequent id ≥ 0 of each row [R, k] (ties: the nearer one) and its count; −1 and 0 where there is none."""
    equal = (values[:, :, None] == values[:, None, :]) & (values[:, :, None] >= 0)
    counts = equal.sum(axis=2)
    first = counts.argmax(axis=1)
    at = np.arange(len(values))
    return np.where(counts[at, first] > 0, values[at, first], -1), counts[at, first]
