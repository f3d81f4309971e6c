"""Instances, their parts and their scores from Gaussians and mask votes.

segments    many small groups of Gaussians with similar feature and position       `segments`
consensus   segments merged and cut into instances and parts, by the masks         `masks.consensus`
            (not where labels are of one surface: a Gaussian has the label that most pixels give it)
settle      Gaussians move to the instance that masks and neighbours agree on      `assign`
score       the probability that an instance is an object                          `confidence`
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from perception.config import InstanceConfig
from perception.geometry import sums_by
from perception.instances.assign import LEAST_AGREEMENT, memberships, reassign, without_strays
from perception.instances.cluster import MIN_OPACITY, by_falling_size, cluster_gaussians
from perception.instances.confidence import calibrated, raw_scores
from perception.instances.segments import over_segment, touching
from perception.machine import return_free_memory
from perception.masks.consensus import best_cut, dendrogram, evidence, node_evidence, parts_of
from perception.masks.votes import MaskVotes

PER_SEGMENT = 16  # Gaussians; smaller segments have too little evidence in the photos
LEAST_SEGMENTS, MAX_SEGMENTS = 32, 1000
PER_SEGMENT_BEYOND = 300  # Gaussians of a segment in maps where that makes more than MAX_SEGMENTS: bounds the time
ROUNDS = 3  # in which Gaussians that disagree with their segment leave it
LEAST = 4  # Gaussians; smaller groups are dropped even if masks support them
LEAST_AREA = 15  # pixels of a mask at half the resolution: 60 of the photo
LEAST_OF_MEDIAN = 0.25  # size of a group that no photo supports, relative to the median


@dataclass(frozen=True)
class Grouping:
    """K instances of N Gaussians, their parts, and groups of instances.

    ids [N] int32: −1 = none, 0 … K − 1 by falling size; membership [N] float32 in [0, 1], see `assign.memberships`;
    scores [K] in [0, 1], calibrated.
    part_ids [N] int32: −1 = none, then K, K + 1, …; parents, part_scores, part_views: of each part, its instance, its
    score and the number of photos that show it. groups [K] int32: of each instance, −1 = none; group_scores [G].
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
    whole: bool = True,
    one_surface: bool = False,
) -> Grouping:
    """Instances of N Gaussians: means [N, 3], scales [N, 3], opacities [N], features [N, D] float32.

    margin: γ of the loss, the squared distance that it keeps between features of different objects. whole: they are all
    of the map's; else masks may be those of others, and what they show is no reason to keep a small group. one_surface:
    equal labels of two photos are of one thing, so there is nothing to find out from features and agreement.
    """
    features = np.where(np.isfinite(features), features, 0) / np.sqrt(margin)
    parts, parents = np.full(len(means), -1), np.zeros(0, np.int64)
    if config.method == "hdbscan":
        ids = cluster_gaussians(means, scales, opacities, features, config, seed)
    elif one_surface:
        ids = _by_labels(means, opacities, votes)
    else:
        ids, parts, parents = _by_consensus(means, opacities, features, votes, seed)
    if config.settle:
        ids = reassign(ids, means, opacities, votes, MIN_OPACITY)
        ids = _without_small(ids, votes, config.min_cluster_size, whole)
        ids = reassign(ids, means, opacities, votes, MIN_OPACITY)
        ids = without_strays(ids, means, opacities, MIN_OPACITY)
    return_free_memory()
    return scored(ids, parts, parents, votes)


def _by_labels(means: np.ndarray, opacities: np.ndarray, votes: MaskVotes) -> np.ndarray:
    """ids [N] int32: of each Gaussian the label in which it has most weight, −1 = in none."""
    weights = votes.of_labels()
    ids = np.full(len(means), -1, np.int32)
    shown = np.diff(weights.indptr) > 0
    if shown.any():  # scipy refuses the largest of nothing
        ids[shown] = np.asarray(weights[shown].argmax(axis=1)).reshape(-1)
    ids[(opacities < MIN_OPACITY) | ~np.isfinite(means).all(axis=1)] = -1
    return ids


