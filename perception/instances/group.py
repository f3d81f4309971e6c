"""Instances, their parts and their scores from Gaussians and mask votes. Calls the stages in order."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from perception.config import InstanceConfig
from perception.geometry import sums_by
from perception.instances.assign import memberships, reassign
from perception.instances.cluster import MIN_OPACITY, by_falling_size, cluster_gaussians
from perception.instances.confidence import calibrated, raw_scores
from perception.instances.consensus import (
    Evidence,
    MergeTree,
    best_cut,
    evidence,
    merge_tree,
    node_evidence,
    parts_of,
)
from perception.instances.segments import over_segment, touching
from perception.instances.votes import MaskVotes
from perception.machine import return_free_memory

PER_SEGMENT = 16  # Gaussians; smaller segments have too little evidence in the photos
MAX_SEGMENTS, PER_SEGMENT_BEYOND = 1000, 300  # a larger map has one segment per 300 Gaussians instead
LEAST = 4  # Gaussians; smaller groups are dropped even if masks support them


@dataclass(frozen=True)
class Grouping:
    """ids [N] int32: −1 = none, 0 … K − 1 by falling size; membership [N] float32 in [0, 1], 0 for noise; scores [K] in
    [0, 1], calibrated.

    part_ids [N] int32: −1 = none, then K, K + 1, …; parents, part_scores, part_views: instance, score, views per part.
    groups [K] int32: group of each instance, −1 = none; group_scores [G].
    """

    ids: np.ndarray
    membership: np.ndarray
    scores: np.ndarray
    part_ids: np.ndarray
    parents: list[int] = field(default_factory=list)
    part_scores: list[float] = field(default_factory=list)
    part_views: list[int] = field(default_factory=list)
    groups: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int32))
    group_scores: np.ndarray = field(default_factory=lambda: np.zeros(0, np.float32))

    @property
    def count(self) -> int:
        return len(self.scores)


def group(
    means: np.ndarray,
    scales: np.ndarray,
    opacities: np.ndarray,
    features: np.ndarray,
    votes: MaskVotes,
    config: InstanceConfig,
    *,
    margin: float = 1.0,
    seed: int = 0,
) -> Grouping:
    """Instances of N Gaussians: means [N, 3], scales [N, 3], opacities [N], features [N, D] float32.

    margin: γ of the loss, the squared distance that it keeps between features of different objects.
    """
    features = np.where(np.isfinite(features), features, 0) / np.sqrt(margin)
    if config.method == "hdbscan":
        ids = cluster_gaussians(means, scales, opacities, features, config, seed)
        parts = np.full(len(ids), -1, np.int64)
        parents = np.zeros(0, np.int64)
    else:
        ids, parts, parents = _by_consensus(means, opacities, features, votes, seed)
    if config.settle:
        ids = reassign(ids, means, opacities, votes, MIN_OPACITY)
        ids = _without_small(ids, votes, config)
        ids = reassign(ids, means, opacities, votes, MIN_OPACITY)
    return_free_memory()
    return _scored(ids, parts, parents, votes)


def _by_consensus(
    means: np.ndarray, opacities: np.ndarray, features: np.ndarray, votes: MaskVotes, seed: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """ids [N] int32 and parts [N] int64 (−1 = none in both), and the instance of each part."""
    ids, parts = np.full(len(means), -1, np.int32), np.full(len(means), -1, np.int64)
    solid = np.flatnonzero((opacities >= MIN_OPACITY) & np.isfinite(means).all(axis=1))
    if len(solid) == 0:
        return ids, parts, np.zeros(0, np.int64)
    most = max(MAX_SEGMENTS, len(solid) // PER_SEGMENT_BEYOND)
    wanted = int(np.clip(len(solid) // PER_SEGMENT, min(32, len(solid)), most))
    segments = over_segment(means[solid], features[solid], wanted, seed)
    count = int(segments.max()) + 1
    everywhere = np.full(len(means), -1, np.int64)
    everywhere[solid] = segments
    table = votes.table(everywhere, count)
    sizes = np.bincount(segments, minlength=count)
    sums = sums_by(segments, features[solid], count)
    near = touching(means[solid], segments, count)
    tree = merge_tree(table, sums / sizes[:, None], sizes, near)
    return_free_memory()  # tables grow with the photos; without this, those of each step lie beside the next one's
    found = node_evidence(tree, table)
    return_free_memory()
    instance, part, parents = _cut(tree, found)
    ids[solid], parts[solid] = instance[segments], part[segments]
    return ids, parts, parents


def _cut(tree: MergeTree, found: Evidence) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Instance and part (−1 = none) of each leaf, and the instance of each part."""
    instance, part = np.full(tree.leaves, -1, np.int32), np.full(tree.leaves, -1, np.int64)
    parents: list[int] = []
    for number, node in enumerate(best_cut(tree, found.matched)):
        instance[tree.leaves_of(node)] = number
        for piece in parts_of(tree, node, found):
            part[tree.leaves_of(piece)] = len(parents)
            parents.append(number)
    return instance, part, np.array(parents, np.int64)


def _without_small(ids: np.ndarray, votes: MaskVotes, config: InstanceConfig) -> np.ndarray:
    """Sets ids to −1 for two kinds of groups: below `min_cluster_size` and supported by fewer than two photos;
    supported by no photo and smaller than a quarter of the median group."""
    count = int(ids.max(initial=-1)) + 1
    if count == 0:
        return ids
    sizes = np.bincount(ids[ids >= 0], minlength=count)
    support = evidence(votes.table(ids, count)).support
    kept = (sizes >= config.min_cluster_size) | ((sizes >= LEAST) & (support >= 2))
    kept &= (support > 0) | (sizes >= 0.25 * np.median(sizes[sizes > 0]))
    return np.where((ids >= 0) & np.append(kept, False)[ids], ids, -1)


def _scored(ids: np.ndarray, parts: np.ndarray, parents: np.ndarray, votes: MaskVotes) -> Grouping:
    """Renumbers the instances by size, and scores them and their parts."""
    before = ids
    ids = by_falling_size(before)
    rename = np.full(max(int(before.max(initial=-1)) + 2, int(parents.max(initial=-1)) + 2), -1)
    rename[before] = ids  # −1 for groups without members; the last entry is for id −1
    membership = memberships(ids, votes)
    found = evidence(votes.table(ids, int(ids.max(initial=-1)) + 1))
    calibrated_scores = calibrated(raw_scores(ids, membership, found))
    part_ids, owners, scores, views = scored_parts(ids, parts, rename[:-1][parents], votes)
    return Grouping(ids, membership, calibrated_scores, part_ids, owners, scores, views)


def scored_parts(
    ids: np.ndarray, parts: np.ndarray, parents: np.ndarray, votes: MaskVotes
) -> tuple[np.ndarray, list[int], list[float], list[int]]:
    """Part ids, numbered after the instances, and per part: its instance, its score (mask agreement), its views."""
    whole = np.append(parents, -1)[parts]
    inside = np.where((parts >= 0) & (whole == ids) & (ids >= 0), parts, -1)
    left = np.flatnonzero(np.bincount(inside[inside >= 0], minlength=len(parents)) >= LEAST)
    rename = np.full(len(parents) + 1, -1)
    rename[left] = np.arange(len(left))
    number = rename[inside]
    found = evidence(votes.table(number, len(left)))
    first = int(ids.max(initial=-1)) + 1
    part_ids = np.where(number >= 0, number + first, -1).astype(np.int32)
    return part_ids, parents[left].tolist(), np.clip(found.agreement, 0, 1).tolist(), found.views.tolist()
