"""The map on disk (`name.gsmap/`): a standard 3DGS PLY, JSON facts, and arrays beside them.

map.json        format_version, frame, metric, counts, config, seed, versions, times, quality, run record
gaussians.ply   the standard 3DGS properties, readable by other viewers
instances.json  per instance: id, label, score, num_gaussians, centroid, obb, aabb, views
features.npy    [N, D] float32      instance_ids.npy  [N] int32 (−1 = none)   membership.npy [N] float32
language.npz    what the encoder knows of each instance, with its identity (absent without an encoder)
cameras.npz     the views: names, K, sizes, camera_from_world, which were held out
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from perception.errors import InputError
from perception.io.atomic import atomic_directory
from perception.io.ply import read_ply, write_ply

FORMAT_VERSION = 1


@dataclass
class GaussianMap:
    """A finished map. Arrays are float32; quats wxyz; logs and logits as stored in the PLY.

    means [N, 3], quats [N, 4], log_scales [N, 3], opacity_logits [N], sh [N, K, 3], features [N, D],
    instance_ids [N] int32, membership [N]; instances: the list of instances.json; info: map.json;
    cameras and language: named arrays (may be empty).
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
    cameras: dict[str, np.ndarray] = field(default_factory=dict)
    language: dict[str, np.ndarray] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.means)

    @property
    def scales(self) -> np.ndarray:
        return np.exp(self.log_scales)

    @property
    def opacities(self) -> np.ndarray:
        return 1 / (1 + np.exp(-self.opacity_logits))


def write_map(path: Path, gmap: GaussianMap) -> None:
    """Writes the whole map aside and swaps it in: a reader sees the old map or the new one, never half of one."""
    info = {**gmap.info, "format_version": FORMAT_VERSION, "num_gaussians": len(gmap)}
    info["num_instances"] = len(gmap.instances)
    info["sh_degree"] = math.isqrt(gmap.sh.shape[1]) - 1
    with atomic_directory(path) as folder:
        write_gaussian_ply(folder / "gaussians.ply", gmap)
        np.save(folder / "features.npy", gmap.features.astype(np.float32))
        np.save(folder / "instance_ids.npy", gmap.instance_ids.astype(np.int32))
        np.save(folder / "membership.npy", gmap.membership.astype(np.float32))
        np.savez(folder / "cameras.npz", **gmap.cameras)  # type: ignore[arg-type]
        if gmap.language:
            np.savez_compressed(folder / "language.npz", **gmap.language)  # type: ignore[arg-type]
        _dump(folder / "instances.json", {"instances": gmap.instances})
        _dump(folder / "map.json", info)


def read_map(path: Path) -> GaussianMap:
    """Opens a map. Raises InputError naming the file when it is no map, of another version, or damaged."""
    info = read_info(path)
    try:
        rows = read_ply(path / "gaussians.ply")["vertex"]
        count = len(rows["x"])
        gmap = GaussianMap(
            means=_columns(rows, ["x", "y", "z"]),
            quats=_columns(rows, [f"rot_{i}" for i in range(4)]),
            log_scales=_columns(rows, [f"scale_{i}" for i in range(3)]),
            opacity_logits=np.ascontiguousarray(rows["opacity"], np.float32),
            sh=_read_sh(rows),
            features=np.load(path / "features.npy"),
            instance_ids=np.load(path / "instance_ids.npy"),
            membership=np.load(path / "membership.npy"),
            instances=json.loads((path / "instances.json").read_text(encoding="utf-8"))["instances"],
            info=info,
            cameras=_load_npz(path / "cameras.npz"),
            language=_load_npz(path / "language.npz"),
        )
    except (OSError, KeyError, ValueError, EOFError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: the map is damaged ({error}); build it again with `perception map`") from error
    for name in ("features", "instance_ids", "membership"):
        found = len(getattr(gmap, name))
        if found != count:
            raise InputError(
                f"{path / name}.npy: holds {found} rows, expected {count} as in gaussians.ply; rebuild the map"
            )
    return gmap


def read_info(path: Path) -> dict[str, Any]:
    """map.json alone; raises InputError when `path` is no map or of a version this program does not read."""
    file = path / "map.json"
    if not file.is_file():
        raise InputError(f"{path}: is no map (no map.json inside); give a directory made by `perception map`")
    try:
        info = json.loads(file.read_text(encoding="utf-8"))
        version = info["format_version"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{file}: cannot be read as a map's facts ({error})") from error
    if version != FORMAT_VERSION:
        raise InputError(f"{file}: format_version is {version}, this program reads {FORMAT_VERSION}; rebuild the map")
    return info


def write_gaussian_ply(path: Path, gmap: GaussianMap) -> None:
    """The standard 3DGS properties in their usual order; f_rest is channel-major (all R, then G, then B)."""
    count = len(gmap)
    rest = gmap.sh[:, 1:].transpose(0, 2, 1).reshape(count, -1)
    table: dict[str, np.ndarray] = {}
    for i, name in enumerate("xyz"):
        table[name] = gmap.means[:, i]
    for name in ("nx", "ny", "nz"):
        table[name] = np.zeros(count, np.float32)
    for i in range(3):
        table[f"f_dc_{i}"] = gmap.sh[:, 0, i]
    for i in range(rest.shape[1]):
        table[f"f_rest_{i}"] = rest[:, i]
    table["opacity"] = gmap.opacity_logits
    for i in range(3):
        table[f"scale_{i}"] = gmap.log_scales[:, i]
    for i in range(4):
        table[f"rot_{i}"] = gmap.quats[:, i]
    write_ply(path, {"vertex": {name: np.ascontiguousarray(column, np.float32) for name, column in table.items()}})


def _read_sh(rows: dict[str, np.ndarray]) -> np.ndarray:
    constant = _columns(rows, [f"f_dc_{i}" for i in range(3)])[:, None, :]
    width = sum(name.startswith("f_rest_") for name in rows)
    if width == 0:
        return constant
    rest = _columns(rows, [f"f_rest_{i}" for i in range(width)]).reshape(len(constant), 3, width // 3)
    return np.ascontiguousarray(np.concatenate([constant, rest.transpose(0, 2, 1)], axis=1))


def _columns(rows: dict[str, np.ndarray], names: list[str]) -> np.ndarray:
    return np.stack([rows[name] for name in names], axis=1).astype(np.float32)


def _load_npz(path: Path) -> dict[str, np.ndarray]:
    if not path.is_file():
        return {}
    with np.load(path, allow_pickle=False) as archive:
        return {name: archive[name] for name in archive.files}


def _dump(path: Path, value: Any) -> None:
    path.write_text(json.dumps(value, indent=1, allow_nan=False, default=_plain) + "\n", encoding="utf-8")


def _plain(value: Any) -> Any:
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"cannot write {type(value).__name__} as JSON")
