"""A map of Gaussians and instances: the common type of mapping, queries, editing, export and viewing."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Generic, TypeVar, overload

import numpy as np

from perception.colors import rgb8_from_sh
from perception.errors import InputError
from perception.map.files import MapFiles
from perception.map.model import PREFIX
from perception.photos.view_json import locate_photo
from perception.types import View


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
        k = int(np.searchsorted(self.ids, instance_id))
        if k == len(self.ids) or self.ids[k] != instance_id:
            return self.points[:0]
        return self.points[self.starts[k] : self.starts[k + 1]]


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


T = TypeVar("T")
M = TypeVar("M", bound="Map")
GAUSSIANS = ("means", "quats", "log_scales", "opacity_logits", "sh", "features", "instance_ids", "membership")
"""Fields with one row per Gaussian."""
_FIELDS = (*GAUSSIANS, "instances", "info", "views", "language", "parts", "groups", "past")


def language_in(arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """As `Map.language`, of the parts or groups: one row per part in ascending id; {} without embeddings."""
    return {name.removeprefix(PREFIX): array for name, array in arrays.items() if name.startswith(PREFIX)}


def prefixed(language: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Inverse of `language_in`."""
    return {PREFIX + name: array for name, array in language.items()}


MAX_SIDE = 800
"""Pixels of the long side of photos, for maps that do not record at which size they were trained."""


class PhotosMoved(UserWarning):
    """Warning: photos of a map are missing, or their files have changed since the map was made."""


class Lazy(Generic[T]):
    """A field of `Map`. One that was not given is read from the map's files when it is first used, or made by `empty`
    in a map without files. Concurrent threads get the same value."""

    def __init__(self, empty: Callable[[], T] | None = None) -> None:
        self._empty = empty

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = name

    @overload
    def __get__(self, gmap: None, owner: type) -> Any: ...
    @overload
    def __get__(self, gmap: Map, owner: type) -> T: ...
    def __get__(self, gmap: Map | None, owner: type) -> Any:
        if gmap is None:  # the default value of the field
            return self
        if self._name not in gmap.__dict__:
            if gmap.files is not None:
                value = gmap.files.read(self._name)
            elif self._empty is not None:
                value = self._empty()
            else:
                raise AttributeError(f"{owner.__name__}: was made without {self._name}")
            gmap.__dict__.setdefault(self._name, value)
        return gmap.__dict__[self._name]

    def __set__(self, gmap: Map, value: T) -> None:
        if value is not self:
            gmap.__dict__[self._name] = value


