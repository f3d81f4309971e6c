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

from perception.instances.votes import Table

LEAST_SHARE = 0.1  # relative to its best view; a view that shows less of a segment is ignored
ONE_SIDED = 0.5  # weight of a view that labels only one of the two, relative to a view that labels both
PRIOR = 0.5  # weight of the feature prior, in views
LOWEST = 0.05  # affinity below which merging stops
SUPPORT = 0.6  # IoU with a mask from which a photo supports a group
LEAST_PIXELS = 8.0  # pixels under masks from which a view shows a group
LARGEST_PART = 0.8  # share of the whole's pixels; a larger part is nearly the whole
PART_VIEWS = 2  # photos that must support a part


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


class _Affinities:
    """Affinities a_ij of all pairs of S segments, updated after every merge.

    P [M, S], B, s and l [V, S] have segments as columns, so the few masks of a segment select whole rows; z [S, D].
    unit: P_im / |P_i|_v. Merged segments have a_ij = −1.
    """

    def __init__(self, table: Table, z: np.ndarray, sizes: np.ndarray, near: np.ndarray):
        count, self.views = table.void.shape
        self.view = table.view
        self.P = np.array(table.pixels.T, np.float32, order="C")  # a copy: `merge` writes into it
        self.B = np.array(table.void.T, np.float32, order="C")
        self.unlabelled = np.zeros_like(self.B)
        self.unit = np.zeros_like(self.P)
        self.s = np.zeros((self.views, count), np.float32)
        self.z, self.sizes, self.near = z.astype(np.float64), sizes.astype(np.float64), near.copy()
        self.alive = np.ones(count, bool)
        for i in range(count):
            self._update(i)
        self.a = np.stack([self._row(i) for i in range(count)]) if count else np.zeros((0, 0))

    def _update(self, i: int) -> None:
        """Updates unit, s and 1 − l of segment i from its P and B."""
        P, B = self.P[:, i], self.B[:, i]
        T = np.bincount(self.view, P, self.views) + B
        norm = np.sqrt(np.bincount(self.view, P**2, self.views))
        self.unit[:, i] = P / np.maximum(norm[self.view], 1e-12)
        self.s[:, i] = T / max(float(T.max(initial=0)), 1e-12)
        self.unlabelled[:, i] = B / np.maximum(T, 1e-12)

    def _row(self, i: int) -> np.ndarray:
        """a_ij [S] of segment i with every j."""
        shows = self.s[:, i] > LEAST_SHARE  # w is 0 in the other views
        masks = np.flatnonzero((self.unit[:, i] > 0) & shows[self.view])
        s = self.s[shows]
        c = np.zeros_like(s)
        if len(masks):
            views, first = np.unique(self.view[masks], return_index=True)
            row = np.cumsum(shows)[views] - 1
            c[row] = np.add.reduceat(self.unit[masks] * self.unit[masks, i][:, None], first, axis=0)
        w = np.minimum(s, s[:, i][:, None])
        w[w <= LEAST_SHARE] = 0
        l_j = 1 - self.unlabelled[shows]
        l_i = l_j[:, i][:, None]
        both, one = l_i * l_j, l_i + l_j - 2 * l_i * l_j
        p = np.clip(1 - ((self.z - self.z[i]) ** 2).sum(axis=1), 0, 1) * self.near[i]
        agreement, weight = (w * both * c).sum(axis=0), (w * (both + ONE_SIDED * one)).sum(axis=0)
        a = (agreement + PRIOR * p) / (weight + PRIOR)
        a[~self.alive] = -1
        a[i] = -1
        return a

    def merge(self, i: int, j: int) -> None:
        """Merges segment j into segment i."""
        size = self.sizes[i] + self.sizes[j]
        self.z[i] = (self.z[i] * self.sizes[i] + self.z[j] * self.sizes[j]) / size
        self.sizes[i] = size
        self.P[:, i] += self.P[:, j]
        self.B[:, i] += self.B[:, j]
        self.near[i] |= self.near[j]
        self.near[:, i] |= self.near[:, j]
        self.unit[:, j] = self.s[:, j] = 0
        self.alive[j] = False
        self._update(i)
        self.a[j] = self.a[:, j] = -1
        self.a[i] = self.a[:, i] = self._row(i)


