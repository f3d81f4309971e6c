"""A map of Gaussians and instances: the one type that makers, queries, editors, exporters and viewers share."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from perception.errors import InputError
from perception.io.instance_index import InstanceIndex, build_index
from perception.io.map_files import MapFiles
from perception.io.map_views import locate_photo
from perception.types import View

M = TypeVar("M", bound="Map")
GAUSSIANS = ("means", "quats", "log_scales", "opacity_logits", "sh", "features", "instance_ids", "membership")
"""Fields with a row a Gaussian."""


PART = "language_"
"""Before the names of the arrays in `parts` that are as those in `language`."""


class PhotosMoved(UserWarning):
    """Photos of a map are missing or are other files than when it was made."""


@dataclass(eq=False, repr=False)
class Map:
    """A finished map, in memory (made from its fields) or on disk (`Map.open`: a field is read when first used).

    Arrays are float32: means [N, 3], quats [N, 4] wxyz, log_scales [N, 3], opacity_logits [N], sh [N, K, 3], as the PLY
    stores them; features [N, D], membership [N], and instance_ids [N] int32, −1 = none. instances: the list of
    instances.json. info: map.json without the views. views: the photos it was made from, sorted by name, `StoredView`
    in a map read from disk. language, parts: named arrays (see io.store), maybe none. index: the points of each
    instance. Reading a field may raise InputError naming the file when it is damaged; another map may take the folder's
    place meanwhile. Training has its own `gaussians.model.Gaussians`: the same numbers as torch parameters, which grow,
    split and carry gradients; layers without torch read maps too.
    """

    means: np.ndarray
    quats: np.ndarray
    log_scales: np.ndarray
    opacity_logits: np.ndarray
    sh: np.ndarray
    features: np.ndarray
    instance_ids: np.ndarray
    membership: np.ndarray
    instances: list[dict[str, Any]] = field(default_factory=list)
    info: dict[str, Any] = field(default_factory=dict)
    views: list[View] = field(default_factory=list)
    language: dict[str, np.ndarray] = field(default_factory=dict)
    parts: dict[str, np.ndarray] = field(default_factory=dict)
    path: Path | None = None
    index: InstanceIndex = field(init=False)
    _files: MapFiles | None = field(default=None, init=False)
    _warned: bool = field(default=False, init=False)

    @classmethod
    def open(cls: type[M], path: Path) -> M:
        """The map on disk at `path`; InputError when it is none, damaged, or of an unknown version."""
        gmap = cls.__new__(cls)
        gmap.path, gmap._files = Path(path), MapFiles(path)
        return gmap

    @classmethod
    def of(cls: type[M], gmap: Map, **changes: Any) -> M:
        """`gmap` as this class with other values for some fields; arrays are shared, and none is read for it."""
        made = cls.__new__(cls)
        made.path, made._files = gmap.path, gmap._files
        made.__dict__.update({name: value for name, value in vars(gmap).items() if name in _FIELDS} | changes)
        if changes.keys() & {"means", "instance_ids"}:
            made.index = build_index(made.means, made.instance_ids)
        return made

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            """Reads a field at its first use; threads that ask at once agree on one value."""
            if name == "index" and self._files is None:
                value = build_index(self.means, self.instance_ids)
            elif name in _FIELDS and self._files is not None:
                value = self._files.read(name)
            else:
                raise AttributeError(f"{type(self).__name__} has no attribute '{name}'")
            return self.__dict__.setdefault(name, value)

    def load(self: M) -> M:
        """Reads all fields now and lets go of the files."""
        for name in _FIELDS:
            getattr(self, name)
        self._files = None
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
    def part_language(self) -> dict[str, np.ndarray]:
        """As `language`, of the parts: a row a part in ascending id; {} without parts or embeddings."""
        return {n.removeprefix(PART): array for n, array in self.parts.items() if n.startswith(PART)}

    @property
    def map_id(self) -> str:
        """Short name of this very map with these very labels; another one has another."""
        return "unsaved" if self._files is None else self._files.map_id

    @property
    def frame(self) -> str:
        """The name of the map's frame."""
        return str(self.info.get("frame", "map"))

    @property
    def metric(self) -> bool:
        """Whether the unit of length is known to be the metre."""
        return bool(self.info.get("metric", False))

    def with_photo(self, view: View) -> View:
        """`view` with the place where its photo lies now; InputError when it is missing or another file.

        The first such case of a map is also told as a PhotosMoved warning.
        """
        try:
            return replace(view, photo=locate_photo(view, self.path))
        except InputError as error:
            if not self._warned:
                self._warned = True
                warnings.warn(f"{self.path}: pictures are left out: {error}", PhotosMoved, stacklevel=2)
            raise

    def located_views(self) -> list[View]:
        """`with_photo` of all views; the photo is the empty path, which no reader can open, where it is missing."""
        found = []
        for view in self.views:
            try:
                found.append(self.with_photo(view))
            except InputError:
                found.append(replace(view, photo=Path()))
        return found


_FIELDS = (*GAUSSIANS, "instances", "info", "views", "language", "parts", "index")
