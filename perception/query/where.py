"""Frames other than the map's, boxes as regions of space, and `Where`, a filter on position, size and label."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Any
from unicodedata import normalize

import numpy as np

from perception.boxes import check_box, move_box
from perception.errors import InputError
from perception.geometry import check_similarity, move_points, numbers, scale_of
from perception.types import OrientedBox


@dataclass(frozen=True)
class Frame:
    """A named frame. from_map [4, 4]: the transform frame_from_map, rigid or a similarity.

    A scale other than 1 converts units, for example those of a reconstruction into metres. InputError for a matrix that
    shears or mirrors.

    >>> base = Frame("base_link", np.array([[0, 1, 0, -1], [-1, 0, 0, 2], [0, 0, 1, -0.4], [0, 0, 0, 1]]))
    >>> hit = perception.load_map("kitchen.gsmap").get(0, frame=base)
    >>> hit.frame, bool(np.allclose(hit.centroid, [-1, 2, -0.4], atol=0.05))
    ('base_link', True)
    """

    name: str
    from_map: np.ndarray

    def __post_init__(self) -> None:
        if not isinstance(self.name, str):
            raise InputError(f"frame: the name is {self.name!r}, expected a text")
        object.__setattr__(self, "from_map", check_similarity(self.from_map, f"frame '{self.name}'"))

    @property
    def to_map(self) -> np.ndarray:
        """map_from_frame [4, 4]."""
        return np.linalg.inv(self.from_map)


@dataclass(frozen=True)
class Where:
    """The conditions that an instance must fulfil to be in the result; None = no condition.

    region: at least `share` of its points lie in this box. near: a point [3], or a pose [4, 4] of which only
    the origin is used; hits then carry their distance. within: largest distance of its nearest point from `near`.
    min_size, max_size: bounds on the longest side of its box. labels: it has one of these labels (case-insensitive).
    Lengths are in the unit of the query's frame. InputError for a value that is no such condition.

    >>> small = Where(max_size=0.6, near=[0.0, 0.0, 0.0], within=0.9)
    >>> [hit.instance_id for hit in perception.load_map("kitchen.gsmap").find(small)]
    [0, 1, 3]
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
            object.__setattr__(self, "near", position_of(self.near))
        if self.labels is not None:
            names = [self.labels] if isinstance(self.labels, str) else self.labels
            if not isinstance(names, Collection) or not all(isinstance(name, str) for name in names):
                raise InputError(f"where: labels are {names!r:.80}, expected texts")
            object.__setattr__(self, "labels", frozenset(tidy(name) for name in names) - {""})
        for name in ("share", "within", "min_size", "max_size"):
            check_length(f"where: {name}", getattr(self, name))
        if not 0 < (self.share or 0) <= 1:
            raise InputError(f"where: share is {self.share}, expected more than 0 and at most 1")
        if self.within is not None and self.near is None:
            raise InputError("where: within needs near, the point or pose it is measured from")

    def in_map(self, frame: Frame | None) -> Where:
        """The same filter in the map's frame, given the frame that its values are in."""
        if frame is None:
            return self
        scale = scale_of(frame.to_map)
        lengths = {name: getattr(self, name) for name in ("within", "min_size", "max_size")}
        moved: dict[str, Any] = {name: scale * value for name, value in lengths.items() if value is not None}
        if self.region is not None:
            moved["region"] = move_box(frame.to_map, self.region)
        if self.near is not None:
            moved["near"] = move_points(frame.to_map, np.asarray(self.near))
        return replace(self, **moved)


def wanted_in_map(where: Where | None, frame: Frame | None) -> Where:
    """The filter of a question in the map's frame, given the frame of the question; InputError for other types."""
    if where is not None and not isinstance(where, Where):
        raise InputError(f"where: found {type(where).__name__}, expected a Where")
    check_frame(frame)
    return (where or Where()).in_map(frame)


def check_frame(frame: Any) -> None:
    """InputError unless it is a Frame or None."""
    if frame is not None and not isinstance(frame, Frame):
        raise InputError(f"frame: found {type(frame).__name__}, expected a Frame(name, from_map)")


def check_length(name: str, value: Any) -> None:
    """InputError unless it is a number of at least 0, or None."""
    if value is not None and (isinstance(value, bool) or not isinstance(value, (int, float, np.number))):
        raise InputError(f"{name} is {value!r}, expected a number")
    if value is not None and not 0 <= value < np.inf:
        raise InputError(f"{name} is {value}, expected a number of at least 0")


def check_size(name: str, value: Any) -> None:
    """InputError unless it is a number above 0."""
    if not isinstance(value, (int, float, np.number)) or not 0 < value < np.inf:
        raise InputError(f"{name} is {value!r:.80}, expected a positive number of metres")


def position_of(point_or_pose: Any) -> np.ndarray:
    """[3] float64: a point as it is, or the origin of a pose [4, 4] (map_from_robot); InputError for other input."""
    array = numbers(point_or_pose, "near", "a point [3] or a pose [4, 4]")
    if array.shape == (4, 4):
        return check_similarity(array, "near")[:3, 3]
    if array.shape != (3,):
        raise InputError(f"near: expected a finite point [3] or pose [4, 4], found shape {list(array.shape)}")
    return array


def tidy(text: str) -> str:
    """A label normalised for comparison: case-folded, accents composed (NFC), runs of white space and "_" one space."""
    return " ".join(normalize("NFC", text.casefold()).replace("_", " ").split())


def axis_box(low: Sequence[float] | np.ndarray, high: Sequence[float] | np.ndarray) -> OrientedBox:
    """The box along the axes between two corners [3]; InputError unless low <= high.

    >>> counter = axis_box([-0.5, -0.5, -0.5], [2.5, 0.5, 0.5])
    >>> counter.center.tolist(), counter.extent.tolist()
    ([1.0, 0.0, 0.0], [3.0, 1.0, 1.0])
    >>> [hit.instance_id for hit in perception.load_map("kitchen.gsmap").in_box(counter)]
    [0, 1, 2]
    """
    a, b = numbers(low, "region: low corner"), numbers(high, "region: high corner")
    if a.shape != (3,) or b.shape != (3,) or (a > b).any():
        raise InputError(f"region: corners {a.tolist()} and {b.tolist()}, expected two [3] points with low <= high")
    return OrientedBox((a + b) / 2, np.eye(3), b - a)