def merge_tree(table: Table, prototypes: np.ndarray, sizes: np.ndarray, near: np.ndarray) -> MergeTree:
    """Repeatedly merges the pair with the largest affinity, until none reaches LOWEST.

    table: of the S segments; prototypes [S, D]: z; sizes [S]: Gaussian counts; near [S, S] bool: spatial neighbours.
    """
    state = _Affinities(table, prototypes, sizes, near)
    count = len(sizes)
    node = np.arange(count)
    best = state.a.max(axis=1, initial=-1)
    children, affinity = [], []
    while len(best) and (top := int(best.argmax())) >= 0 and best[top] >= LOWEST:
        other = int(state.a[top].argmax())
        i, j = min(top, other), max(top, other)
        affinity.append(float(best[top]))
        children.append((node[i], node[j]))
        before = state.a[:, [i, j]].max(axis=1)
        state.merge(i, j)
        node[i] = count + len(children) - 1
        # Only columns i and j have changed: rows whose largest value stood there are searched anew.
        anew = np.flatnonzero(before >= best)
        best = np.maximum(best, state.a[:, i])
        best[anew] = state.a[anew].max(axis=1)
        best[[i, j]] = state.a[[i, j]].max(axis=1)
    return MergeTree(count, np.array(children, np.int64).reshape(-1, 2), np.array(affinity))


@dataclass(frozen=True)
class Evidence:
    """Evidence of G groups. pixels [G]: Σ_m P_gm; matched [G]: see the module; views [G] int: number that show it;
    fit [G, V]: the largest IoU_gm of each view, 0 where the view does not show the group."""

    pixels: np.ndarray
    matched: np.ndarray
    views: np.ndarray
    fit: np.ndarray

    @property
    def support(self) -> np.ndarray:
        """[G] number of views in which one mask has an IoU of at least SUPPORT with the group."""
        return np.asarray((self.fit >= SUPPORT).sum(axis=1))

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
    if table.pixels.shape[1] == 0:
        none = np.zeros(len(table.pixels))
        return Evidence(none, none, none.astype(np.int64), none.reshape(-1, 1)[:, :0])
    P, labelled = table.pixels.astype(np.float64), table.by_view.astype(np.float64)
    T = (labelled + table.void)[:, table.view]
    iou = P / np.maximum(T + table.area - P, 1e-12)
    shown = labelled >= LEAST_PIXELS
    fit = np.where(shown, np.maximum.reduceat(iou, table.starts, axis=1), 0)
    return Evidence(labelled.sum(axis=1), (P * iou).sum(axis=1), shown.sum(axis=1), fit)


def node_evidence(tree: MergeTree, table: Table) -> Evidence:
    """Evidence of all nodes of a tree, from the table of its leaves."""
    whole = [evidence(table)]
    rows = {leaf: table.row(leaf) for leaf in range(tree.leaves)}
    for number, (a, b) in enumerate(tree.children.tolist()):
        joined = rows[tree.leaves + number] = rows.pop(a) + rows.pop(b)
        whole.append(evidence(joined))
    names = ("pixels", "matched", "views", "fit")
    return Evidence(*(np.concatenate([getattr(part, name) for part in whole]) for name in names))


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
        single = (found.fit[at] >= SUPPORT) & (found.fit[at] > found.fit[node])
        if single.sum() >= PART_VIEWS and found.pixels[at] <= LARGEST_PART * found.pixels[node]:
            parts.append(at)
        else:
            stack += tree.children_of(at)
    return sorted(parts)
