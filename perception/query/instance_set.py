"""Instances of one kind as hits: those of a map, their parts, or groups of them."""

from __future__ import annotations

from collections.abc import Collection
from copy import deepcopy
from dataclasses import replace
from functools import cache, cached_property, partial
from typing import Any

import numpy as np

from perception.boxes import BOX_TRIM, oriented_box
from perception.colors import rgb8_from_sh
from perception.map.history import is_removed, last_seen, since
from perception.map.map import InstanceIndex, Map, build_index
from perception.query.hit import Hit
from perception.query.spatial_index import SpatialIndex
from perception.query.where import Where, tidy
from perception.types import OrientedBox


class InstanceSet:
    """entries: as in instances.json. language: as `Map.language`, a row per entry, or {}. ids [N] int32: the entry's id
    of each Gaussian, −1 = none; None: the map's `instance_ids`. A `row` is the number of an entry."""

    def __init__(
        self, gmap: Map, entries: list[dict[str, Any]], language: dict[str, np.ndarray], ids: np.ndarray | None = None
    ) -> None:
        self.entries, self.language = entries, language
        self._gmap, self._ids = gmap, ids
        self._covariance, self._box = cache(self._spread), cache(self._recorded_box)

    @cached_property
    def index(self) -> InstanceIndex:
        return self._gmap.index if self._ids is None else build_index(self._gmap.means, self._ids)

    @cached_property
    def spatial(self) -> SpatialIndex:
        return SpatialIndex(self.index)

    def fulfils(self, row: int, where: Where) -> bool:
        """Whether entry `row` fulfils `where`, which is in the map's frame."""
        number, box = int(self.entries[row]["id"]), self._box(row)
        longest = max(box.extent)
        if not self.has_label(row, where.labels):
            return False
        if where.min_size is not None and longest < where.min_size:
            return False
        if where.max_size is not None and longest > where.max_size:
            return False
        if where.region is not None and self.spatial.share_inside(number, where.region) < where.share:
            return False
        return where.within is None or self.spatial.distance(number, np.asarray(where.near)) <= where.within

    def has_label(self, row: int, labels: Collection[str] | None) -> bool:
        """Whether entry `row` has one of these labels, which are tidy; None: any or none."""
        return labels is None or tidy(self.entries[row].get("label") or "") in labels

    def measured(self, row: int, where: Where, score: float | None = None) -> Hit:
        """As `hit`, with its distance if `where.near` is given and it has points."""
        hit = self.hit(row, score)
        if where.near is None or not hit.num_points:
            return hit
        return replace(hit, distance=self.spatial.distance(int(self.entries[row]["id"]), np.asarray(where.near)))

    def hit(self, row: int, score: float | None = None) -> Hit:
        """Entry `row` as a Hit; score: the mapper's confidence when None."""
        entry = self.entries[row]
        number = int(entry["id"])
        return Hit(
            number,
            float(entry["score"]) if score is None else score,
            self.index.of(number),
            np.array(entry["centroid"], np.float64),
            deepcopy(self._box(row)),  # the caller may write into it
            entry.get("label"),
            self.views(row),
            self._covariance(row),
            self._gmap.frame,
            colors=partial(self._colors, number),
            **record_of(entry, self._gmap.newest_visit),
        )

    def views(self, row: int) -> tuple[str, ...]:
        """Names of the views that show the entry best, best first."""
        if not self.language:
            return ()
        return tuple(self.language["view_names"][self._views_of(row)].tolist())

    def best_box(self, row: int) -> tuple[int, int, int, int]:
        """The box x0, y0, x1, y1 of the entry in the first of its `views`, pixels of the size used for training."""
        x0, y0, x1, y1 = self.language["view_boxes"][self._views_of(row).start].tolist()
        return x0, y0, x1, y1

    def _views_of(self, row: int) -> slice:
        """The rows of the entry's views."""
        start = int(self.language["view_counts"][:row].sum())
        return slice(start, start + int(self.language["view_counts"][row]))

    def _recorded_box(self, row: int) -> OrientedBox:
        """The entry's box; of a group, which has none on record, that around its points."""
        entry = self.entries[row]
        if "obb" in entry:
            return OrientedBox.from_json(entry["obb"])
        return oriented_box(self.index.of(int(entry["id"])), BOX_TRIM)

    def _spread(self, row: int) -> np.ndarray:
        """[3, 3] covariance of the entry's points."""
        points = self.index.of(int(self.entries[row]["id"])).astype(np.float64)
        centred = points - points.mean(axis=0) if len(points) else points
        covariance = centred.T @ centred / max(len(points), 1)
        covariance.setflags(write=False)
        return covariance

    def _colors(self, number: int) -> np.ndarray:
        """Colours [P, 3] uint8 of the points of the entry with this id, in the order of `index`; grey where it stood at
        an earlier visit, as these are not kept."""
        ids = self._gmap.instance_ids if self._ids is None else self._ids
        colors, points = rgb8_from_sh(self._gmap.sh[ids == number, 0]), self.index.of(number)
        return colors if len(colors) == len(points) else np.full(points.shape, 128, np.uint8)


def record_of(entry: dict[str, Any], newest: int) -> dict[str, Any]:
    """The fields of a `Hit` that the record of an entry gives, {} without one."""
    if "state" not in entry:
        return {}
    past = entry.get("past", [])
    left = past[-1] if past and not past[-1].get("gone") and not is_removed(entry) else None
    was = None if left is None else np.array(left["centroid"], np.float64)
    return {"state": entry["state"], "last_seen": last_seen(entry, newest), "since": since(entry), "was": was}