def _by_consensus(
    means: np.ndarray, opacities: np.ndarray, features: np.ndarray, votes: MaskVotes, seed: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """ids [N] int32 and parts [N] int64 (−1 = none in both), and the instance of each part."""
    ids, parts, segment_of = np.full(len(means), -1, np.int32), np.full(len(means), -1), np.full(len(means), -1)
    solid = np.flatnonzero((opacities >= MIN_OPACITY) & np.isfinite(means).all(axis=1))
    if len(solid) == 0:
        return ids, parts, np.zeros(0, np.int64)
    most = max(MAX_SEGMENTS, len(solid) // PER_SEGMENT_BEYOND)
    wanted = int(np.clip(len(solid) // PER_SEGMENT, min(LEAST_SEGMENTS, len(solid)), most))
    segment_of[solid] = over_segment(means[solid], features[solid], wanted, seed)
    segments = np.unique(_parted_by_masks(segment_of, means, features, votes, seed)[solid], return_inverse=True)[1]
    segment_of[solid] = segments
    sizes = np.bincount(segments)
    segment_votes = votes.of_groups(segment_of, len(sizes))
    prototypes = sums_by(segments, features[solid], len(sizes)) / sizes[:, None]
    tree = dendrogram(segment_votes, prototypes, sizes, touching(means[solid], segments, len(sizes)))
    return_free_memory()  # tables grow with the photos; without this, those of each step lie beside the next one's
    seen = node_evidence(tree, segment_votes)
    return_free_memory()
    instance, part = np.full(tree.leaves, -1), np.full(tree.leaves, -1)  # of segments
    cut = best_cut(tree, seen.matched)
    for number, node in enumerate(cut):
        instance[tree.leaves_of(node)] = number
    below = parts_of(tree, cut, seen)
    for number, (_, node) in enumerate(below):
        part[tree.leaves_of(node)] = number
    ids[solid], parts[solid] = instance[segments], part[segments]
    return ids, parts, np.array([number for number, _ in below], np.int64)


def _parted_by_masks(
    segment_of: np.ndarray, means: np.ndarray, features: np.ndarray, votes: MaskVotes, seed: int
) -> np.ndarray:
    """segment_of [N] (−1 = none), where Gaussians whose masks disagree with their segment form segments of their own.

    A coin on a table has so few Gaussians that the table's segments take them in. ROUNDS times, those that are left
    over are cut anew, each time into smaller segments. What is mostly seen where no mask is stays where it is.
    """
    shown = [np.asarray(table.sum(axis=1)).reshape(-1) for table in (votes.pixels, votes.void)]
    masked = (segment_of >= 0) & (shown[0] > shown[1])
    for size in (PER_SEGMENT >> n for n in range(ROUNDS)):
        apart = np.flatnonzero(masked & (memberships(segment_of, votes) < LEAST_AGREEMENT))
        if len(apart) < LEAST:
            break
        segment_of = segment_of.copy()
        first = segment_of.max() + 1
        segment_of[apart] = first + over_segment(means[apart], features[apart], -(-len(apart) // size), seed)
    return segment_of


def _without_small(ids: np.ndarray, votes: MaskVotes, min_size: int, whole: bool) -> np.ndarray:
    """Sets ids to −1 for two kinds of groups: below `min_size` and supported by fewer than two photos; supported by no
    photo and smaller than LEAST_OF_MEDIAN of the median group. If `whole`, none is what two photos show (`_shown`)."""
    count = int(ids.max(initial=-1)) + 1
    if count == 0:
        return ids
    sizes = np.bincount(ids[ids >= 0], minlength=count)
    groups = votes.of_groups(ids, count)
    support = evidence(groups).support
    kept = (sizes >= min_size) | ((sizes >= LEAST) & (support >= 2))
    kept &= (support > 0) | (sizes >= LEAST_OF_MEDIAN * np.median(sizes[sizes > 0]))
    if whole:
        kept |= (sizes >= LEAST) & (_shown(groups) >= 2)
    return np.where((ids >= 0) & np.append(kept, False)[ids], ids, -1)


def _shown(groups: MaskVotes) -> np.ndarray:
    """[K] number of masks of LEAST_AREA or more that fit no other group as well, in which most of the group lies: what
    straddles their border may hide most of such a mask, so that the group's own IoU with it is small."""
    row, _, first, labelled = groups.runs()
    pixels, mask = groups.pixels.data.astype(np.float64), groups.pixels.indices
    filled = groups.per_entry(first, labelled + np.asarray(groups.void[row, groups.view[mask[first]]]).reshape(-1))
    iou = pixels / np.maximum(filled + groups.area[mask] - pixels, 1e-12)
    best = np.zeros(len(groups.area))
    np.maximum.at(best, mask, iou)
    fits = (iou == best[mask]) & (pixels >= LEAST_AGREEMENT * filled) & (groups.area[mask] >= LEAST_AREA)
    return np.bincount(groups.per_entry(first, row)[fits], minlength=groups.pixels.shape[0])


def scored(ids: np.ndarray, parts: np.ndarray, parents: np.ndarray, votes: MaskVotes) -> Grouping:
    """Renumbers the instances by size, and scores them and their parts."""
    old = np.append(ids, parents.max(initial=-1))
    ids = by_falling_size(ids)
    renamed = np.full(old.max() + 2, -1)  # −1 for groups without members; the last entry is for id −1
    renamed[old[:-1]] = ids
    membership = memberships(ids, votes)
    seen = evidence(votes.of_groups(ids, int(ids.max(initial=-1)) + 1))
    scores = calibrated(raw_scores(ids, membership, seen))
    return Grouping(ids, membership, scores, *scored_parts(ids, parts, renamed[parents], votes))


def scored_parts(
    ids: np.ndarray, parts: np.ndarray, parents: np.ndarray, votes: MaskVotes
) -> tuple[np.ndarray, list[int], list[float], list[int]]:
    """`part_ids`, `parents`, `part_scores` (agreement with the masks) and `part_views` of a Grouping.

    parts [N]: −1 = none; parents: the instance of each. Gaussians outside it and parts under LEAST are left out.
    """
    inside = np.where((parts >= 0) & (ids >= 0) & (np.append(parents, -1)[parts] == ids), parts, -1)
    kept = np.flatnonzero(np.bincount(inside[inside >= 0], minlength=len(parents)) >= LEAST)
    renamed = np.full(len(parents) + 1, -1)  # the last entry is for −1
    renamed[kept] = np.arange(len(kept))
    number = renamed[inside]
    seen = evidence(votes.of_groups(number, len(kept)))
    part_ids = np.where(number >= 0, number + ids.max(initial=-1) + 1, -1).astype(np.int32)
    return part_ids, parents[kept].tolist(), np.clip(seen.agreement, 0, 1).tolist(), seen.views.tolist()
