"""Instances without those that are hardly objects; their scores, parts and groups from the cuts of the surface that the
built-in masks made.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from perception.geometry import nearest
from perception.instances.assign import reassign
from perception.instances.cluster import MIN_OPACITY
from perception.instances.group import Grouping, scored, scored_parts
from perception.masks.consensus import LARGEST_PART
from perception.masks.merging import Segmentation
from perception.masks.votes import MaskVotes

LEAST_PART = 32  # Gaussians; smaller parts are not kept
ODDS = 2.5  # fitted to the 71 instances of maps of two made worlds
LEAST_SCORE = 0.05  # instances of less are pieces of others, as a rule; from 0.1 on, small things are lost too


def without_faint(
    grouping: Grouping, means: np.ndarray, opacities: np.ndarray, votes: MaskVotes, cuts: Segmentation | None = None
) -> Grouping:
    """The grouping, by `with_levels` if there are cuts, in which the Gaussians of instances below LEAST_SCORE are those
    of their neighbours or of none. means [N, 3], opacities [N]. What no mask of other sources shows, 0, is kept."""
    found = grouping if cuts is None else with_levels(grouping, means, votes, cuts)
    faint = (found.scores < LEAST_SCORE) & ((found.scores > 0) | (cuts is not None))
    if not faint.any():
        return found
    left = np.where(np.append(faint, False)[found.ids], -1, found.ids)  # the last for −1
    ids = reassign(left, means, opacities, votes, MIN_OPACITY)
    parts = np.where(found.part_ids >= 0, found.part_ids - found.count, -1)
    kept = scored(ids, parts, np.array(found.parents, np.int64), votes)
    return kept if cuts is None else with_levels(kept, means, votes, cuts)


def with_levels(grouping: Grouping, means: np.ndarray, votes: MaskVotes, cuts: Segmentation) -> Grouping:
    """The grouping of N Gaussians at means [N, 3] with scores, parts and groups by the segments of the nearest voxels.

    An instance's score has ODDS times the odds of q: the probability that the segment of most of its Gaussians is an
    object, times the IoU of the two in Gaussians, which is low also where voxels are coarse. Instances whose segments
    are one at the coarser cut are a group.
    """
    rows = np.flatnonzero((grouping.ids >= 0) & np.isfinite(means).all(axis=1))
    if not len(rows) or len(cuts.probability) < 2:
        return grouping
    voxel = nearest(cKDTree(cuts.points), means[rows], [1])[1][:, 0]
    both = np.zeros((grouping.count, len(cuts.probability)))
    np.add.at(both, (grouping.ids[rows], cuts.segment[voxel]), 1)
    sizes, own = both.sum(axis=1), both[:, 1:].argmax(axis=1) + 1
    shared = both[np.arange(grouping.count), own]
    q = cuts.probability[own] * shared / np.maximum(sizes + both.sum(axis=0)[own] - shared, 1)

    width = len(cuts.part_probability)
    pairs = grouping.ids[rows] * np.int64(width) + cuts.part[voxel]  # of instance and part
    keys, index, count = np.unique(pairs, return_inverse=True, return_counts=True)
    kept = (count >= LEAST_PART) & (count <= LARGEST_PART * sizes[keys // width])
    parts = np.full(len(means), -1, np.int64)
    parts[rows] = np.where(kept, np.cumsum(kept) - 1, -1)[index]
    part_ids, parents, _, views = scored_parts(grouping.ids, parts, keys[kept] // width, votes)
    several = np.bincount(cuts.group[own[shared > 0]], minlength=len(cuts.group_probability)) > 1
    return replace(
        grouping,
        scores=ODDS * q / (1 - q + ODDS * q),
        part_ids=part_ids,
        parents=parents,
        part_scores=cuts.part_probability[keys[kept] % width].tolist(),
        part_views=views,
        groups=np.where(several[cuts.group[own]] & (shared > 0), np.cumsum(several)[cuts.group[own]] - 1, -1),
        group_scores=cuts.group_probability[several].astype(np.float32),
    )
