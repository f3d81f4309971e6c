"""A map directory opened without reading it: facts now, arrays mapped into memory, the rest when it is asked for."""

from __future__ import annotations

import contextlib
import hashlib
import json
import threading
from pathlib import Path
from typing import Any

import numpy as np

from perception.errors import InputError
from perception.io import instance_index
from perception.io.arrays import DAMAGE, map_npy, read_npz
from perception.io.atomic import recover
from perception.io.checksums import EDITABLE, FACTS, check_file, check_sizes
from perception.io.documents import brief
from perception.io.instance_index import InstanceIndex, build_index
from perception.io.ply import map_ply

FORMAT_VERSION = 1
_ARRAYS = {"features": 2, "instance_ids": 1, "membership": 1}
ARCHIVES = ("cameras", "language", "index", "parts")
_TRIES = 5

Signature = tuple[tuple[int, int, int], ...]


class MapFiles:
    """What lies in a map directory, consistent even if another map takes its place right now or later.

    info: map.json. instances: the list of instances.json. Files are opened (mapped) here and stay open, so a map that
    is replaced or deleted can still be read through this object. Arrays that answers need are read into memory;
    Gaussians and features are mapped, so whoever truncates those files in place (no writer of ours does) ends readers.
    """

    def __init__(self, path: Path):
        self.path = Path(path)
        self._lock = threading.Lock()
        self._made: dict[str, Any] = {}
        _put_back(self.path)
        for left in reversed(range(_TRIES)):
            self._identity = _folder_identity(self.path)
            try:
                self._open()
            except InputError:
                if left and self._identity != _folder_identity(self.path):
                    continue  # replaced while we opened it
                raise
            if self._identity == _folder_identity(self.path):
                return
        raise InputError(f"{self.path}: was replaced again and again while it was opened; try again")

    def _open(self) -> None:
        self.info, facts = _read_facts(self.path)
        check_sizes(self.path, self.info)
        self.instances, raw = _read_instances(self.path / EDITABLE)
        self.map_id = hashlib.sha256(facts + b"\0" + raw).hexdigest()[:12]
        try:
            self._rows = map_ply(self.path / "gaussians.ply", "vertex")
            self._arrays = {name: self._map_array(name, sides) for name, sides in _ARRAYS.items()}
            self._archives = {name: _bytes(self.path / f"{name}.npz") for name in ARCHIVES}
        except OSError as error:
            raise InputError(
                f"{self.path}: the map is damaged ({error}); build it again with `perception map`"
            ) from error
        for name, array in self._arrays.items():
            if len(array) != len(self._rows):
                raise InputError(
                    f"{self.path / name}.npy: holds {len(array)} rows, expected {len(self._rows)} as in "
                    "gaussians.ply; the map is damaged, build it again"
                )

    def _map_array(self, name: str, sides: int) -> np.ndarray:
        file = self.path / f"{name}.npy"
        try:
            array = map_npy(file)
        except FileNotFoundError as error:
            raise InputError(f"{file}: is missing; the map is damaged, build it again or copy it anew") from error
        except DAMAGE as error:
            raise InputError(f"{file}: cannot be read ({brief(error)}); the map is damaged, build it again") from error
        kind = "i" if name == "instance_ids" else "f"
        if array.ndim != sides or array.dtype.kind != kind:
            raise InputError(f"{file}: holds {array.dtype} of shape {list(array.shape)}; the map is damaged")
        return array

    @property
    def means(self) -> np.ndarray:
        """[N, 3] float32, copied out of gaussians.ply."""
        return np.stack([self._rows[axis] for axis in "xyz"], axis=1).astype(np.float32, copy=False)

    @property
    def instance_ids(self) -> np.ndarray:
        """[N] int32, mapped, −1 = none."""
        return self._arrays["instance_ids"]

    @property
    def cameras(self) -> dict[str, np.ndarray]:
        """The views' arrays; {} in a map without."""
        return self._once("cameras", lambda: self._unpack("cameras"))

    @property
    def language(self) -> dict[str, np.ndarray]:
        """What the encoder knows of each instance; {} in a map without."""
        return self._once("language", lambda: self._unpack("language"))

    @property
    def parts(self) -> dict[str, np.ndarray]:
        """Which part of its instance each Gaussian is (see io.store); {} in a map without parts."""
        return self._once("parts", lambda: self._unpack("parts"))

    def instance_index(self) -> InstanceIndex:
        """The points of each instance; made from the Gaussians for maps that were written before it was stored."""
        return self._once("index", self._make_index)

    @property
    def rows(self) -> np.ndarray:
        """gaussians.ply as a structured array [N], mapped."""
        return self._rows

    @property
    def arrays(self) -> dict[str, np.ndarray]:
        """features [N, D] float32, instance_ids [N] int32, membership [N] float32, mapped."""
        return self._arrays

    def check_contents(self) -> None:
        """Compares the SHA-256 of every file read whole with the one recorded; InputError names the first that
        differs. Nothing is compared once another map has taken the directory's place."""
        if _folder_identity(self.path) != self._identity:
            return
        for name in self.info.get("files", {}):
            if name != EDITABLE:
                check_file(self.path, self.info, name)

    def _make_index(self) -> InstanceIndex:
        arrays = self._unpack("index")
        if not arrays:
            return build_index(self.means, self.instance_ids)
        index = instance_index.from_arrays(arrays, f"{self.path / 'index.npz'}")
        if len(index.points) != np.count_nonzero(np.asarray(self.instance_ids) >= 0):
            raise InputError(f"{self.path / 'index.npz'}: does not fit instance_ids.npy; the map is damaged")
        return index

    def _once(self, name: str, make: Any) -> Any:
        with self._lock:
            if name in self._made:
                return self._made[name]
        made = make()
        with self._lock:
            return self._made.setdefault(name, made)

    def _unpack(self, name: str) -> dict[str, np.ndarray]:
        """The arrays of an .npz; its CRC-32s tell damage."""
        raw, file = self._archives[name], self.path / f"{name}.npz"
        return {} if raw is None else read_npz(raw, file, "the map is damaged, build it again")


