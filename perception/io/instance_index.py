"""Points grouped by instance, so that the points of one instance are a slice and need no pass over the whole map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class InstanceIndex:
    """ids [K] int64, ascending; points [M, 3] float32, read-only, grouped by id and in map order within an id;
    starts [K + 1] int64: instance ids[k] owns points[starts[k] : starts[k + 1]]. Gaussians without one are left out.
    """

    ids: np.ndarray
    starts: np.ndarray
    points: np.ndarray

    def of(self, instance_id: int) -> np.ndarray:
        """The instance's points [P, 3]; P = 0 for an id without Gaussians."""
        place = int(np.searchsorted(self.ids, instance_id))
        if place == len(self.ids) or self.ids[place] != instance_id:
            return self.points[:0]
        return self.points[self.starts[place] : self.starts[place + 1]]


def build_index(means: np.ndarray, instance_ids: np.ndarray) -> InstanceIndex:
    """The index of means [N, 3] with instance_ids [N], −1 = none."""
    held = np.asarray(instance_ids)
    rows = np.argsort(held, kind="stable")
    rows = rows[np.searchsorted(held[rows], 0) :]
    ids, counts = np.unique(held[rows], return_counts=True)
    starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    points = np.ascontiguousarray(np.asarray(means)[rows], np.float32)
    points.setflags(write=False)
    return InstanceIndex(ids.astype(np.int64), starts, points)
