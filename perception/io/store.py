"""The map on disk (`name.gsmap/`): a standard 3DGS PLY, JSON facts, and arrays beside them.

map.json        format_version, frame, metric, counts, config, seed, versions, times, quality, run record
gaussians.ply   the standard 3DGS properties, readable by other viewers
instances.json  per instance: id, label, score, num_gaussians, centroid, obb, aabb, views, and maybe parts: a list of
                entries with the same keys and `parent`, the id of the whole. Ids of parts follow those of the wholes.
features.npy    [N, D] float32      instance_ids.npy  [N] int32 (−1 = none)   membership.npy [N] float32
language.npz    what the encoder knows of each instance, with its identity (absent without an encoder)
parts.npz       ids [N] int32: the part each Gaussian belongs to (−1 = none; absent without parts). With an encoder also
                language_*: as language.npz, one row a part in ascending id
cameras.npz     the views: names, K, sizes, camera_from_world, which were held out
index.npz       the points of each instance side by side (see instance_index), for questions
map.json also lists size and SHA-256 of the other files (`files`) and its own (`sha256`); see checksums.
"""

from __future__ import annotations

import contextlib
import json
import math
import shutil
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from perception.errors import InputError
from perception.io.atomic import atomic_directory, atomic_file
from perception.io.checksums import EDITABLE, FACTS, REPORT, facts_of, file_facts, seal, verify
from perception.io.instance_index import InstanceIndex, build_index
from perception.io.map_files import FORMAT_VERSION, MapFiles, map_signature, read_info
from perception.io.map_lock import writing
from perception.io.ply import write_ply

__all__ = [
    "FORMAT_VERSION",
    "REPORT",
    "GaussianMap",
    "gaussian_map",
    "map_signature",
    "read_info",
    "read_map",
    "set_labels",
    "verify_map",
    "write_gaussian_ply",
    "write_map",
]


