"""Divides the surface into objects: the best cut of a tree of merges; then joins large coplanar parts.

The most likely pair of neighbours is merged first, and the evidence is recomputed after every merge (Nunez-Iglesias et
al. 2013), until nothing is left to merge. The cut maximises Σ (p − cost) over its regions, where p is the learned
probability that a region is an object. Small neural networks give the probabilities; `python tools training.masks`
makes their packaged weights from rendered worlds alone, see docs/masks.md.

Log odds of a probability p: log(p / (1 − p)). R: patches of the graph; M: merges; R + M: regions of the tree.
"""

from __future__ import annotations

import functools
import heapq
import itertools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from perception.masks.merge_features import REGION_FEATURES, pair_features, region_features
from perception.masks.surface_graph import SurfaceGraph

WEIGHTS = Path(__file__).with_name("merge_weights.npz")
SMALLEST = 2e-4  # area / depth² below which a patch joins a neighbour before all others do
GROUP_COST = 0.4  # of one more group, in units of an object's probability
PART_COST = 1 / 3  # of one more part, relative to that of an object
_LARGE = 0.1  # area / depth² above which a flat segment can be a part of a floor, a wall or a table
_FLAT = 0.03  # relative to depth: standard deviation of such a segment across its plane, including low objects on it
_UNKNOWN = 9.0  # largest log odds of a feature, and those of merges inside a patch
_CLIP = 5.0  # standard deviations: inputs far from all training data do not extrapolate
_ARRAYS = 8  # of a network

HISTORY = ("lowest_odds", "last_odds", "patches", "next_odds")
"""Log odds of the least likely merge inside a region, of its last merge, logarithm of its number of patches, and log
odds of the merge that it goes into."""
REGION_COLUMNS = (*HISTORY, *REGION_FEATURES)


@dataclass(frozen=True)
class Network:
    """The mean of E multilayer perceptrons with ReLU. parts: mean and scale of the inputs [F], then for each of three
    layers weights [E, out, in] and biases [E, 1, out]. All float32."""

    parts: tuple[np.ndarray, ...]

    def __call__(self, inputs: np.ndarray) -> np.ndarray:
        """[M, F] -> [M, out]. einsum without BLAS: its sums have one order, whatever the number of threads."""
        mean, scale, *layers = self.parts
        x = np.clip((inputs - mean) / scale, -_CLIP, _CLIP).astype(np.float32)
        x = np.broadcast_to(x, (len(layers[0]), *x.shape))
        for k in range(0, len(layers), 2):
            x = np.einsum("emi,eoi->emo", np.maximum(x, 0) if k else x, layers[k]) + layers[k + 1]
        return np.asarray(x.mean(axis=0))


@dataclass(frozen=True)
class MergeModel:
    """pair: `pair_features` of two neighbours -> [M, 1] log odds that they are one object.

    region: features of a region (MergeTree.features) -> [R + M, 2] log odds that its IoU with an object exceeds 0.5,
    0.75. cost: of one more object, in units of an object's probability. calibration: slope and offset of the first log
    odds of regions that were selected.
    """

    pair: Network
    region: Network
    cost: float
    calibration: tuple[float, float] = (1.0, 0.0)

    def probabilities(self, tree: MergeTree) -> tuple[np.ndarray, np.ndarray]:
        """[R + M] each: mean probability of both IoU, by which the tree is cut; calibrated one of IoU > 0.5."""
        odds = self.region(tree.features).astype(np.float64)
        slope, offset = self.calibration
        return _logistic(odds).mean(axis=1), _logistic(slope * odds[:, 0] + offset)


@functools.cache
def read_model(file: Path = WEIGHTS) -> MergeModel:
    """The model of the package, or of another file of `tools/training/masks.py`."""
    with np.load(file) as stored:
        settings, *arrays = (stored[f"arr_{k}"] for k in range(1 + 2 * _ARRAYS))
    cost, slope, offset = settings.tolist()
    return MergeModel(Network(tuple(arrays[:_ARRAYS])), Network(tuple(arrays[_ARRAYS:])), cost, (slope, offset))


Regions = tuple[np.ndarray, np.ndarray]  # the region [V] of each voxel, and the probability of each region


