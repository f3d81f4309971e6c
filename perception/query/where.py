"""`Where`, a filter on the position, distance, size and label of instances."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from perception.boxes import move_box
from perception.errors import InputError
from perception.geometry import check_similarity, move_points, scale_of
from perception.query.frames import Frame
from perception.query.regions import check_box
from perception.types import OrientedBox


@dataclass(frozen=True)
class Where:
    """The conditions that an instance must fulfil to be in the result; None = no condition.

    region: at least `share` of its points lie in this box. near: a point [3], or a pose [4, 4] of which only
    the origin is used; hits then carry their distance. within: largest distance of its nearest point from `near`.
    min_size, max_size: bounds on the longest side of its box. labels: it has one of these labels (case-insensitive).
    Lengths are in the unit of the query's frame.
    """

    region: OrientedBox | None = None
    share: float = 0.5
    near: np.ndarray | Sequence[float] | None = None
    within: float | None = None
    min_size: float | None = None
    max_size: float | None = None
    labels: Collection[str] | None = None

    def __post_init__(self) -> None:
        if self.region is not None:
            object.__setattr__(self, "region", check_box(self.region))
        if self.near is not None:
            object.__setattr__(self, "near", place(self.near))
        if self.labels is not None:
            names = [self.labels] if isinstance(self.labels, str) else list(self.labels)
            if not all(isinstance(name, str) for name in names):
                raise InputError(f"where: labels are {names[:3]}, expected texts")
            object.__setattr__(self, "labels", frozenset(tidy(name) for name in names))
        for name in ("share", "within", "min_size", "max_size"):
            value = getattr(self, name)
            if value is not None and (isinstance(value, bool) or not isinstance(value, (int, float, np.number))):
                raise InputError(f"where: {name} is {value!r}, expected a number")
            if value is not None and not 0 <= value < np.inf:
                raise InputError(f"where: {name} is {value}, expected a number of at least 0")
        if not 0 < self.share <= 1:
            raise InputError(f"where: share is {self.share}, expected more than 0 and at most 1")
        if self.within is not None and self.near is None:
            raise InputError("where: within needs near, the point or pose it is measured from")

    def in_map(self, frame: Frame | None) -> Where:
        """The same filter in the map's frame, given the frame that its values are in."""
        if frame is None:
            return self
        map_from_frame = frame.to_map
        scale = scale_of(map_from_frame)
        within, least, most = (None if x is None else x * scale for x in (self.within, self.min_size, self.max_size))
        return replace(
            self,
            region=None if self.region is None else move_box(map_from_frame, self.region),
            near=None if self.near is None else move_points(map_from_frame, np.asarray(self.near)),
            within=within,
            min_size=least,
            max_size=most,
        )


def place(point_or_pose: Any) -> np.ndarray:
    """[3] float64: a point as it is, or the origin of a pose [4, 4] (map_from_robot); InputError for other input."""
    try:
        array = np.asarray(point_or_pose, np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"near: expected a point [3] or a pose [4, 4], found {str(point_or_pose)[:60]!r}") from error
    if array.shape == (4, 4):
        return check_similarity(array, "near")[:3, 3]
    if array.shape != (3,) or not np.isfinite(array).all():
        raise InputError(f"near: expected a finite point [3] or pose [4, 4], found shape {list(array.shape)}")
    return array


def tidy(text: str) -> str:
    """A label normalised for comparison: case-folded, runs of white space replaced by one space."""
    return " ".join(text.casefold().split())
