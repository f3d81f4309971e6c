"""Segments into instances by agreement of the masks of all photos: a merge tree, its best cut, and parts below it.

i, j: segments or groups of them; v: a view; m ∈ v: its masks; P_im: pixels of mask m that i fills; B_iv: pixels of v
without a mask that i fills; A_m: pixels of mask m; z_i: mean feature (a distance of 1 is the loss's margin).

Affinity of two segments: mean, over the views that show both, of the cosine between their distributions over the masks
of the view. The features are a weak prior for spatial neighbours:
    T_iv = Σ_{m∈v} P_im + B_iv                      pixels of v that i fills
    s_iv = T_iv / max_v T_iv                        the same, relative to its best view
    l_iv = 1 − B_iv / T_iv                          labelled share of these pixels
    c_ijv = Σ_{m∈v} P_im P_jm / (|P_i|_v |P_j|_v)   1: same mask, 0: no common mask; |·|_v: norm over m ∈ v
    w_ijv = min(s_iv, s_jv), but 0 up to LEAST_SHARE
    both = l_iv l_jv,   one = l_iv + l_jv − 2 both  `one`: only one of the two is labelled, evidence against merging
    p_ij = near_ij · max(0, 1 − |z_i − z_j|²)
    a_ij = (Σ_v w both c + PRIOR p_ij) / (Σ_v w (both + ONE_SIDED one) + PRIOR)

The pair with the largest a_ij is merged repeatedly. P, B and z of the merged segment are pooled (average linkage).
Agreement of a group g with the masks, and the cut of the tree with the best agreement:
    IoU_gm = P_gm / (T_gv + A_m − P_gm)
    matched_g = Σ_m P_gm IoU_gm
    best_g = max(matched_g, Σ_{children h of g} best_h)
The cut keeps a whole if most photos show it as one mask, and its parts if most photos separate them. Segmentation
errors in a few photos are outvoted. Nodes below the cut that have masks of their own are kept as parts.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from perception import _core
from perception.instances.votes import Table

LEAST_SHARE = 0.1  # relative to its best view; a view that shows less of a segment is ignored
ONE_SIDED = 0.5  # weight of a view that labels only one of the two, relative to a view that labels both
PRIOR = 0.5  # weight of the feature prior, in views
LOWEST = 0.05  # affinity below which merging stops
SUPPORT = 0.6  # IoU with a mask from which a photo supports a group
LEAST_PIXELS = 8.0  # pixels under masks from which a view shows a group
LARGEST_PART = 0.8  # share of the whole's pixels; a larger part is nearly the whole
PART_VIEWS = 2  # photos that must support a part
AT_ONCE, ENTRIES = 64, 2_000_000  # nodes whose tables are held together, and their entries: 60 bytes each


@dataclass(frozen=True)
class MergeTree:
    """Leaves 0 … S − 1, then one node per merge, in order: children [R, 2] int64, affinity [R] float64 in [0, 1]."""

    leaves: int
    children: np.ndarray
    affinity: np.ndarray

    @property
    def roots(self) -> list[int]:
        below = set(self.children.ravel().tolist())
        return [node for node in range(self.leaves + len(self.children)) if node not in below]

    def children_of(self, node: int) -> list[int]:
        return [] if node < self.leaves else self.children[node - self.leaves].tolist()

    def leaves_of(self, node: int) -> list[int]:
        stack, found = [node], []
        while stack:
            at = stack.pop()
            stack += self.children_of(at)
            found += [at] if at < self.leaves else []
        return sorted(found)


def merge_tree(table: Table, prototypes: np.ndarray, sizes: np.ndarray, near: sparse.csr_matrix) -> MergeTree:
    """Repeatedly merges the pair with the largest affinity, until none reaches LOWEST (csrc/graph/merge.cpp).

    table: of the S segments; prototypes [S, D]: z; sizes [S]: Gaussian counts; near [S, S]: nonzero for spatial
    neighbours. Only pairs that are near or share a mask have an affinity, so only these are held.
    """
    count = len(sizes)
    if count == 0:
        return MergeTree(0, np.zeros((0, 2), np.int64), np.zeros(0))
    children, affinity = np.zeros((count - 1, 2), np.int32), np.zeros(count - 1)
    rows = [(m.indptr.astype(np.int64), np.asarray(m.indices, np.int32)) for m in (table.pixels, table.void, near)]
    values = [np.asarray(m.data, np.float32) for m in (table.pixels, table.void)]
    z, weights = np.ascontiguousarray(prototypes, np.float64), np.ascontiguousarray(sizes, np.float64)
    merges = _core.merge_segments(
        *(*rows[0], values[0], *rows[1], values[1], table.view.astype(np.int32), table.void.shape[1], *rows[2]),
        *(z, weights, LEAST_SHARE, ONE_SIDED, PRIOR, LOWEST, children, affinity),
    )
    return MergeTree(count, children[:merges].astype(np.int64), affinity[:merges])


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


def evidence(table: Table) -> Evidence:
    """Evidence of the groups of a table. A view shows a group that fills at least LEAST_PIXELS of its masks.

    Each pixel counts the IoU of its own mask, not of the best mask. Otherwise a small object would profit from the good
    match of the large object below it. T_gv includes unlabelled pixels, so a mask that ends at the border of an
    unlabelled object is evidence for that border.
    """
    count, views = table.void.shape
    row, view, first, labelled = table.runs()
    P = table.pixels.data.astype(np.float64)
    T = table.per_entry(first, labelled + np.asarray(table.void[row, view]).reshape(-1))
    iou = P / np.maximum(T + table.area[table.pixels.indices] - P, 1e-12)
    shown = labelled >= LEAST_PIXELS
    best = np.maximum.reduceat(iou, first)[shown] if len(first) else np.zeros(0)
    fit = sparse.csr_matrix((best, (row[shown], view[shown])), shape=(count, views))
    matched = np.bincount(table.per_entry(first, row), P * iou, minlength=count)
    return Evidence(np.bincount(row, labelled, minlength=count), matched, np.bincount(row[shown], minlength=count), fit)


def node_evidence(tree: MergeTree, table: Table) -> Evidence:
    """Evidence of all nodes of a tree, from the table of its leaves."""
    leaves = [np.array([leaf], np.int32) for leaf in range(tree.leaves)]
    for a, b in tree.children.tolist():
        leaves.append(np.concatenate([leaves[a], leaves[b]]))
    some = min(AT_ONCE, ENTRIES // max(1, len(table.area)) + 1)
    found = [evidence(table.pooled(leaves[at : at + some])) for at in range(0, len(leaves), some)]
    numbers = {name: np.concatenate([getattr(part, name) for part in found]) for name in ("pixels", "matched", "views")}
    return Evidence(**numbers, fit=sparse.vstack([part.fit for part in found], format="csr"))


def best_cut(tree: MergeTree, matched: np.ndarray) -> list[int]:
    """Nodes that cover every leaf exactly once, with the largest sum of `matched`; at ties the parent is taken."""
    best = matched.copy()
    for number, (a, b) in enumerate(tree.children.tolist()):
        node = tree.leaves + number
        best[node] = max(matched[node], best[a] + best[b])
    chosen, stack = [], tree.roots
    while stack:
        node = stack.pop()
        children = tree.children_of(node)
        if not children or matched[node] >= best[children].sum() * (1 - 1e-9):
            chosen.append(node)
        else:
            stack += children
    return sorted(chosen)


def parts_of(tree: MergeTree, node: int, found: Evidence) -> list[int]:
    """Highest nodes below an instance that PART_VIEWS or more photos support, with a larger IoU than the instance's.

    A part fills at most LARGEST_PART of the pixels of the instance.
    """
    parts, stack = [], tree.children_of(node)
    while stack:
        at = stack.pop()
        fit, whole = found.fit[[at, node]].toarray()
        single = (fit >= SUPPORT) & (fit > whole)
        if single.sum() >= PART_VIEWS and found.pixels[at] <= LARGEST_PART * found.pixels[node]:
            parts.append(at)
        else:
            stack += tree.children_of(at)
    return sorted(parts)
