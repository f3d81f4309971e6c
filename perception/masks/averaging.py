"""One segmentation of a surface from several, of which none is to be trusted alone.

Merges are greedy: where voxels begin, by a fraction of their side, changes which patches there are, and one wrong merge
early can join two things. Each segmentation is taken for a photo and its segments for masks (`consensus`): the segments
of all are cut into pieces that none divides, and these are joined as most segmentations have them together.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import sparse

from perception.masks.consensus import best_cut, dendrogram, node_evidence
from perception.masks.merging import Segmentation, nested
from perception.masks.votes import MaskVotes


def averaged(first: Segmentation, others: Sequence[tuple[np.ndarray, np.ndarray]]) -> Segmentation:
    """`first` with segments on which it and the others agree most.

    others: segment [V] int of each voxel of `first`, numbered from 1, 0 = none, and probability [S + 1] of each. The
    probability of the new ones: the mean, over all segmentations, of the segment's that fits best, times its IoU.
    """
    segments = [first.segment, *(segment for segment, _ in others)]
    probability = [first.probability, *(probability for _, probability in others)]
    rows, piece = np.unique(np.stack(segments, axis=1), axis=0, return_inverse=True)
    voxels = np.bincount(piece.reshape(-1)).astype(np.float32)
    votes = _votes(rows, voxels, [len(each) - 1 for each in probability])
    alone = sparse.csr_matrix((len(rows), len(rows)), dtype=bool)
    tree = dendrogram(votes, np.zeros((len(rows), 1)), np.ones(len(rows)), alone)
    cut = best_cut(tree, node_evidence(tree, votes).matched)

    owner, sizes = np.zeros(len(rows), np.int64), np.zeros(len(cut) + 1)
    for number, node in enumerate(cut, start=1):
        leaves = tree.leaves_of(node)
        owner[leaves], sizes[number] = number, voxels[leaves].sum()
    found = votes.of_groups(owner - 1, len(cut))
    row, _, first_of, _ = found.runs()
    shared, mask = found.pixels.data, found.pixels.indices
    iou = shared / (sizes[1:][found.per_entry(first_of, row)] + votes.area[mask] - shared)
    fitting = iou * np.concatenate([each[1:] for each in probability])[mask]
    best = np.maximum.reduceat(fitting, first_of) if len(first_of) else np.zeros(0)
    odds = np.append(0, np.bincount(row, best, minlength=len(cut)) / len(segments))

    least = np.bincount(first.segment)[1:].min(initial=len(piece))  # what one segmentation keeps
    sizes[(sizes < least) | (np.append(0, np.diff(found.pixels.indptr)) == 0)] = 0
    order = np.argsort(-sizes[1:], kind="stable") + 1
    order = order[sizes[order] > 0]
    rank = np.zeros(len(sizes), np.int32)
    rank[order] = np.arange(1, len(order) + 1)
    parts = first.part, first.part_probability
    groups = first.group[first.segment], first.group_probability
    return nested(first.points, rank[owner[piece.reshape(-1)]], np.append(0, odds[order]), parts, groups)


def _votes(rows: np.ndarray, voxels: np.ndarray, counts: Sequence[int]) -> MaskVotes:
    """Votes of pieces with `voxels` [A] each, in the segments rows [A, K] of K segmentations of `counts` segments."""
    pieces, many = rows.shape
    starts = np.cumsum([0, *counts])
    piece, each = np.divmod(np.arange(rows.size), many)
    known = rows.reshape(-1) > 0
    column, weight = rows.reshape(-1) - 1 + starts[each], voxels[piece]
    pixels = sparse.csr_matrix((weight[known], (piece[known], column[known])), shape=(pieces, starts[-1]))
    void = sparse.csr_matrix((weight[~known], (piece[~known], each[~known])), shape=(pieces, many))
    area = np.asarray(pixels.sum(axis=0), np.float64).reshape(-1)
    return MaskVotes(pixels, void, np.repeat(np.arange(many), counts), area)