@dataclass(eq=False, repr=False)
class Map:
    """A finished map, in memory (made from its fields) or on disk (`Map.open`: a field is read when first used).

    Arrays are float32: means [N, 3], quats [N, 4] wxyz, log_scales [N, 3], opacity_logits [N], sh [N, K, 3], as the PLY
    stores them; features [N, D], membership [N], and instance_ids [N] int32, −1 = none. instances: the list of
    instances.json. info: map.json without the views. views: the photos it was made from, sorted by name, `StoredView`
    in a map read from disk. language, parts, groups, past: named arrays (see map.write), possibly empty. index: the
    points of each instance. Reading a field raises InputError naming the file when it is damaged. The folder may be
    replaced by another map meanwhile. This type needs no torch; training uses `gaussians.model.Gaussians`, which holds
    the same values as torch tensors.

    >>> gmap = Map.open(Path("kitchen.gsmap"))
    >>> gmap.means.shape, gmap.means.dtype, gmap.instance_ids.min()
    ((3000, 3), dtype('float32'), np.int32(-1))
    """

    means: Lazy[np.ndarray] = Lazy()
    quats: Lazy[np.ndarray] = Lazy()
    log_scales: Lazy[np.ndarray] = Lazy()
    opacity_logits: Lazy[np.ndarray] = Lazy()
    sh: Lazy[np.ndarray] = Lazy()
    features: Lazy[np.ndarray] = Lazy()
    instance_ids: Lazy[np.ndarray] = Lazy()
    membership: Lazy[np.ndarray] = Lazy()
    instances: Lazy[list[dict[str, Any]]] = Lazy(list)
    info: Lazy[dict[str, Any]] = Lazy(dict)
    views: Lazy[list[View]] = Lazy(list)
    language: Lazy[dict[str, np.ndarray]] = Lazy(dict)
    parts: Lazy[dict[str, np.ndarray]] = Lazy(dict)
    groups: Lazy[dict[str, np.ndarray]] = Lazy(dict)
    past: Lazy[dict[str, np.ndarray]] = Lazy(dict)
    path: Path | None = None
    files: MapFiles | None = None
    _warned: bool = field(default=False, init=False)
    _id: str = field(default="unsaved", init=False)

    @classmethod
    def open(cls: type[M], path: Path, **fields: Any) -> M:
        """The map on disk at `path`; InputError when it is missing, damaged, or of an unknown version."""
        return cls(path=Path(path), files=MapFiles(path), **fields)

    @classmethod
    def of(cls: type[M], gmap: Map, **changes: Any) -> M:
        """`gmap` as an instance of this class, with `changes` to its fields; arrays are shared, not read."""
        known = {name: value for name, value in vars(gmap).items() if name in _FIELDS}
        return cls(path=gmap.path, files=gmap.files, **{**known, **changes})

    @cached_property
    def index(self) -> InstanceIndex:
        """The points of each instance."""
        return build_index(self.means, self.instance_ids)

    def load(self: M) -> M:
        """Reads all fields now and closes the files."""
        for name in _FIELDS:
            getattr(self, name)
        self._id, self.files = self.map_id, None
        return self

    def __len__(self) -> int:
        return len(self.means)

    @property
    def scales(self) -> np.ndarray:
        """[N, 3] standard deviations along each Gaussian's axes."""
        return np.exp(self.log_scales)

    @property
    def opacities(self) -> np.ndarray:
        """[N] in (0, 1)."""
        return 1 / (1 + np.exp(-self.opacity_logits))

    @property
    def poses(self) -> np.ndarray:
        """[V, 4, 4] float64 camera_from_world of the views."""
        return np.array([view.camera_from_world for view in self.views], np.float64).reshape(-1, 4, 4)

    @property
    def group_ids(self) -> np.ndarray:
        """[N] int32 group of each Gaussian, −1 = none."""
        ids = np.array([-1, *(entry["id"] for entry in self.instances)])
        owner = np.array([-1, *self.groups.get("of", np.full(len(ids) - 1, -1))], np.int32)
        order = np.argsort(ids)
        return owner[order[np.searchsorted(ids, self.instance_ids, sorter=order)]]

    @property
    def map_id(self) -> str:
        """Short identifier of the map and its labels on disk; it changes when either changes. "unsaved" without one."""
        return self._id if self.files is None else self.files.map_id

    @property
    def next_id(self) -> int:
        """The id of the next new instance: above those of all instances and parts, also of removed ones, which
        `next_id` of map.json tells."""
        used = (one["id"] for entry in self.instances for one in (entry, *entry.get("parts", ())))
        return max([self.info.get("next_id", 0), *(i + 1 for i in used)])

    @property
    def newest_visit(self) -> int:
        """The number of the newest visit (see `map.history`), 0 in a map of one."""
        return len(self.info.get("visits") or [0]) - 1

    def setting(self, group: str, name: str, default: Any) -> Any:
        """The setting GROUP.NAME that the map was made with; `default` where it is not recorded, or is none."""
        value = self.info.get("config", {}).get(group, {}).get(name)
        return default if value is None else value

    @property
    def frame(self) -> str:
        """The name of the map's frame."""
        return str(self.info.get("frame", "map"))

    @property
    def metric(self) -> bool:
        """Whether the unit of length is known to be the metre."""
        return bool(self.info.get("metric", False))

    def to_open3d(self) -> Any:
        """All Gaussians' means as an `open3d.t.geometry.PointCloud` in the map's frame: positions, colors (float32 in
        [0, 1]), instance_id (int32, −1 = none). InputError without the package open3d."""
        from perception.io.open3d import tensor_cloud

        return tensor_cloud(self.means, rgb8_from_sh(self.sh[:, 0]), self.instance_ids)

    def with_photo(self, view: View) -> View:
        """`view` with the current path of its photo; InputError when the photo is missing or has changed.
        The first such error of a map also issues a PhotosMoved warning."""
        try:
            return replace(view, photo=locate_photo(view, self.path))
        except InputError as error:
            if not self._warned:
                self._warned = True
                warnings.warn(f"{self.path}: pictures are left out: {error}", PhotosMoved, stacklevel=2)
            raise

    def located_views(self) -> list[View]:
        """`with_photo` of all views; views whose photo is missing get an empty path."""
        views = []
        for view in self.views:
            try:
                views.append(self.with_photo(view))
            except InputError:
                views.append(replace(view, photo=Path()))
        return views
