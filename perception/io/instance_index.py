"""Points grouped by instance, so that the points of one instance are a slice and need no pass over the whole map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from perception.errors import InputError


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

    def to_arrays(self) -> dict[str, np.ndarray]:
        """As named arrays, the inverse of `from_arrays`."""
        return {"ids": self.ids, "starts": self.starts, "points": self.points}


def build_index(means: np.ndarray, instance_ids: np.ndarray) -> InstanceIndex:
    """The index of means [N, 3] with instance_ids [N], −1 = none."""
    held = np.asarray(instance_ids)
    rows = np.argsort(held, kind="stable")
    rows = rows[np.searchsorted(held[rows], 0) :]
    ids, counts = np.unique(held[rows], return_counts=True)
    starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    return _sealed(ids.astype(np.int64), starts, np.asarray(means)[rows].astype(np.float32, copy=False))


def from_arrays(arrays: dict[str, np.ndarray], name: str) -> InstanceIndex:
    """The inverse of `to_arrays`; InputError naming the file `name` when the arrays are inconsistent."""
    try:
        ids, starts, points = arrays["ids"], arrays["starts"], arrays["points"]
        fits = ids.ndim == starts.ndim == 1 and len(starts) == len(ids) + 1 and points.shape[1:] == (3,)
        fits = fits and {ids.dtype.kind, starts.dtype.kind} == {"i"} and points.dtype == np.float32
        fits = fits and starts[0] == 0 and starts[-1] == len(points)
        fits = fits and bool((np.diff(starts) > 0).all() and (np.diff(ids) > 0).all())
    except (KeyError, IndexError, AttributeError):
        fits = False
    if not fits:
        raise InputError(f"{name}: its arrays do not fit together; the map is damaged, build it again")
    return _sealed(ids, starts, points)


def _sealed(ids: np.ndarray, starts: np.ndarray, points: np.ndarray) -> InstanceIndex:
    points = np.ascontiguousarray(points)
    points.setflags(write=False)
    return InstanceIndex(ids, starts, points)
