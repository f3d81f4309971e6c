"""Segments into objects by agreement of the masks of all photos: a dendrogram, its best cut, and parts below it.

    i, j    segments, or groups of them that were merged
    v       a view; m ∈ v: its masks
    P_im    pixels of mask m that i fills, in sums of rendering weights (see `votes`)
    B_iv    pixels of view v without a mask that i fills
    A_m     pixels of mask m
    z_i     mean feature of i; a distance of 1 is the margin of the loss
    near_ij 1 for spatial neighbours (see `segments.touching`), else 0

Affinity a_ij of two segments: mean, over the views that show both, of the cosine c between their distributions over the
masks of the view. The features are a weak prior p for spatial neighbours:

    T_iv = Σ_{m∈v} P_im + B_iv                      pixels of v that i fills
    s_iv = T_iv / max_v T_iv                        the same, relative to its best view
    l_iv = 1 − B_iv / T_iv                          labelled share of these pixels
    c_ijv = Σ_{m∈v} P_im P_jm / (|P_i|_v |P_j|_v)   1: same mask, 0: no common mask; |·|_v: norm over m ∈ v
    w_ijv = min(s_iv, s_jv), but 0 up to LEAST_SHARE
    both_ijv = l_iv l_jv                            both are labelled
    one_ijv = l_iv + l_jv − 2 both_ijv              only one of the two is labelled, evidence against merging
    p_ij = near_ij · max(0, 1 − |z_i − z_j|²)
    a_ij = (Σ_v w both c + PRIOR p_ij) / (Σ_v w (both + ONE_SIDED one) + PRIOR)

The pair with the largest a_ij is merged repeatedly. P, B and z of the merged segment are pooled (average linkage). Of
more than MANY segments, spatial neighbours are merged first, until none of their a_ij reaches SURE: the time would else
grow with the square of the segments that a mask holds.
Each node g of the dendrogram is the group of the leaves below it. Its agreement with the masks:

    IoU_gm = P_gm / (T_gv + A_m − P_gm)             T_gv with unlabelled pixels: a mask that ends at the border of an
                                                    unlabelled object is evidence for that border
    matched_g = Σ_m P_gm IoU_gm                     each pixel counts the IoU of its own mask, not of the best one: else
                                                    a small object would profit from the match of what lies below it

The cut is the set of nodes that covers each leaf once with the largest Σ matched_g:

    best_g = max(matched_g, Σ_{children h of g} best_h)

It keeps an object if most photos show it as one mask, and its parts if most photos separate them. Segmentation errors
in a few photos are outvoted. Nodes below the cut that have masks of their own are kept as parts.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from perception import _core
from perception.masks.votes import MaskVotes

LEAST_SHARE = 0.1  # of w_ijv; a view that shows less of a segment is ignored
ONE_SIDED = 0.5  # weight of a view that labels only one of the two, relative to a view that labels both
PRIOR = 0.5  # weight of the feature prior, in views
LOWEST = 0.05  # affinity below which merging stops
MANY, SURE = 5000, 0.7  # see above
SUPPORT = 0.6  # IoU with a mask from which a photo supports a group
LEAST_PIXELS = 8.0  # pixels under masks from which a view shows a group
LARGEST_PART = 0.8  # share of the instance's pixels; a larger part is nearly the instance
PART_VIEWS = 2  # photos that must support a part
AT_ONCE, ENTRIES = 64, 2_000_000  # nodes whose votes are held together, and their entries: 60 bytes each


@dataclass(frozen=True)
class Dendrogram:
    """Leaves 0 … S − 1, then one node per merge, in order: children [R, 2] int64, affinity [R] float64 in [0, 1]."""

    leaves: int
    children: np.ndarray
    affinity: np.ndarray

    def children_of(self, node: int) -> list[int]:
        return [] if node < self.leaves else self.children[node - self.leaves].tolist()

    def leaves_of(self, node: int) -> np.ndarray:
        """Ascending."""
        nodes = [node]
        for at in nodes:  # the list grows while it is read
            nodes += self.children_of(at)
        return np.sort([at for at in nodes if at < self.leaves])

    def spans(self) -> tuple[np.ndarray, np.ndarray]:
        """All leaves in an order [S] in which those of each node stand together, of its first child first, and where
        they begin and end [S + R, 2]."""
        size = np.ones(self.leaves + len(self.children), np.int64)
        for node, (a, b) in enumerate(self.children.tolist(), start=self.leaves):
            size[node] = size[a] + size[b]
        begin = np.zeros(len(size), np.int64)
        roots = np.setdiff1d(np.arange(len(size)), self.children)
        begin[roots] = np.cumsum(size[roots]) - size[roots]
        for node, (a, b) in reversed(list(enumerate(self.children.tolist(), start=self.leaves))):
            begin[a], begin[b] = begin[node], begin[node] + size[a]
        return np.argsort(begin[: self.leaves]), np.stack([begin, begin + size], axis=1)


def dendrogram(votes: MaskVotes, prototypes: np.ndarray, sizes: np.ndarray, near: sparse.csr_matrix) -> Dendrogram:
    """Repeatedly merges the pair with the largest affinity, until none reaches LOWEST (csrc/graph/merge.cpp).

    votes: of the S segments; prototypes [S, D]: z; sizes [S]: Gaussian counts; near [S, S]: nonzero for spatial
    neighbours. Only pairs that are near or share a mask have an affinity. A signal ends it.
    """
    count = len(sizes)
    if count == 0:
        return Dendrogram(0, np.zeros((0, 2), np.int64), np.zeros(0))
    children, affinity = np.zeros((count - 1, 2), np.int32), np.zeros(count - 1)
    rows = [(m.indptr.astype(np.int64), np.asarray(m.indices, np.int32)) for m in (votes.pixels, votes.void, near)]
    values = [np.asarray(m.data, np.float32) for m in (votes.pixels, votes.void)]
    z, weights = np.ascontiguousarray(prototypes, np.float64), np.ascontiguousarray(sizes, np.float64)
    merges = _core.merge_segments(
        *(*rows[0], values[0], *rows[1], values[1], votes.view.astype(np.int32), votes.void.shape[1], *rows[2]),
        *(z, weights, LEAST_SHARE, ONE_SIDED, PRIOR, LOWEST, MANY, SURE, children, affinity),
    )
    return Dendrogram(count, children[:merges].astype(np.int64), affinity[:merges])


@dataclass(frozen=True)
class Evidence:
    """Evidence of G groups. pixels [G]: Σ_m P_gm; matched [G]: see the module; views [G] int: number that show it;
    fit [G, V] sparse: the largest IoU_gm of each view, 0 where the view does not show the group."""

    pixels: np.ndarray
    matched: np.ndarray
    views: np.ndarray
    fit: sparse.csr_matrix

    @property
    def support(self) -> np.ndarray:
        """[G] number of views in which one mask has an IoU of at least SUPPORT with the group."""
        return np.diff((self.fit >= SUPPORT).tocsr().indptr)

    @property
    def agreement(self) -> np.ndarray:
        """[G] in [0, 1]: mean over the group's pixels of the IoU with the pixel's mask; 0 if no mask covers it."""
        return self.matched / np.maximum(self.pixels, 1e-12)


def evidence(votes: MaskVotes) -> Evidence:
    """Evidence of groups, from their votes. A view shows a group that fills at least LEAST_PIXELS of its masks."""
    count, views = votes.void.shape
    row, view, first, labelled = votes.runs()
    P = votes.pixels.data.astype(np.float64)
    T = votes.per_entry(first, labelled + np.asarray(votes.void[row, view]).reshape(-1))
    iou = P / np.maximum(T + votes.area[votes.pixels.indices] - P, 1e-12)
    shown = labelled >= LEAST_PIXELS
    best = np.maximum.reduceat(iou, first)[shown] if len(first) else np.zeros(0)
    fit = sparse.csr_matrix((best, (row[shown], view[shown])), shape=(count, views))
    matched = np.bincount(votes.per_entry(first, row), P * iou, minlength=count)
    return Evidence(np.bincount(row, labelled, minlength=count), matched, np.bincount(row[shown], minlength=count), fit)


def node_evidence(tree: Dendrogram, votes: MaskVotes) -> Evidence:
    """Evidence of all nodes of a dendrogram, from the votes of its leaves."""
    order, spans = tree.spans()
    leaves = [order[begin:end] for begin, end in spans.tolist()]
    some = min(AT_ONCE, ENTRIES // max(1, len(votes.area)) + 1)
    parts = [evidence(votes.pooled(leaves[at : at + some])) for at in range(0, len(leaves), some)]
    pixels, matched, views = (
        np.concatenate([getattr(part, name) for part in parts]) for name in ("pixels", "matched", "views")
    )
    return Evidence(pixels, matched, views, sparse.vstack([part.fit for part in parts], format="csr"))


def best_cut(tree: Dendrogram, matched: np.ndarray) -> list[int]:
    """Nodes that cover every leaf exactly once, with the largest sum of `matched`; at ties the parent is taken."""
    best = matched.copy()
    for number, (a, b) in enumerate(tree.children.tolist()):
        node = tree.leaves + number
        best[node] = max(matched[node], best[a] + best[b])
    chosen = []
    nodes = np.setdiff1d(np.arange(len(best)), tree.children).tolist()  # the roots; children are added below
    for node in nodes:
        children = tree.children_of(node)
        if not children or matched[node] >= best[children].sum() * (1 - 1e-9):
            chosen.append(node)
        else:
            nodes += children
    return sorted(chosen)


def parts_of(tree: Dendrogram, instances: list[int], seen: Evidence) -> list[tuple[int, int]]:
    """(number of the instance, node): the highest nodes below each of `instances` that PART_VIEWS or more photos
    support, with a larger IoU than the instance's. A part fills at most LARGEST_PART of the pixels of the instance."""
    owner = np.full(len(seen.pixels), -1)
    owner[instances] = np.arange(len(instances))
    for node in range(len(owner) - 1, tree.leaves - 1, -1):
        if owner[node] >= 0:
            owner[tree.children[node - tree.leaves]] = owner[node]
    below = np.flatnonzero(owner >= 0)
    whole = np.asarray(instances)[owner[below]]
    better = (seen.fit[below] > seen.fit[whole]).multiply(seen.fit[below] >= SUPPORT)
    good = np.asarray(better.sum(axis=1)).reshape(-1) >= PART_VIEWS
    good &= seen.pixels[below] <= LARGEST_PART * seen.pixels[whole]
    is_part = np.zeros(len(owner), bool)
    is_part[below[good]] = True
    found = []
    for number, instance in enumerate(instances):
        nodes = tree.children_of(instance)
        for node in nodes:
            nodes += [] if is_part[node] else tree.children_of(node)
        found += [(number, node) for node in sorted(nodes) if is_part[node]]
    return found
