"""PCD, the Point Cloud Library's format (version 0.7): ASCII, binary and binary_compressed (LZF) in, binary out.

pypcd4 1.5 is not used: it reads a file truncated at the end of a row as a smaller cloud, allocates the size given in a
damaged header without a check, and needs a compiled LZF package.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from perception.errors import InputError
from perception.io.atomic import replacing
from perception.types import PointCloud

_SIZES = {"F": ("4", "8"), "I": ("1", "2", "4", "8"), "U": ("1", "2", "4", "8")}
_MOST = 1 << 40
_RGB = ("rgb", "rgba")


def read_pcd(path: Path) -> PointCloud:
    """x y z, packed rgb(a), normals, and integer fields of count 1 as labels."""
    data = path.read_bytes()
    header, at = _read_header(data, path)
    dtype, points = _row_type(header, path)
    kind = header["DATA"][0].lower() if header["DATA"] else ""
    if kind == "ascii":
        rows = _from_ascii(data[at:], dtype, points, path)
    elif kind == "binary":
        rows = _from_binary(data[at:], dtype, points, path)
    elif kind == "binary_compressed":
        rows = _from_compressed(data[at:], dtype, points, path)
    else:
        raise InputError(f"{path}: PCD DATA is '{kind}'; expected ascii, binary or binary_compressed")
    return _to_cloud(rows, path)


def _read_header(data: bytes, path: Path) -> tuple[dict[str, list[str]], int]:
    header: dict[str, list[str]] = {}
    at = 0
    while "DATA" not in header:
        end = data.find(b"\n", at)
        if end < 0 or at > 1 << 16:
            raise InputError(f"{path}: PCD header has no DATA line")
        words = data[at:end].decode("ascii", "replace").split()
        at = end + 1
        if words and not words[0].startswith("#"):
            header[words[0].upper()] = words[1:]
    return header, at


def _row_type(header: dict[str, list[str]], path: Path) -> tuple[np.dtype, int]:
    try:
        names, sizes, types = header["FIELDS"], header["SIZE"], header["TYPE"]
        counts = [int(c) for c in header.get("COUNT", ["1"] * len(names))]
        points = int(header["POINTS"][0] if "POINTS" in header else header["WIDTH"][0])
        if not (len(names) == len(sizes) == len(types) == len(counts)) or not 0 <= points <= _MOST or min(counts) < 1:
            raise ValueError("FIELDS, SIZE, TYPE and COUNT disagree")
        fields: list[tuple] = []
        for i, (name, size, type_, count) in enumerate(zip(names, sizes, types, counts, strict=True)):
            if size not in _SIZES[type_.upper()]:
                raise ValueError(f"field '{name}' has SIZE {size} and TYPE {type_}")
            unique = name if name not in names[:i] and name != "_" else f"{name}#{i}"
            fields.append((unique, f"<{type_.lower()}{size}", *([(count,)] if count > 1 else [])))
        return np.dtype(fields), points
    except (KeyError, IndexError, ValueError) as error:
        raise InputError(f"{path}: PCD header cannot be understood ({error})") from error


def _from_ascii(data: bytes, dtype: np.dtype, points: int, path: Path) -> np.ndarray:
    try:
        numbers = np.fromstring(data, dtype=np.float64, sep=" ")
        widths = [int(np.prod(dtype[name].shape)) for name in dtype.names or ()]
        table = numbers.reshape(points, sum(widths))
    except ValueError as error:
        raise InputError(f"{path}: PCD text does not hold {points} rows of numbers ({error})") from error
    rows, column = np.empty(points, dtype), 0
    with np.errstate(invalid="ignore"):
        for name, width in zip(dtype.names or (), widths, strict=True):
            block = table[:, column : column + width]
            rows[name] = block.reshape(rows[name].shape)
            column += width
    return rows


def _from_binary(data: bytes, dtype: np.dtype, points: int, path: Path) -> np.ndarray:
    if len(data) < points * dtype.itemsize:
        raise InputError(f"{path}: is cut short: {len(data) // dtype.itemsize} of {points} points are there")
    return np.frombuffer(data, dtype, points)


def _from_compressed(data: bytes, dtype: np.dtype, points: int, path: Path) -> np.ndarray:
    """Compressed PCD stores the fields one after the other (structure of arrays), LZF over all of them."""
    if len(data) < 8:
        raise InputError(f"{path}: is cut short within the compressed block")
    packed, full = (int(n) for n in np.frombuffer(data, "<u4", 2))
    if len(data) < 8 + packed or full != points * dtype.itemsize:
        raise InputError(f"{path}: compressed block of {packed} bytes for {full} does not fit {points} points")
    plain = lzf_decompress(data[8 : 8 + packed], full)
    if plain is None:
        raise InputError(f"{path}: compressed block is damaged")
    rows, at = np.empty(points, dtype), 0
    for name in dtype.names or ():
        size = dtype[name].itemsize * points
        rows[name] = np.frombuffer(plain[at : at + size], dtype[name].base).reshape(rows[name].shape)
        at += size
    return rows


def lzf_decompress(data: bytes, size: int) -> bytes | None:
    """LZF (Marc Lehmann): literal runs and back references of at most 8 KiB; None if `data` is damaged."""
    out = bytearray()
    at, end = 0, len(data)
    try:
        while at < end:
            control = data[at]
            at += 1
            if control < 32:
                out += data[at : at + control + 1]
                at += control + 1
                continue
            length = control >> 5
            if length == 7:
                length += data[at]
                at += 1
            start = len(out) - ((control & 31) << 8) - data[at] - 1
            at += 1
            length += 2
            if start < 0:
                return None
            piece = out[start : start + length]
            while len(piece) < length:  # the reference overlaps what it writes: the pattern repeats
                piece += piece[: length - len(piece)]
            out += piece
            if len(out) > size:
                return None
    except IndexError:
        return None
    return bytes(out) if len(out) == size else None


def _to_cloud(rows: np.ndarray, path: Path) -> PointCloud:
    names = rows.dtype.names or ()
    if not {"x", "y", "z"} <= set(names) or any(rows[axis].ndim > 1 for axis in "xyz"):
        raise InputError(f"{path}: PCD has the fields {', '.join(names)[:200]}; expected x, y and z, each of COUNT 1")
    kind = np.float64 if rows.dtype["x"] == np.float64 else np.float32
    cloud = PointCloud(np.stack([rows[axis] for axis in "xyz"], axis=1).astype(kind))
    normal = ("normal_x", "normal_y", "normal_z")
    if set(normal) <= set(names) and all(rows[name].ndim == 1 for name in normal):
        cloud.normals = np.stack([rows[name] for name in normal], axis=1).astype(np.float32)
    limits = np.iinfo(np.int32)
    for name in names:
        field = rows[name]
        if name in _RGB and field.dtype.itemsize == 4 and field.ndim == 1:
            packed = np.ascontiguousarray(field).view(np.uint32)
            cloud.colors = np.stack([packed >> 16, packed >> 8, packed], axis=1).astype(np.uint8)
        elif field.ndim == 1 and field.dtype.kind in "iu" and not name.startswith("_"):
            if field.size and (field.max() > limits.max or field.min() < limits.min):
                raise InputError(f"{path}: field '{name}' holds {field.max()}, which is not a 32-bit whole number")
            cloud.labels[name] = field.astype(np.int32)
    return cloud


def write_pcd(path: Path, cloud: PointCloud) -> None:
    """Binary PCD 0.7: x y z (float 4 or 8), rgb packed in a float as in PCL, normals, int32 labels."""
    size = 8 if cloud.points.dtype == np.float64 else 4
    columns = {axis: cloud.points[:, i].astype(f"<f{size}") for i, axis in enumerate("xyz")}
    if cloud.colors is not None:
        r, g, b = cloud.colors.astype(np.uint32).T
        columns["rgb"] = ((r << 16) | (g << 8) | b).astype("<u4").view("<f4")
    if cloud.normals is not None:
        columns |= {f"normal_{a}": cloud.normals[:, i].astype("<f4") for i, a in enumerate("xyz")}
    columns |= {name: values.astype("<i4") for name, values in cloud.labels.items()}
    rows = np.empty(len(cloud.points), [(name, values.dtype.str) for name, values in columns.items()])
    for name, values in columns.items():
        rows[name] = values
    header = (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\n"
        f"FIELDS {' '.join(columns)}\n"
        f"SIZE {' '.join(str(v.dtype.itemsize) for v in columns.values())}\n"
        f"TYPE {' '.join(v.dtype.kind.upper() for v in columns.values())}\n"
        f"COUNT {' '.join('1' for _ in columns)}\n"
        f"WIDTH {len(rows)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(rows)}\nDATA binary\n"
    )
    with replacing(path) as file:
        file.write(header.encode("ascii"))
        rows.tofile(file)
