"""Segments into instances by what the masks of all photos agree on: a merge tree, its best cut, and parts below it.

Two segments belong together as far as photos that show both put them into one mask. Merging the pair that agrees most,
again and again, gives a tree (average linkage, with the evidence pooled anew at each merge). The tree is cut where
its nodes' silhouettes match the masks best: a whole that photos show as one mask beats its parts, parts that photos
mostly keep apart beat a whole that few masks hold. What is below the cut and singled out by masks of its own is kept
as parts. So an error of the segmenter in some photos is outvoted by the others.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from perception.instances.votes import Table

GLIMPSE = 0.1  # of its best view: what shows less of a segment is no evidence about it
ONE_SIDED = 0.5  # of a common view's weight, where it labels one of the two only
PRIOR = 0.5  # views that the features' own evidence weighs as much as
SUPPORT = 0.6  # IoU with a mask from which on a photo singles a node out


@dataclass(frozen=True)
class MergeTree:
    """Leaves 0 … S − 1, then one node a merge, in order: children [R, 2] int64, affinity [R] float64 in [0, 1]."""

    leaves: int
    children: np.ndarray
    affinity: np.ndarray

    @property
    def roots(self) -> list[int]:
        below = set(self.children.ravel().tolist())
        return [node for node in range(self.leaves + len(self.children)) if node not in below]

    def kids(self, node: int) -> list[int]:
        return [] if node < self.leaves else self.children[node - self.leaves].tolist()

    def under(self, node: int) -> list[int]:
        """The leaves of a node."""
        stack, found = [node], []
        while stack:
            at = stack.pop()
            stack += self.kids(at)
            found += [at] if at < self.leaves else []
        return sorted(found)


class _Merger:
    """The state of the agglomeration. Tables lie mask-major, so that the few masks a segment is in are whole rows."""

    def __init__(self, table: Table, prototypes: np.ndarray, sizes: np.ndarray, near: np.ndarray):
        count, self.views = table.void.shape
        self.view = table.view
        self.table = np.ascontiguousarray(table.pixels.T, np.float32)
        self.void = np.ascontiguousarray(table.void.T, np.float32)
        self.blank = np.zeros_like(self.void)
        self.share = np.zeros_like(self.table)
        self.seen = np.zeros((self.views, count), np.float32)
        self.prototypes, self.sizes = prototypes.astype(np.float64), sizes.astype(np.float64)
        self.near = near.copy()
        self.alive = np.ones(count, bool)
        for segment in range(count):
            self._normalise(segment)
        self.affinity = np.stack([self._row(segment) for segment in range(count)]) if count else np.zeros((0, 0))

    def _normalise(self, i: int) -> None:
        """The segment's unit direction over the masks of each view, how much of it each view shows, and the share of
        that which no mask covers."""
        column, void = self.table[:, i], self.void[:, i]
        total = np.bincount(self.view, column, self.views) + void
        length = np.sqrt(np.bincount(self.view, column**2, self.views))
        self.share[:, i] = column / np.maximum(length[self.view], 1e-12)
        self.seen[:, i] = total / max(float(total.max(initial=0)), 1e-12)
        self.blank[:, i] = void / np.maximum(total, 1e-12)

    def _row(self, i: int) -> np.ndarray:
        """Affinity [S] of segment i to all: mean over common views, weighted by how much they show, of the cosine
        between what is labelled of both. A view that labels one and not the other speaks against them, half as loud."""
        masks = np.flatnonzero(self.share[:, i] > 0)
        same = np.zeros_like(self.seen)
        if len(masks):
            views, first = np.unique(self.view[masks], return_index=True)
            same[views] = np.add.reduceat(self.share[masks] * self.share[masks, i][:, None], first, axis=0)
        common = np.minimum(self.seen, self.seen[:, i][:, None])
        common = np.where(common > GLIMPSE, common, 0)
        mine, theirs = 1 - self.blank[:, i][:, None], 1 - self.blank
        both, one = mine * theirs, mine + theirs - 2 * mine * theirs
        agreed = (common * both * same).sum(axis=0)
        weight = (common * (both + ONE_SIDED * one)).sum(axis=0)
        distance = ((self.prototypes - self.prototypes[i]) ** 2).sum(axis=1)
        prior = np.clip(1 - distance, 0, 1) * self.near[i]
        row = (agreed + PRIOR * prior) / (weight + PRIOR)
        row[~self.alive] = -1
        row[i] = -1
        return row

    def join(self, i: int, j: int) -> None:
        """Segment j goes into i."""
        whole = self.sizes[i] + self.sizes[j]
        self.prototypes[i] = (self.prototypes[i] * self.sizes[i] + self.prototypes[j] * self.sizes[j]) / whole
        self.sizes[i] = whole
        self.table[:, i] += self.table[:, j]
        self.void[:, i] += self.void[:, j]
        self.near[i] |= self.near[j]
        self.near[:, i] |= self.near[:, j]
        self.share[:, j] = self.seen[:, j] = 0
        self.alive[j] = False
        self._normalise(i)
        self.affinity[j] = self.affinity[:, j] = -1
        self.affinity[i] = self.affinity[:, i] = self._row(i)


def merge_tree(
    table: Table, prototypes: np.ndarray, sizes: np.ndarray, near: np.ndarray, lowest: float = 0.05
) -> MergeTree:
    """Merges the most agreeing pair until none agrees by `lowest`.

    table: of the S segments. prototypes [S, D] mean features (a distance of 1 is the loss's margin), sizes [S]
    Gaussians, near [S, S] bool. Features decide only where photos do not: for neighbours, with half a view's weight.
    """
    state = _Merger(table, prototypes, sizes, near)
    count = len(sizes)
    node = np.arange(count)
    best = state.affinity.max(axis=1, initial=-1)
    children, affinity = [], []
    while len(best) and (top := int(best.argmax())) >= 0 and best[top] >= lowest:
        other = int(state.affinity[top].argmax())
        i, j = min(top, other), max(top, other)
        affinity.append(float(best[top]))
        children.append((node[i], node[j]))
        state.join(i, j)
        node[i] = count + len(children) - 1
        best = state.affinity.max(axis=1)
    return MergeTree(count, np.array(children, np.int64).reshape(-1, 2), np.array(affinity))


@dataclass(frozen=True)
class Evidence:
    """Of each group: pixels under masks; matched: the sum over them of the IoU between the group and the pixel's mask;
    views that show it; fit [·, V]: IoU with the best mask of each view, 0 where the view shows too little of it."""

    pixels: np.ndarray
    matched: np.ndarray
    views: np.ndarray
    fit: np.ndarray

    @property
    def support(self) -> np.ndarray:
        """[·] views in which one mask singles it out."""
        return np.asarray((self.fit >= SUPPORT).sum(axis=1))

    @property
    def agreement(self) -> np.ndarray:
        """[·] in [0, 1]: mean over its pixels of the IoU with the pixel's mask; 0 where no mask covers it."""
        return self.matched / np.maximum(self.pixels, 1e-12)


def evidence(table: Table, smallest: float = 8.0) -> Evidence:
    """Of each row of a table; a view shows what fills at least `smallest` pixels of its masks.

    A pixel scores the IoU of its own mask, not of the best one: a small thing on a large one is not carried along by
    the match of the large one, and views outvote each other pixel by pixel. What no mask covers is part of a group's
    extent, so a mask that ends at a thing's border speaks for that border even where the thing itself is unlabelled.
    """
    if table.pixels.shape[1] == 0:
        none = np.zeros(len(table.pixels))
        return Evidence(none, none, none.astype(np.int64), none.reshape(-1, 1)[:, :0])
    starts = np.flatnonzero(np.diff(table.view, prepend=-1) > 0)
    rows = table.pixels.astype(np.float64)
    each = table.by_view.astype(np.float64)
    extent = (each + table.void)[:, table.view]
    iou = rows / np.maximum(extent + table.area - rows, 1e-12)
    shown = each >= smallest
    best = np.maximum.reduceat(iou, starts, axis=1)
    return Evidence(
        each.sum(axis=1),
        (rows * iou).sum(axis=1),
        shown.sum(axis=1),
        np.where(shown, best, 0),
    )


def node_evidence(tree: MergeTree, table: Table) -> Evidence:
    """Evidence of all nodes of a tree over the leaves' table."""
    whole = [evidence(table)]
    rows = {leaf: table.row(leaf) for leaf in range(tree.leaves)}
    for number, (a, b) in enumerate(tree.children.tolist()):
        joined = rows[tree.leaves + number] = rows.pop(a) + rows.pop(b)
        whole.append(evidence(joined))
    names = ("pixels", "matched", "views", "fit")
    return Evidence(*(np.concatenate([getattr(part, name) for part in whole]) for name in names))


def best_cut(tree: MergeTree, matched: np.ndarray) -> list[int]:
    """The nodes, none below another and all leaves covered, with the largest sum of `matched` (ties: the whole)."""
    best = matched.copy()
    for number, (a, b) in enumerate(tree.children.tolist()):
        node = tree.leaves + number
        best[node] = max(matched[node], best[a] + best[b])
    chosen, stack = [], tree.roots
    while stack:
        node = stack.pop()
        kids = tree.kids(node)
        if not kids or matched[node] >= best[kids].sum() * (1 - 1e-9):
            chosen.append(node)
        else:
            stack += kids
    return sorted(chosen)


def parts_of(tree: MergeTree, node: int, found: Evidence, largest: float = 0.8, least_views: int = 2) -> list[int]:
    """Parts of an instance: the highest nodes below it that masks single out in `least_views` photos or more, and fit
    better there than any fits the whole.

    A part fills at most `largest` of the whole's pixels: it is not the whole once more.
    """
    parts, stack = [], tree.kids(node)
    while stack:
        at = stack.pop()
        single = (found.fit[at] >= SUPPORT) & (found.fit[at] > found.fit[node])
        if single.sum() >= least_views and found.pixels[at] <= largest * found.pixels[node]:
            parts.append(at)
        else:
            stack += tree.kids(at)
    return sorted(parts)