@dataclass
class GaussianMap:
    """A finished map. Arrays are float32; quats wxyz; logs and logits as stored in the PLY.

    means [N, 3], quats [N, 4], log_scales [N, 3], opacity_logits [N], sh [N, K, 3], features [N, D],
    instance_ids [N] int32, membership [N]; instances: the list of instances.json; info: map.json;
    cameras, language and parts: named arrays (may be empty).
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
    parts: dict[str, np.ndarray] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.means)

    @property
    def scales(self) -> np.ndarray:
        return np.exp(self.log_scales)

    @property
    def opacities(self) -> np.ndarray:
        return 1 / (1 + np.exp(-self.opacity_logits))

    def instance_index(self) -> InstanceIndex:
        """The points of each instance side by side."""
        return build_index(self.means, self.instance_ids)


def write_map(path: Path, gmap: GaussianMap, keep_report: bool = False) -> None:
    """Writes the whole map aside and swaps it in: a reader sees the old map or the new one, never half of one.

    keep_report: the report of the map that is replaced stays, for corrections by hand.

    InputError when another writer is at this map, or the place cannot be written to.
    """
    info = {**gmap.info, "format_version": FORMAT_VERSION, "num_gaussians": len(gmap)}
    info["num_instances"] = len(gmap.instances)
    info["sh_degree"] = math.isqrt(gmap.sh.shape[1]) - 1
    with writing(path), atomic_directory(path) as folder:
        write_gaussian_ply(folder / "gaussians.ply", gmap)
        np.save(folder / "features.npy", gmap.features.astype(np.float32))
        np.save(folder / "instance_ids.npy", gmap.instance_ids.astype(np.int32))
        np.save(folder / "membership.npy", gmap.membership.astype(np.float32))
        np.savez(folder / "cameras.npz", **gmap.cameras)  # type: ignore[arg-type]
        np.savez(folder / "index.npz", **gmap.instance_index().to_arrays())  # type: ignore[arg-type]
        if gmap.language:
            np.savez_compressed(folder / "language.npz", **gmap.language)  # type: ignore[arg-type]
        if gmap.parts:
            np.savez_compressed(folder / "parts.npz", **gmap.parts)  # type: ignore[arg-type]
        _dump(folder / EDITABLE, {"instances": gmap.instances})
        if keep_report and (path / REPORT).is_file():
            shutil.copy2(path / REPORT, folder / REPORT)
        _dump(folder / FACTS, _with_checksums(info, folder))


def read_map(path: Path) -> GaussianMap:
    """Reads all of a map, checksums compared. Raises InputError naming the file when it is no map, of another
    version, or damaged."""
    return gaussian_map(MapFiles(path))


def gaussian_map(files: MapFiles) -> GaussianMap:
    """All of an opened map in memory, checksums compared; InputError naming the file when one is damaged."""
    files.check_contents()
    rows, file = files.rows, files.path / "gaussians.ply"
    try:
        return GaussianMap(
            means=_columns(rows, ["x", "y", "z"]),
            quats=_columns(rows, [f"rot_{i}" for i in range(4)]),
            log_scales=_columns(rows, [f"scale_{i}" for i in range(3)]),
            opacity_logits=np.ascontiguousarray(rows["opacity"], np.float32),
            sh=_read_sh(rows),
            **{name: np.array(array) for name, array in files.arrays.items()},
            instances=files.instances,
            info=files.info,
            cameras=files.cameras,
            language=files.language,
            parts=files.parts,
        )
    except (KeyError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{file}: is no 3DGS cloud ({error}); the map is damaged, build it again") from error


def verify_map(path: Path) -> dict[str, str]:
    """Reads every byte: {file: "ok", "edited" or "no checksum"}; InputError naming the first damaged file."""
    files = MapFiles(path)
    states = verify(path, files.info)
    files.instance_index()
    return states


def set_labels(path: Path, labels: dict[int, str | None]) -> None:
    """Gives instances of the map on disk the user's names (None takes one away), or does nothing at all.

    InputError for an id the map does not have, and while another writer is at this map.
    """
    with writing(path):
        files = MapFiles(path)
        places = {entry["id"]: n for n, entry in enumerate(files.instances)}
        for instance_id, label in labels.items():
            if instance_id not in places:
                raise InputError(f"{path}: has no instance {instance_id}; it has {len(places)}")
            if label is not None and not (isinstance(label, str) and label.strip()):
                raise InputError(f"{path}: the label of instance {instance_id} is empty; give a name or none")
            files.instances[places[instance_id]]["label"] = label
        _write_instances(path, files)


def _write_instances(path: Path, files: MapFiles) -> None:
    """instances.json, and its checksum in map.json; those of other files stay, so that damage is not blessed."""
    with contextlib.ExitStack() as both:  # ends in reverse: both are written whole before the first takes its place
        facts = both.enter_context(atomic_file(path / FACTS)) if "files" in files.info else None
        aside = both.enter_context(atomic_file(path / EDITABLE))
        _dump(aside, {"instances": files.instances})
        if facts is not None:
            _dump(facts, seal({**files.info, "files": {**files.info["files"], EDITABLE: facts_of(aside)}}))


def _with_checksums(info: dict[str, Any], folder: Path) -> dict[str, Any]:
    facts = json.loads(json.dumps(info, allow_nan=False, default=_plain))
    return seal({**facts, "files": file_facts(folder)})


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


def _read_sh(rows: np.ndarray) -> np.ndarray:
    constant = _columns(rows, [f"f_dc_{i}" for i in range(3)])[:, None, :]
    width = sum(name.startswith("f_rest_") for name in rows.dtype.names or ())
    if width == 0:
        return constant
    rest = _columns(rows, [f"f_rest_{i}" for i in range(width)]).reshape(len(constant), 3, width // 3)
    return np.ascontiguousarray(np.concatenate([constant, rest.transpose(0, 2, 1)], axis=1))


def _columns(rows: np.ndarray, names: list[str]) -> np.ndarray:
    return np.stack([rows[name] for name in names], axis=1).astype(np.float32)


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
