"""The files of a map folder: map.json is read at opening, arrays are memory-mapped, other data are read on demand."""

from __future__ import annotations

import hashlib
import threading
from codecs import BOM_UTF8
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from perception.errors import InputError
from perception.io.arrays import map_npy, read_npz
from perception.io.atomic import current
from perception.io.documents import brief, refusing
from perception.io.json_shapes import parsed
from perception.io.ply import map_ply
from perception.map.checksums import EDITABLE, FACTS, STORE, check_file, check_sizes, damaged
from perception.map.history import is_removed
from perception.map.model import check_archive, check_facts, check_ids, check_instances
from perception.photos.view_json import view_from_json

FORMAT_VERSION = 2
_ARRAYS = {"features": 2, "instance_ids": 1, "membership": 1}
ARCHIVES = ("language", "parts", "groups", "past")
_TRIES = 5

Signature = tuple[tuple[int, int, int], ...]


class MapFiles:
    """The contents of a map folder, consistent also when the folder is replaced by another map at any time.

    Files are opened (memory-mapped) by the constructor and stay open, so a replaced or deleted map can still be read
    through this object. Truncating a mapped file in place, which no writer of this package does, crashes the reader.
    facts: map.json. info: facts without the views. instances: the list of instances.json. map_id: hash of both files.
    rows: of gaussians.ply, as it is.
    """

    def __init__(self, path: Path):
        self._lock = threading.Lock()
        self._checked = False
        for left in reversed(range(_TRIES)):
            self.path = current(Path(path))
            self._identity = _folder_identity(self.path)
            try:
                self._open()
            except InputError:
                if left and self._identity != _folder_identity(self.path):
                    continue  # the folder was replaced during opening
                raise
            if self._identity == _folder_identity(self.path):
                return
        raise InputError(f"{self.path}: was replaced again and again while it was opened; try again")

    def _open(self) -> None:
        facts, raw_facts = _read_facts(self.path)
        check_sizes(self.path, facts)
        for file in (self.path / name for name in (EDITABLE, "gaussians.ply", *(f"{name}.npy" for name in _ARRAYS))):
            if file.exists() and not file.is_file():  # to open a FIFO would mean to wait for its writer
                raise damaged(file, "is no file")
        self.facts = facts
        self.info = {key: value for key, value in facts.items() if key != "views"}
        self.instances, raw = _read_instances(self.path / EDITABLE, facts)
        self.map_id = hashlib.sha256(raw_facts + b"\0" + raw).hexdigest()[:12]
        try:
            self.rows = map_ply(self.path / "gaussians.ply", "vertex")
            self._arrays = {name: self._map_array(name, sides) for name, sides in _ARRAYS.items()}
            archives = {name: self.path / f"{name}.npz" for name in ARCHIVES}
            self._archives = {name: file.read_bytes() for name, file in archives.items() if file.is_file()}
        except OSError as error:
            raise damaged(self.path, str(error)) from error
        if len(self.rows) != facts["num_gaussians"]:
            rows = f"num_gaussians: gaussians.ply holds {len(self.rows)}, found {facts['num_gaussians']}"
            raise damaged(self.path / FACTS, rows)
        for name, array in self._arrays.items():
            if len(array) != len(self.rows):
                rows = f"holds {len(array)} rows, expected {len(self.rows)} as in gaussians.ply"
                raise damaged(self.path / f"{name}.npy", rows)

    def _map_array(self, name: str, sides: int) -> np.ndarray:
        file = self.path / f"{name}.npy"
        try:
            array = map_npy(file)
        except FileNotFoundError as error:
            raise damaged(file, "is missing") from error
        except Exception as error:  # NumPy's, of many classes
            raise damaged(file, f"cannot be read ({brief(error)})") from error
        kind = "i" if name == "instance_ids" else "f"
        if array.ndim != sides or array.dtype.kind != kind or array.dtype.itemsize > 4:
            raise damaged(file, f"holds {array.dtype} of shape {list(array.shape)}")
        return array

    def read(self, name: str) -> Any:
        """The field `name` of a `Map`, in memory. Checksums are verified before whole files are read.
        Arrays are copies, float32 or int32 and writable. InputError naming the file when it is damaged."""
        if name in ("info", "instances"):
            return getattr(self, name)
        if name == "views":
            with refusing(f"{self.path / FACTS}: its views cannot be understood ({{why}}); the map is damaged"):
                return [view_from_json(entry) for entry in self.facts.get("views", [])]
        if name in ARCHIVES:
            file, raw = self.path / f"{name}.npz", self._archives.get(name)
            arrays = {} if raw is None else read_npz(raw, file, "the map is damaged, build it again")
            with _damage_in(file):
                check_archive(name, arrays, self.instances, len(self.rows))
            return arrays
        self._check_contents()
        if name == "instance_ids":
            with _damage_in(self.path / f"{name}.npy"):
                check_ids(self._arrays[name], [e["id"] for e in self.instances if not is_removed(e)])
        file = self.path / (f"{name}.npy" if name in _ARRAYS else "gaussians.ply")
        try:
            values = np.array(self._arrays[name]) if name in _ARRAYS else _OF_PLY[name](self.rows)
        except (KeyError, ValueError) as error:
            raise damaged(file, f"is no 3DGS cloud ({error})") from error
        if np.isnan(values).any() or (name == "means" and np.isinf(values).any()):
            raise damaged(file, f"{name}: holds NaN or infinity")
        return values

    def _check_contents(self) -> None:
        """Compares the SHA-256 of every file with the one recorded, once; InputError names the first that differs.
        Skipped when the folder has been replaced by another map."""
        with self._lock:
            if self._checked or _folder_identity(self.path) != self._identity:
                return
            for name in self.info.get("files", {}):
                if name != EDITABLE:
                    check_file(self.path, self.info, name)
            self._checked = True


