"""The weight of each row, such as a Gaussian or a group of them, in each 2D mask of each photo."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy import sparse


@dataclass(frozen=True)
class MaskVotes:
    """Weights of N Gaussians, or of groups of them, in the M masks of V views: the pixels that they fill; sparse.

    pixels [N, M] float32: in each mask. void [N, V] float32: in each view, where it has no mask. view [M] int64: of
    each mask, 0 … V − 1 ascending. area [M] float64: pixels of each mask. label [M] int64: of each mask in the label
    image of its photo; empty where nothing asks for it.
    """

    pixels: sparse.csr_matrix
    void: sparse.csr_matrix
    view: np.ndarray
    area: np.ndarray
    label: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))

    def of_groups(self, ids: np.ndarray, count: int) -> MaskVotes:
        """Votes of the groups 0 … count − 1, sums over their members; ids [N]: the group of each row, −1 = none."""
        rows = np.flatnonzero(ids >= 0)
        ones = np.ones(len(rows), np.float32)
        return self._summed(sparse.csr_matrix((ones, (ids[rows], rows)), shape=(count, len(ids))))

    def pooled(self, groups: Sequence[np.ndarray]) -> MaskVotes:
        """Votes of groups that may share rows; groups: the rows of each."""
        ends = np.cumsum([0, *map(len, groups)])
        members = (np.ones(ends[-1], np.float32), np.concatenate(groups), ends)
        return self._summed(sparse.csr_matrix(members, shape=(len(groups), self.pixels.shape[0])))

    def _summed(self, members: sparse.csr_matrix) -> MaskVotes:
        """members [R, N]: 1 for the rows of each of R groups. The columns of each row of the result ascend."""
        tables = members @ self.pixels, members @ self.void
        for table in tables:
            table.sort_indices()
        return MaskVotes(*tables, self.view, self.area, self.label)

    def of_labels(self) -> sparse.csr_matrix:
        """[N, L] weights in all masks of each label, by ascending label."""
        names, index = np.unique(self.label, return_inverse=True)
        ones = np.ones(len(index), np.float32)
        columns = sparse.csr_matrix((ones, (np.arange(len(index)), index)), shape=(len(index), len(names)))
        return (self.pixels @ columns).tocsr()

    def runs(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """(row, view) [L] of each row and view with masks of it, the first of its entries in `pixels.data` [L], and
        the pixels under its masks [L] float64."""
        row = np.repeat(np.arange(self.pixels.shape[0]), np.diff(self.pixels.indptr))
        view = self.view[self.pixels.indices]
        first = np.flatnonzero((np.diff(row, prepend=-1) != 0) | (np.diff(view, prepend=-1) != 0))
        sums = np.add.reduceat(self.pixels.data.astype(np.float64), first) if len(first) else np.zeros(0)
        return row[first], view[first], first, sums

    def per_entry(self, first: np.ndarray, values: np.ndarray) -> np.ndarray:
        """`values` [L] of `runs` repeated for each entry of `pixels.data`."""
        return np.repeat(values, np.diff(first, append=self.pixels.nnz))
