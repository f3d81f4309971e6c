"""Reads and writes point clouds and meshes; the extension selects the format. Order and number of points are kept.

PCD is the Point Cloud Library's format, version 0.7. pypcd4 1.5 is not used: it reads a file truncated at the end of a
row as a smaller cloud, and allocates the size that a damaged header gives without a check.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from perception.errors import InputError
from perception.io.arrays import read_npz
from perception.io.atomic import atomic_file
from perception.io.ply import MOST_ROWS, Property, Table, packed, read_body, read_ply, write_ply
from perception.machine import require_memory
from perception.types import PointCloud

_COLORS = (("red", "green", "blue"), ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue"))
_NORMALS = (("nx", "ny", "nz"), ("normal_x", "normal_y", "normal_z"))
_NOT_LABELS = {"alpha", "diffuse_alpha", "a", "rgb", "rgba"}
_PCD_KINDS = ("f4", "f8", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8")
_PCD_COLUMNS = 1 << 12


def read_cloud(path: str | Path) -> PointCloud:
    """Read .ply (cloud or mesh), .pcd or .npz.
    points are float64 where the file stores doubles, else float32; integer columns besides the colours become `labels`;
    faces of more than three corners are split into fans. NaN and infinite points are kept in place."""
    path = Path(path)
    if path.suffix.lower() not in _FORMATS:
        raise InputError(f"{path}: unknown point cloud format '{path.suffix}'; expected {', '.join(_FORMATS)}")
    if not path.is_file():
        raise InputError(f"{path}: there is no such file; expected a point cloud")
    require_memory(4 * path.stat().st_size, str(path), "split the cloud, or use a machine with more memory")
    cloud = _FORMATS[path.suffix.lower()][0](path)
    if len(cloud.points) == 0:
        raise InputError(f"{path}: holds no points")
    bad = [] if cloud.faces is None else cloud.faces[(cloud.faces < 0) | (cloud.faces >= len(cloud.points))]
    if len(bad):
        raise InputError(f"{path}: a face names vertex {bad[0]}, but there are {len(cloud.points)} vertices")
    return cloud


def write_cloud(path: str | Path, cloud: PointCloud) -> None:
    """Write .ply (binary), .pcd (binary) or .npz: points and those attributes that the format supports."""
    path = Path(path)
    if path.suffix.lower() not in _FORMATS:
        raise InputError(f"{path}: cannot write the format '{path.suffix}'; expected {', '.join(_FORMATS)}")
    _FORMATS[path.suffix.lower()][1](path, cloud)


def to_int32(values: np.ndarray, where: str) -> np.ndarray:
    """Label column as int32. InputError naming `where` for values that are not integers or out of range."""
    if values.dtype == np.int32:
        return values
    limits = np.iinfo(np.int32)
    with np.errstate(invalid="ignore"):
        fits = (values >= limits.min) & (values <= limits.max)
        if values.dtype.kind == "f":
            fits &= values == np.floor(values)
    if not fits.all():
        first = int(np.argmin(fits))
        raise InputError(f"{where}: value {values[first]} at index {first} is not a 32-bit whole number")
    return values.astype(np.int32)


def to_uint8(colors: np.ndarray) -> np.ndarray:
    """Colours [P, 3] as uint8: floats in [0, 1] are scaled by 255, 16-bit values by 1/257, bytes are kept."""
    if colors.dtype == np.uint8:
        return colors
    if colors.dtype.kind == "f":
        clean = np.nan_to_num(colors)
        scale = 255.0 if clean.max(initial=0) <= 1.0 else 1.0
        return np.clip(np.round(clean * scale), 0, 255).astype(np.uint8)
    wide = colors.max(initial=0) > 255
    return np.clip(np.round(colors / 257.0) if wide else colors, 0, 255).astype(np.uint8)


def _cloud_of(columns: dict[str, np.ndarray], path: Path) -> PointCloud:
    """The cloud of named columns [P] of a file at `path`."""
    columns = {name: values for name, values in columns.items() if values.ndim == 1 and values.dtype != object}
    if not set("xyz") <= columns.keys():
        raise InputError(f"{path}: has the fields {', '.join(columns)[:200] or 'none'}; expected x, y and z")
    points = np.stack([columns[axis] for axis in "xyz"], axis=1)
    cloud = PointCloud(_floats(points))
    colors, normals = (next((n for n in kinds if set(n) <= columns.keys()), None) for kinds in (_COLORS, _NORMALS))
    packed = next((columns[name] for name in ("rgb", "rgba") if name in columns), None)
    if colors is not None:
        cloud.colors = to_uint8(np.stack([columns[name] for name in colors], axis=1))
    elif packed is not None and packed.dtype == np.uint32:
        cloud.colors = np.stack([packed >> 16, packed >> 8, packed], axis=1).astype(np.uint8)
    if normals is not None:
        cloud.normals = np.stack([columns[name] for name in normals], axis=1).astype(np.float32)
    for name, values in columns.items():
        is_id = values.dtype.kind in "iu" or (values.dtype.kind == "f" and name.endswith(("_id", "label")))
        if is_id and name not in {*"xyz", *_NOT_LABELS, *(colors or ()), *(normals or ())}:
            # CloudCompare writes every label as a float named scalar_...
            cloud.labels[name.removeprefix("scalar_")] = to_int32(values, f"{path}: property '{name}'")
    return cloud


def _floats(points: np.ndarray) -> np.ndarray:
    return points if points.dtype == np.float64 else points.astype(np.float32, copy=False)


def _columns_of(cloud: PointCloud, normals: tuple[str, ...]) -> dict[str, np.ndarray]:
    columns = dict(zip("xyz", _floats(cloud.points).T, strict=True))
    if cloud.normals is not None:
        columns |= {name: cloud.normals[:, i].astype(np.float32) for i, name in enumerate(normals)}
    return columns


def _read_ply_cloud(path: Path) -> PointCloud:
    elements = read_ply(path)
    cloud, face = _cloud_of(elements.get("vertex", {}), path), elements.get("face", {})
    for name in ("vertex_indices", "vertex_index"):
        if name in face:
            cloud.faces = _triangles(face[name], path)
    return cloud


def _write_ply_cloud(path: Path, cloud: PointCloud) -> None:
    vertex = _columns_of(cloud, _NORMALS[0])
    if cloud.colors is not None:
        vertex |= {name: cloud.colors[:, i].astype(np.uint8) for i, name in enumerate(_COLORS[0])}
    elements = {"vertex": vertex | {name: values.astype(np.int32) for name, values in cloud.labels.items()}}
    if cloud.faces is not None:
        elements["face"] = {"vertex_indices": cloud.faces.astype(np.int32)}
    write_ply(path, elements)


def _triangles(faces: np.ndarray, path: Path) -> np.ndarray:
    if faces.dtype != object:
        if faces.ndim != 2:
            raise InputError(f"{path}: the corners of element 'face' are {faces.dtype}, expected a property list")
        if len(faces) == 0 or faces.shape[1] < 3:
            return np.empty((0, 3), np.int32)
        corners = [faces[:, [0, i, i + 1]] for i in range(1, faces.shape[1] - 1)]
        return np.stack(corners, axis=1).reshape(-1, 3).astype(np.int32)
    fans = [(f[0], f[i], f[i + 1]) for f in faces for i in range(1, len(f) - 1)]
    return np.array(fans, np.int32).reshape(-1, 3)


def _read_npz(path: Path) -> PointCloud:
    arrays = read_npz(path, path, "it is no NPZ file, or damaged")
    points = next((arrays.pop(n) for n in ("points", "xyz", "positions") if n in arrays), None)
    if points is None or points.ndim != 2 or points.shape[1] != 3 or points.dtype.kind not in "fiu":
        found = "none" if points is None else f"{points.dtype} {list(points.shape)}"
        raise InputError(f"{path}: expected an array 'points' [P, 3], found {found}")
    cloud = PointCloud(_floats(points))
    for name, values in arrays.items():
        if name == "colors" and values.shape == points.shape:
            cloud.colors = to_uint8(values)
        elif name == "normals" and values.shape == points.shape:
            cloud.normals = values.astype(np.float32, copy=False)
        elif name == "faces" and values.ndim == 2 and values.shape[1] == 3:
            cloud.faces = values.astype(np.int32, copy=False)
        elif values.shape == (len(points),) and values.dtype.kind in "iu":
            cloud.labels[name] = to_int32(values, f"{path}: array '{name}'")
    return cloud


def _write_npz(path: Path, cloud: PointCloud) -> None:
    parts = {"points": cloud.points, "colors": cloud.colors, "normals": cloud.normals, "faces": cloud.faces}
    arrays = {name: values for name, values in parts.items() if values is not None}
    everything: dict[str, Any] = arrays | cloud.labels
    with atomic_file(path) as new, new.open("wb") as file:
        np.savez(file, **everything)


def _read_pcd(path: Path) -> PointCloud:
    """The cloud of the fields of COUNT 1; rgb(a) is packed in 4 bytes. Fields named "_" are padding."""
    data, at, header = path.read_bytes(), 0, dict[str, list[str]]()
    while "DATA" not in header:
        end = data.find(b"\n", at)
        if end < 0 or at > 1 << 16:
            raise InputError(f"{path}: PCD header has no DATA line")
        name, *values = data[at:end].decode("ascii", "replace").split() or ["#"]
        at = end + 1
        header[name.upper()] = values
    kind = " ".join(header["DATA"]).lower()
    if kind not in ("ascii", "binary"):
        raise InputError(f"{path}: PCD DATA is '{kind}'; expected ascii or binary (pcl_convert_pcd_ascii_binary)")
    try:
        table = _pcd_table(header)
    except (KeyError, IndexError, ValueError) as error:
        raise InputError(f"{path}: PCD header cannot be understood ({error})") from error
    columns = read_body(path, data[at:], "<" if kind == "binary" else "", [table])[table.name]
    columns = {name: values for name, values in columns.items() if not name.startswith("_")}
    for name in {"rgb", "rgba"} & columns.keys():
        if columns[name].dtype.itemsize == 4:
            columns[name] = columns[name].view(np.uint32)
    return _cloud_of(columns, path)


def _pcd_table(header: dict[str, list[str]]) -> Table:
    """The columns of a PCD; "_" begins the names of those that are not read: padding, repeated names, vectors."""
    names, sizes, types = header["FIELDS"], header["SIZE"], header["TYPE"]
    counts = [int(count) for count in header.get("COUNT", ["1"] * len(names))]
    rows = int((header.get("POINTS") or header["WIDTH"])[0])
    if not 0 <= rows <= MOST_ROWS or min(counts) < 1 or sum(counts) > _PCD_COLUMNS:
        raise ValueError(f"{rows} points of {sum(counts)} numbers")
    columns: list[Property] = []
    for i, (name, size, letter, count) in enumerate(zip(names, sizes, types, counts, strict=True)):
        if (kind := f"{letter.lower()}{size}") not in _PCD_KINDS:
            raise ValueError(f"field '{name}' has SIZE {size} and TYPE {letter}")
        if count == 1 and name not in names[:i] and name != "_":
            columns.append(Property(name, kind))
        else:
            columns += [Property(f"_{i}_{number}", kind) for number in range(count)]
    return Table("points", rows, columns)


def _write_pcd(path: Path, cloud: PointCloud) -> None:
    """Binary, with rgb packed in a float, as PCL does."""
    columns = _columns_of(cloud, _NORMALS[1])
    if cloud.colors is not None:
        r, g, b = cloud.colors.astype(np.uint32).T
        columns["rgb"] = ((r << 16) | (g << 8) | b).view(np.float32)
    columns |= {name: values.astype(np.int32) for name, values in cloud.labels.items()}
    rows = packed(columns)
    kinds = [rows.dtype[name] for name in columns]
    header = (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\n"
        f"FIELDS {' '.join(columns)}\n"
        f"SIZE {' '.join(str(kind.itemsize) for kind in kinds)}\n"
        f"TYPE {' '.join(kind.kind.upper() for kind in kinds)}\n"
        f"COUNT {' '.join('1' for _ in columns)}\n"
        f"WIDTH {len(rows)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(rows)}\nDATA binary\n"
    )
    with atomic_file(path) as new, new.open("wb") as file:
        file.write(header.encode("ascii"))
        rows.tofile(file)


_FORMATS: dict[str, Any] = {
    ".ply": (_read_ply_cloud, _write_ply_cloud),
    ".pcd": (_read_pcd, _write_pcd),
    ".npz": (_read_npz, _write_npz),
}
"""The functions that read and write a format."""