@dataclass(frozen=True)
class Segmentation:
    """Three cuts of a surface of V voxels into segments, their parts, and groups of them.

    points: [V, 3] float32, world frame. segment: [V] int32 of each voxel, numbered from 1 by falling size; 0 for small
    patches without neighbours. part: [V] int32; each lies in one segment. group: [S + 1] int32 of each segment. The
    others are probabilities that the IoU with an object exceeds 0.5: of segments [S + 1], parts and groups.
    """

    points: np.ndarray
    segment: np.ndarray
    probability: np.ndarray
    part: np.ndarray
    part_probability: np.ndarray
    group: np.ndarray
    group_probability: np.ndarray


def segmentation(graph: SurfaceGraph) -> Segmentation:
    """The cuts with the packaged model, at its cost of an object, at PART_COST of it, and at GROUP_COST; such cuts are
    nested."""
    model = read_model()
    tree = tree_by(model, graph)
    segment, probability = divided(graph, tree, model)
    p, calibrated = model.probabilities(tree)
    fine, coarse = (tree.cut(p - cost)[graph.patch] for cost in (model.cost * PART_COST, GROUP_COST))
    points = graph.surface.points.astype(np.float32)
    return nested(points, segment, probability, (fine, calibrated), (coarse, calibrated))


def nested(
    points: np.ndarray, segment: np.ndarray, probability: np.ndarray, fine: Regions, coarse: Regions
) -> Segmentation:
    """The segments of a `Segmentation`; their parts, where they cross the regions of a finer cut; and their groups, the
    regions of a coarser cut with most of their voxels."""
    region, of_region = fine
    pairs, part = np.unique(segment * np.int64(len(of_region)) + region, return_inverse=True)
    part_probability = of_region[pairs % len(of_region)]
    region, of_region = coarse
    used, region = np.unique(region, return_inverse=True)  # few of all regions of the tree
    shared = np.zeros((len(probability), len(used)), np.int64)  # voxels of each segment in each region
    np.add.at(shared, (segment, region), 1)
    groups, group = np.unique(shared.argmax(axis=1), return_inverse=True)
    return Segmentation(points, segment, probability, part, part_probability, group, of_region[used[groups]])


def tree_by(model: MergeModel, graph: SurfaceGraph) -> MergeTree:
    """The tree of merges in the order of the model's log odds."""
    return merge_tree(graph, lambda state, pairs: model.pair(pair_features(state, pairs))[:, 0])


def divided(graph: SurfaceGraph, tree: MergeTree, model: MergeModel) -> tuple[np.ndarray, np.ndarray]:
    """`segment` [V] and `probability` [S + 1] of a Segmentation, from a tree of the graph."""
    p, calibrated = model.probabilities(tree)
    regions = tree.cut(p - model.cost)
    graph, patch = graph.copy(), list(range(tree.leaves))  # the patch of the graph that each region is merged into
    for k, (one, two) in enumerate(tree.children.tolist(), start=tree.leaves):
        patch.append(patch[one])
        if regions[patch[one]] >= k:  # a merge within a region of the cut
            graph.merge(patch[one], patch[two])
    ends = join_planes(graph, np.array(patch)[regions])
    ends[[graph.area(end) < SMALLEST for end in ends.tolist()]] = -1
    names, index, counts = np.unique(ends[graph.patch], return_inverse=True, return_counts=True)
    order = np.argsort(np.where(names < 0, -np.inf, -counts), kind="stable")
    rank = np.argsort(order).astype(np.int32) + np.int32(names[0] >= 0)
    probability = np.zeros(int(rank.max()) + 1)
    probability[rank] = [0 if name < 0 else calibrated[regions[ends == name]].max() for name in names]
    return rank[index], probability


def _logistic(odds: np.ndarray) -> np.ndarray:
    return np.asarray(1 / (1 + np.exp(-odds)))


@dataclass(frozen=True)
class MergeTree:
    """Leaves 0 … R − 1 are the patches, then one region per merge, in order. children: [M, 2], the larger one first.
    features: [R + M, 6 F + 3], F REGION_COLUMNS of each region, then those of its relatives (`_with_relatives`)."""

    leaves: int
    children: np.ndarray
    features: np.ndarray

    def cut(self, gain: np.ndarray) -> np.ndarray:
        """[R] the region of each leaf, in the set of disjoint regions with the largest sum of `gain` [R + M].

        best_k = max(gain_k, best_one + best_two) for the children one and two of k; at ties the region is not divided.
        """
        best = gain.astype(np.float64)
        owner = np.arange(len(gain))
        undivided = np.ones(len(gain), bool)
        for k, (one, two) in enumerate(self.children.tolist(), start=self.leaves):
            if best[one] + best[two] > best[k]:
                best[k], undivided[k] = best[one] + best[two], False
        for k in range(len(gain) - 1, self.leaves - 1, -1):
            if undivided[k] or owner[k] != k:
                owner[self.children[k - self.leaves]] = owner[k]
        return owner[: self.leaves]