def read_info(path: Path) -> dict[str, Any]:
    """map.json alone; raises InputError when `path` is no map or of a version this program does not read."""
    _put_back(Path(path))
    return _read_facts(Path(path))[0]


def map_signature(path: Path) -> Signature:
    """Changes whenever another map or other labels lie at `path`: who, when and how big. InputError when none does."""
    try:
        stats = [file.stat() for file in (path, path / FACTS, path / EDITABLE)]
    except OSError as error:
        raise InputError(f"{path}: the map is gone ({error.strerror}); build it again or put it back") from error
    return tuple((stat.st_ino, stat.st_mtime_ns if n else 0, stat.st_size if n else 0) for n, stat in enumerate(stats))


def _put_back(path: Path) -> None:
    """Where two folders cannot be exchanged in one step, a writer killed between its two renames leaves the old map
    aside; it is put back under its name."""
    if not path.exists():
        with contextlib.suppress(OSError):
            recover(path)


def _folder_identity(path: Path) -> tuple[int, int]:
    try:
        stat = path.stat()
    except OSError:
        return (0, 0)
    return (stat.st_dev, stat.st_ino)


def _read_facts(path: Path) -> tuple[dict[str, Any], bytes]:
    file = path / FACTS
    if not file.is_file():
        raise InputError(f"{path}: is no map (no map.json inside); give a directory made by `perception map`")
    try:
        raw = file.read_bytes()
        info = json.loads(raw)
        version = info["format_version"]
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(f"{file}: cannot be read as a map's facts ({error})") from error
    if isinstance(version, int) and not isinstance(version, bool) and version != FORMAT_VERSION:
        advice = (
            f"it was made by an older perception; build the map again from {info.get('source', 'its photos')}"
            if version < FORMAT_VERSION
            else "it was made by a newer perception; update this one"
        )
        raise InputError(f"{file}: format_version is {version}, this program reads {FORMAT_VERSION}: {advice}")
    if version != FORMAT_VERSION or isinstance(version, bool):
        raise InputError(f"{file}: format_version is {version!r}, expected {FORMAT_VERSION}; the map is damaged")
    return info, raw


def _read_instances(file: Path) -> tuple[list[dict[str, Any]], bytes]:
    try:
        raw = file.read_bytes()
        instances = json.loads(raw)["instances"]
        for entry in instances:
            _check_instance(entry)
        if len({entry["id"] for entry in instances}) != len(instances):
            raise ValueError("an id occurs twice")
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        told = f"no {error}" if isinstance(error, KeyError) else str(error)
        raise InputError(
            f"{file}: cannot be read as instances ({told}); the map is damaged, build it again or copy it anew"
        ) from error
    return instances, raw


def _check_instance(entry: dict[str, Any]) -> None:
    """What every reader relies on: a whole id, finite numbers where numbers belong, a label that is a text or null."""
    if isinstance(entry["id"], bool) or not isinstance(entry["id"], int):
        raise ValueError(f"id {entry['id']!r} is no whole number")
    box = entry["obb"]
    for name, value, shape in (
        ("centroid", entry["centroid"], (3,)),
        ("obb.center", box["center"], (3,)),
        ("obb.rotation", box["rotation"], (3, 3)),
        ("obb.extent", box["extent"], (3,)),
        ("score", entry["score"], ()),
    ):
        numbers = np.asarray(value, np.float64)
        if numbers.shape != shape or not np.isfinite(numbers).all():
            raise ValueError(f"instance {entry['id']}: {name} is not {'a number' if not shape else list(shape)}")
    label = entry.get("label")
    if label is not None and not isinstance(label, str):
        raise ValueError(f"instance {entry['id']}: label is {type(label).__name__}, expected a text or null")


def _bytes(file: Path) -> bytes | None:
    return file.read_bytes() if file.is_file() else None