def _columns(names: list[str]) -> Callable[[np.ndarray], np.ndarray]:
    return lambda rows: np.stack([rows[name] for name in names], axis=1).astype(np.float32)


def _harmonics(rows: np.ndarray) -> np.ndarray:
    """[N, K, 3] from f_dc_* and f_rest_*, which are channel-major (all R, then G, then B)."""
    constant = _columns([f"f_dc_{i}" for i in range(3)])(rows)[:, None, :]
    width = sum(name.startswith("f_rest_") for name in rows.dtype.names or ())
    if width == 0:
        return constant
    rest = _columns([f"f_rest_{i}" for i in range(width)])(rows).reshape(len(constant), 3, width // 3)
    return np.ascontiguousarray(np.concatenate([constant, rest.transpose(0, 2, 1)], axis=1))


_OF_PLY: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "means": _columns(["x", "y", "z"]),
    "quats": _columns([f"rot_{i}" for i in range(4)]),
    "log_scales": _columns([f"scale_{i}" for i in range(3)]),
    "opacity_logits": lambda rows: rows["opacity"].astype(np.float32),  # copied: a single one is not aligned
    "sh": _harmonics,
}
"""Functions that compute fields of a map from the rows of gaussians.ply."""


def read_info(path: Path) -> dict[str, Any]:
    """The content of map.json; InputError when `path` is not a map or has an unsupported format version."""
    return _read_facts(current(Path(path)))[0]


def map_signature(path: Path) -> Signature:
    """Inodes, times and sizes that change when the map or its labels, or the store, at `path` change. InputError when
    none exists."""
    folder = current(path)
    names = (STORE,) if (folder / STORE).is_file() else (FACTS, EDITABLE)
    try:
        stats = [file.stat() for file in (folder, *(folder / name for name in names))]
    except OSError as error:
        todo = "give a directory made by `perception map`, or put it back"
        raise InputError(f"{path}: no map lies there, or it is gone ({error.strerror}); {todo}") from error
    return tuple((stat.st_ino, stat.st_mtime_ns if n else 0, stat.st_size if n else 0) for n, stat in enumerate(stats))


def _folder_identity(path: Path) -> tuple[int, int]:
    try:
        stat = path.stat()
    except OSError:
        return (0, 0)
    return (stat.st_dev, stat.st_ino)


def _read_facts(path: Path) -> tuple[dict[str, Any], bytes]:
    file = path / FACTS
    if (path / STORE).is_file():
        raise InputError(f"{path}: is a store of many maps, and this needs one map; give one of them")
    if path.is_file():
        raise InputError(f"{path}: is a file, expected the folder of a map (NAME.gsmap); give that, unpacked")
    if not file.is_file():
        raise InputError(f"{path}: is no map (no map.json inside); give a directory made by `perception map`")
    try:
        raw = file.read_bytes()
        info = parsed(raw)
        version = info["format_version"]
    except OSError as error:
        raise InputError(f"{file}: cannot be read ({brief(error)}); allow access to it") from error
    except (ValueError, KeyError, TypeError) as error:
        raise damaged(file, f"cannot be read as a map's facts ({brief(error)})") from error
    if isinstance(version, bool) or not isinstance(version, int):
        raise damaged(file, f"format_version is {brief(version)}, expected {FORMAT_VERSION}")
    if version != FORMAT_VERSION:
        advice = (
            f"it was made by an older perception; build the map again from {brief(info.get('source', 'its photos'))}"
            if version < FORMAT_VERSION
            else "it was made by a newer perception; update this one"
        )
        raise InputError(f"{file}: format_version is {brief(version)}, this program reads {FORMAT_VERSION}: {advice}")
    with _damage_in(file):
        check_facts(info)
    return info, raw


def _read_instances(file: Path, facts: dict[str, Any]) -> tuple[list[dict[str, Any]], bytes]:
    with _damage_in(file):
        raw = file.read_bytes()
    try:
        value = parsed(raw.removeprefix(BOM_UTF8))  # of an editor
        check_instances(value, facts)
    except ValueError as error:
        if facts.get("files", {}).get(EDITABLE, {}).get("sha256") == hashlib.sha256(raw).hexdigest():
            raise damaged(file, str(error)) from error
        raise InputError(f"{file}: {error}; it was edited or is damaged: mend it, or copy it anew") from error
    return value["instances"], raw


@contextmanager
def _damage_in(file: Path) -> Iterator[None]:
    """Turns a ValueError of `map_model` into the InputError for `file`."""
    try:
        yield
    except (OSError, ValueError) as error:
        raise damaged(file, str(error) if isinstance(error, ValueError) else brief(error)) from error