def merge_tree(graph: SurfaceGraph, score: Callable[[SurfaceGraph, np.ndarray], np.ndarray]) -> MergeTree:
    """Merges the most likely pair of neighbours until no neighbours are left; patches under SMALLEST come first.
    score: (graph as merged so far, pairs [M, 2]) -> [M] log odds that the two are one; −inf: never merge."""
    graph = graph.copy()
    count = graph.count
    region = list(range(count))  # the last region of each patch that others were merged into, −1 once it is merged
    lowest, last, leaves = [_UNKNOWN] * count, [_UNKNOWN] * count, [1] * count  # HISTORY of each region
    features: dict[int, np.ndarray] = {}
    children: list[tuple[int, int]] = []
    version = np.zeros(count, np.int64)  # a queue entry is stale if either patch was merged since
    queue: list[tuple[bool, float, int, int, int, int]] = []

    def offer(pairs: list[tuple[int, int]]) -> None:
        if not pairs:
            return
        for (a, b), odds in zip(pairs, score(graph, np.array(pairs)).tolist(), strict=True):
            if odds > -np.inf:
                large = min(graph.area(a), graph.area(b)) >= SMALLEST
                heapq.heappush(queue, (large, -odds, a, b, int(version[a]), int(version[b])))

    def describe(a: int, sibling: int | None, odds: float) -> None:
        k = region[a]
        history = [lowest[k], last[k], np.log(leaves[k]), odds]
        features[k] = np.concatenate([np.clip(history, -_UNKNOWN, _UNKNOWN), region_features(graph, a, sibling)])

    offer([(a, b) for a, links in enumerate(graph.borders) for b in links if a < b])
    while queue:
        _, odds, a, b, version_a, version_b = heapq.heappop(queue)
        if version[a] != version_a or version[b] != version_b:
            continue
        if graph.size(a) < graph.size(b):
            a, b = b, a
        describe(a, b, -odds)
        describe(b, a, -odds)
        lowest.append(min(-odds, lowest[region[a]], lowest[region[b]]))
        last.append(-odds)
        leaves.append(leaves[region[a]] + leaves[region[b]])
        children.append((region[a], region[b]))
        graph.merge(a, b)
        region[a], region[b] = len(leaves) - 1, -1
        version[[a, b]] += 1
        offer([(a, other) for other in graph.borders[a]])
    for a in range(count):
        if region[a] >= 0:
            describe(a, None, -_UNKNOWN)
    own = np.array([features[k] for k in range(len(leaves))], np.float32)
    pairs = np.array(children, np.int64).reshape(-1, 2)
    return MergeTree(count, pairs, _with_relatives(own, pairs))


def _with_relatives(own: np.ndarray, children: np.ndarray) -> np.ndarray:
    """[N, 6 F + 3] features of each region, own [N, F]; then those of its parent, the parent's other child, the
    grandparent and both children, less its own, 0 where there is none; then whether it has no parent, no grandparent,
    no children. What a region would become, and what it is made of, shows whether it is an object (Liu et al. 2016)."""
    parent, sibling, larger, smaller = np.full((4, len(own)), -1)
    merged = np.arange(len(own) - len(children), len(own))
    parent[children] = merged[:, None]
    sibling[children] = children[:, ::-1]
    larger[merged], smaller[merged] = children.T
    grandparent = np.where(parent >= 0, parent[parent], -1)
    relatives = (parent, sibling, grandparent, larger, smaller)
    rows = [np.where(other[:, None] >= 0, own[other] - own, 0) for other in relatives]
    missing = np.stack([other < 0 for other in (parent, grandparent, larger)], axis=1)
    return np.concatenate([own, *rows, missing], axis=1, dtype=np.float32)


def join_planes(graph: SurfaceGraph, ends: np.ndarray) -> np.ndarray:
    """Joins large flat segments that are coplanar and similar in colour, such as floors and tables split by objects.
    ends: [R] the segment of each patch. Returns [R] with one number for each set of joined segments."""
    large = [i for i in np.unique(ends).tolist() if graph.area(i) > _LARGE]
    large = [i for i in large if graph.extents[i, 0] < _FLAT * graph.depth(i)]
    joined = np.arange(graph.count)
    for a, b in itertools.combinations(large, 2):
        if graph.one_plane(a, b):
            joined[joined == joined[b]] = joined[a]
    return joined[ends]
