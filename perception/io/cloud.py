"""Reads and writes point clouds and meshes; the extension selects the format. Order and number of points are kept.

PCD is the Point Cloud Library's format, version 0.7; pypcd4 1.5 takes a truncated file for a smaller cloud.
"""

from __future__ import annotations

import re
import struct
from codecs import BOM_UTF8
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from perception.errors import InputError
from perception.io.arrays import read_npz
from perception.io.atomic import atomic_file, write_file
from perception.io.documents import refusing
from perception.io.ply import MOST_ROWS, Element, Lists, Property, Table, packed, read_body, read_ply, write_ply
from perception.machine import require_memory
from perception.types import PointCloud

_COLORS = (("red", "green", "blue"), ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue"))
_NORMALS = (("nx", "ny", "nz"), ("normal_x", "normal_y", "normal_z"))
_WRITTEN = {*"xyz", *_COLORS[0], *_NORMALS[0], *_NORMALS[1], "rgb"}
"""Names of columns that hold the points, colours and normals of files that are written."""
_NPZ_OWN = {"points", "colors", "normals", "faces", "file", "allow_pickle"}
"""Names of the arrays of a cloud in an .npz, and what `np.savez` takes for options."""
_EXACT = 2**53  # whole numbers up to this are exact as doubles
_ASIDE = 0.95  # share of floating-point colours by whose largest their unit is seen: lights may exceed it
_SOME = 1 << 16  # points of which the unit of colours is seen, and faces that are split at a time
_PCD_KINDS = ("f4", "f8", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8")
_PCD_COLUMNS, _PCD_LINE = 1 << 12, 1 << 14
_LZF_DENSEST = 88  # most bytes that a byte of LZF's code can stand for: 264 by 3


def read_cloud(path: str | Path) -> PointCloud:
    """Read .ply (cloud or mesh), .pcd or .npz.
    points are float64 where float32 would lose digits; columns besides points, colours and normals become `labels`;
    faces of more than three corners are split into fans. NaN and infinite points are kept in place. Memory at its peak
    is at most three times the size of the file (`python tools speed.readers`)."""
    path, kind = Path(path), Path(path).suffix.lower()
    if kind not in _FORMATS:
        found = f"unknown point cloud format '{path.suffix}'; expected {', '.join(_FORMATS)}"
        raise InputError(f"{path}: {found}; convert it, for example with CloudCompare or `pdal translate`")
    if not path.is_file():
        raise InputError(f"{path}: there is no such file; expected a point cloud")
    require_memory(3 * path.stat().st_size, str(path), "split the cloud, or use a machine with more memory")
    cloud = _FORMATS[kind][0](path)
    if len(cloud.points) == 0:
        raise InputError(f"{path}: holds no points")
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
    """Colours [P, 3] as uint8: bytes are kept, 16-bit values scaled by 1 / 257. Floats are scaled by 255 where nearly
    all lie in [0, 1], some above as lights may; else they are values of bytes, or of 16 bits where many exceed 255."""
    if colors.dtype.itemsize == 1:
        return colors.view(np.uint8)  # writers also name the type char
    if colors.dtype.kind == "f":
        some = np.nan_to_num(colors[:: -(-len(colors) // _SOME) or 1], posinf=0, neginf=0)
        level = float(np.quantile(some, _ASIDE)) if some.size else 0.0
        whole = bool((some == np.round(some)).all()) and some.max(initial=0) > 1
        scale = 255.0 if level <= 2 and not whole else 1 / 257 if level > 255 else 1.0
        return np.clip(np.round(np.nan_to_num(colors) * scale), 0, 255).astype(np.uint8)
    wide = colors.max(initial=0) > 255
    return np.clip(np.round(colors / 257.0) if wide else colors, 0, 255).astype(np.uint8)


def storable(labels: dict[str, np.ndarray]) -> tuple[dict[str, np.ndarray], list[str]]:
    """(labels that PLY and PCD hold, each in one of PLY's types; names of the others). Whole numbers of 64 bits become
    int32 or double, where exact."""
    kept, others = dict[str, np.ndarray](), list[str]()
    for name, values in labels.items():
        kind: Any = values.dtype
        if kind.kind == "b":
            kind = np.uint8
        elif kind.kind == "f":
            kind = np.float64 if kind.itemsize > 4 else np.float32
        elif kind.itemsize == 8:
            most = max(-int(values.min(initial=0)), int(values.max(initial=0)))
            kind = np.int32 if most <= np.iinfo(np.int32).max else np.float64 if most <= _EXACT else None
        if kind is None or not re.fullmatch("[!-~]+", name) or name in _WRITTEN:
            others.append(name)
        else:
            kept[name] = values.astype(kind)
    return kept, others


def left_out(path: Path, cloud: PointCloud) -> list[str]:
    """Names of the columns, and "faces", that the format of `path` does not hold."""
    if path.suffix.lower() == ".npz":
        return [name for name in cloud.labels if name in _NPZ_OWN]
    flat = path.suffix.lower() == ".pcd" and cloud.faces is not None
    return storable(cloud.labels)[1] + (["faces"] if flat else [])


def _cloud_of(element: Element, path: Path) -> PointCloud:
    """The cloud of the named columns [P] of a file at `path`; lists are left out."""
    columns = {name: values for name, values in element.items() if isinstance(values, np.ndarray) and values.ndim == 1}
    for names in (("x", "y", "z"), *_COLORS, *_NORMALS):  # in capitals
        if set(names) <= {name.lower() for name in columns} and not set(names) & columns.keys():
            columns = {name.lower() if name.lower() in names else name: values for name, values in columns.items()}
    if not set("xyz") <= columns.keys():
        raise InputError(f"{path}: has the fields {', '.join(columns)[:200] or 'none'}; expected x, y and z")
    cloud = PointCloud(_floats(np.stack([columns[axis] for axis in "xyz"], axis=1)))
    colors, normals = (next((n for n in kinds if set(n) <= columns.keys()), None) for kinds in (_COLORS, _NORMALS))
    together = next((n for n in ("rgb", "rgba") if n in columns and columns[n].dtype.itemsize == 4), None)
    used = {*"xyz", *(colors or (together,)), *(normals or ())}
    if colors is not None:
        cloud.colors = to_uint8(np.stack([columns[name] for name in colors], axis=1))
    elif together is not None:
        bgra = _packed_colors(columns[together]).view(np.uint8).reshape(-1, 4)  # of 0xAARRGGBB
        cloud.colors = np.ascontiguousarray(bgra[:, 2::-1])
    if normals is not None:
        cloud.normals = np.stack([columns[name] for name in normals], axis=1).astype(np.float32, copy=False)
    for name in (name for name in columns if name not in used):
        short = name.removeprefix("scalar_")  # which CloudCompare puts before every name
        free = short not in {*columns, *_WRITTEN}
        cloud.labels[short if free else name] = np.ascontiguousarray(columns[name])
    return cloud


def _packed_colors(values: np.ndarray) -> np.ndarray:
    """0xAARRGGBB [P] as numbers of 4 bytes. Floats hold their bits, and are below 1e-37 or beyond 1e37; whole numbers
    between are the number itself, as texts of integers with TYPE F give it."""
    whole = (values == np.floor(values)) & (values >= 0) & (values < 1 << 24)
    if values.dtype.kind == "f" and whole.all():
        values = values.astype(np.uint32)
    return np.ascontiguousarray(values)


def _floats(points: np.ndarray) -> np.ndarray:
    wide = np.result_type(points.dtype, np.float32).itemsize > 4
    return points.astype(np.float64 if wide else np.float32, copy=False)


def _columns_of(cloud: PointCloud, normals: tuple[str, ...]) -> dict[str, np.ndarray]:
    columns = dict(zip("xyz", _floats(cloud.points).T, strict=True))
    if cloud.normals is not None:
        columns |= {name: cloud.normals[:, i].astype(np.float32) for i, name in enumerate(normals)}
    return columns


def _read_ply_cloud(path: Path) -> PointCloud:
    elements = read_ply(path)
    cloud, face = _cloud_of(elements.get("vertex", {}), path), elements.get("face", {})
    corners = face.get("vertex_index", face.get("vertex_indices"))
    if corners is not None:
        cloud.faces = _triangles(corners, len(cloud.points), path)
    return cloud


def _write_ply_cloud(path: Path, cloud: PointCloud) -> None:
    vertex = _columns_of(cloud, _NORMALS[0])
    if cloud.colors is not None:
        vertex |= {name: cloud.colors[:, i].astype(np.uint8) for i, name in enumerate(_COLORS[0])}
    elements = {"vertex": vertex | storable(cloud.labels)[0]}
    if cloud.faces is not None:
        elements["face"] = {"vertex_indices": cloud.faces.astype(np.int32)}
    write_ply(path, elements)


def _triangles(faces: np.ndarray | Lists, vertices: int, path: Path) -> np.ndarray:
    """Triangles [F, 3] int32 of faces with any number of corners, each split into a fan, in order."""
    values = faces.values if isinstance(faces, Lists) else faces
    low, high = (values.min(), values.max()) if values.size else (0, -1)
    if not (low >= 0 and high < vertices):  # NaN, too
        raise InputError(f"{path}: a face names vertex {high if low >= 0 else low}, but there are {vertices} vertices")
    if isinstance(faces, Lists):
        return _fans(faces)
    if faces.ndim != 2:
        raise InputError(f"{path}: the corners of element 'face' are {faces.dtype}, expected a property list")
    found = np.empty((len(faces), max(faces.shape[1] - 2, 0), 3), np.int32)
    for i in range(found.shape[1]):
        found[:, i, 0], found[:, i, 1], found[:, i, 2] = faces[:, 0], faces[:, i + 1], faces[:, i + 2]
    return found.reshape(-1, 3)


def _fans(faces: Lists) -> np.ndarray:
    """`_triangles` of faces of different numbers of corners."""
    total = int(np.maximum(faces.counts, 2).sum(dtype=np.int64)) - 2 * len(faces)
    found, at, corner = np.empty((total, 3), np.int32), 0, 0
    for begin in range(0, len(faces), _SOME):
        counts = faces.counts[begin : begin + _SOME].astype(np.int64)
        n = np.maximum(counts - 2, 0)
        first = np.repeat(corner + np.cumsum(counts) - counts, n)
        step = np.arange(len(first)) - np.repeat(np.cumsum(n) - n, n) + 1
        part = found[at : at + len(first)]
        part[:, 0], part[:, 1], part[:, 2] = (faces.values[i] for i in (first, first + step, first + step + 1))
        at, corner = at + len(first), corner + int(counts.sum())
    return found


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
            cloud.faces = _triangles(values, len(points), path)
        elif values.shape == (len(points),) and values.dtype.kind in "iufb":
            cloud.labels[name] = values.astype(values.dtype.newbyteorder("="), copy=False)
    return cloud


def _write_npz(path: Path, cloud: PointCloud) -> None:
    parts = {"points": cloud.points, "colors": cloud.colors, "normals": cloud.normals, "faces": cloud.faces}
    arrays = {name: values for name, values in parts.items() if values is not None}
    everything: dict[str, Any] = arrays | {n: v for n, v in cloud.labels.items() if n not in _NPZ_OWN}
    write_file(path, lambda file: np.savez(file, **everything))


def _read_pcd(path: Path) -> PointCloud:
    """The cloud of the fields of COUNT 1; rgb(a) is packed in 4 bytes."""
    header = dict[str, list[str]]()
    with path.open("rb") as file:
        while "DATA" not in header:
            line = file.readline(_PCD_LINE)
            if not line or file.tell() > 1 << 16:
                raise InputError(f"{path}: PCD header has no DATA line")
            name, *values = line.removeprefix(BOM_UTF8).decode("ascii", "replace").split() or ["#"]
            header[name.upper()] = values
        kind, left = " ".join(header["DATA"]).lower(), path.stat().st_size - file.tell()
        if kind not in ("ascii", "binary", "binary_compressed"):
            raise InputError(f"{path}: PCD DATA is '{kind}'; expected ascii, binary or binary_compressed")
        with refusing(f"{path}: PCD cannot be understood ({{why}})"):
            table = _pcd_table(header, left if kind == "binary" else None)
            if kind == "binary_compressed":  # one column after another
                data, columns, at = _unpacked(file, path), Element(), 0
                for p in table.properties:
                    columns[p.name] = np.frombuffer(data, f"<{p.kind}", table.rows, at)
                    at += table.rows * int(p.kind[1:])
        if kind != "binary_compressed":
            columns = read_body(path, file, "<" if kind == "binary" else "", [table])[table.name]
    return _cloud_of({name: values for name, values in columns.items() if not name.startswith("_")}, path)


def _pcd_table(header: dict[str, list[str]], held: int | None) -> Table:
    """The columns of a PCD; "_" begins the names of those that are not read: padding, repeated names, vectors.
    held: bytes of the rows, which decide where two numbers of points are given."""
    names, sizes, types = header["FIELDS"], header["SIZE"], header["TYPE"]
    counts = [int(count) for count in header.get("COUNT", ["1"] * len(names))]
    if min(counts) < 0 or sum(counts) > _PCD_COLUMNS:
        raise ValueError(f"points of {sum(counts)} numbers")
    columns: list[Property] = []
    for i, (name, size, letter, count) in enumerate(zip(names, sizes, types, counts, strict=True)):
        if (kind := f"{letter.lower()}{size}") not in _PCD_KINDS:
            raise ValueError(f"field '{name}' has SIZE {size} and TYPE {letter}")
        if count == 1 and name not in names[:i] and name != "_":
            columns.append(Property(name, kind))
        else:
            columns += [Property(f"_{i}_{number}", kind) for number in range(count)]
    rows = {int(header["POINTS"][0])} if "POINTS" in header else set()
    if "WIDTH" in header:
        rows.add(int(header["WIDTH"][0]) * int(header.get("HEIGHT", ["1"])[0]))
    if len(rows) > 1 and held is not None:
        rows = {n for n in rows if n * sum(int(p.kind[1:]) for p in columns) == held} or rows
    if len(rows) != 1 or not 0 <= min(rows) <= MOST_ROWS:
        raise ValueError(f"POINTS and WIDTH × HEIGHT are {' and '.join(map(str, sorted(rows))) or 'not given'}")
    return Table("points", rows.pop(), columns)


def _unpacked(file: BinaryIO, path: Path) -> bytes:
    """The bytes of binary_compressed: two lengths, packed and unpacked, and LibLZF's code. A byte c < 32 begins c + 1
    bytes as they are; else they repeat (c >> 5) + 2 bytes (7: and the next byte's) from at most 8192 bytes before."""
    data = memoryview(file.read())
    packed, size = struct.unpack_from("<II", data)
    code, out, at = data[8 : 8 + packed], bytearray(), 0
    if len(code) < packed or size > _LZF_DENSEST * packed:
        raise ValueError(f"{len(code)} of {packed} packed bytes are there, for {size}")
    require_memory(2 * size, str(path), "use a machine with more memory")
    while at < packed:
        control, at = code[at], at + 1
        if control < 32:
            out += code[at : at + control + 1]
            at += control + 1
            continue
        length = (control >> 5) + 2
        if length == 9:
            length, at = length + code[at], at + 1
        before = ((control & 31) << 8) + code[at] + 1
        at += 1
        if before > len(out) or len(out) > size:
            raise ValueError("the packed bytes are damaged")
        piece = out[-before : length - before or None] if length < before else out[-before:]
        out += piece if length <= before else (piece * (length // before + 1))[:length]
    if len(out) != size:
        raise ValueError(f"{len(out)} bytes are unpacked, expected {size}")
    return bytes(out)


def _write_pcd(path: Path, cloud: PointCloud) -> None:
    """Binary, with rgb packed in a float, as PCL does."""
    columns = _columns_of(cloud, _NORMALS[1])
    if cloud.colors is not None:
        r, g, b = cloud.colors.astype(np.uint32).T
        columns["rgb"] = ((r << 16) | (g << 8) | b).view(np.float32)
    rows = packed(columns | storable(cloud.labels)[0])
    kinds = [rows.dtype[name] for name in rows.dtype.names or ()]
    header = (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\n"
        f"FIELDS {' '.join(rows.dtype.names or ())}\n"
        f"SIZE {' '.join(str(kind.itemsize) for kind in kinds)}\n"
        f"TYPE {' '.join(kind.kind.upper() for kind in kinds)}\n"
        f"COUNT {' '.join('1' for _ in kinds)}\n"
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
