"""PCD, the Point Cloud Library's format (version 0.7): ASCII and binary in, binary out, as named columns.

pypcd4 1.5 is not used: it reads a file truncated at the end of a row as a smaller cloud, and allocates the size that a
damaged header gives without a check.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from perception.errors import InputError
from perception.io.atomic import replacing

_SIZES = {"F": ("4", "8"), "I": ("1", "2", "4", "8"), "U": ("1", "2", "4", "8")}
_MOST = 1 << 40


def read_pcd(path: Path) -> dict[str, np.ndarray]:
    """The fields of COUNT 1, [P] each; packed rgb(a) as uint32. Fields named "_" are padding and left out."""
    data = path.read_bytes()
    header, at = _read_header(data, path)
    dtype, points = _row_type(header, path)
    kind = header["DATA"][0].lower() if header["DATA"] else ""
    if kind == "ascii":
        rows = _from_ascii(data[at:], dtype, points, path)
    elif kind == "binary":
        if len(data) - at < points * dtype.itemsize:
            raise InputError(f"{path}: is cut short: {(len(data) - at) // dtype.itemsize} of {points} points are there")
        rows = np.frombuffer(data, dtype, points, at)
    else:
        raise InputError(
            f"{path}: PCD DATA is '{kind}'; expected ascii or binary, as pcl_convert_pcd_ascii_binary makes"
        )
    columns = {name: rows[name] for name in dtype.names or () if rows[name].ndim == 1 and not name.startswith("_")}
    for name in ("rgb", "rgba"):
        if name in columns and columns[name].dtype.itemsize == 4:
            columns[name] = np.ascontiguousarray(columns[name]).view(np.uint32)
    return columns


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
            unique = name if name not in names[:i] and name != "_" else f"_{name}{i}"
            fields.append((unique, f"<{type_.lower()}{size}", *([(count,)] if count > 1 else [])))
        return np.dtype(fields), points
    except (KeyError, IndexError, ValueError) as error:
        raise InputError(f"{path}: PCD header cannot be understood ({error})") from error


def _from_ascii(data: bytes, dtype: np.dtype, points: int, path: Path) -> np.ndarray:
    names = dtype.names or ()
    widths = [int(np.prod(dtype[name].shape)) for name in names]
    try:
        table = np.fromstring(data, dtype=np.float64, sep=" ").reshape(points, sum(widths))
    except ValueError as error:
        raise InputError(f"{path}: PCD text does not hold {points} rows of numbers ({error})") from error
    rows = np.empty(points, dtype)
    with np.errstate(invalid="ignore"):
        for name, block in zip(names, np.split(table, np.cumsum(widths)[:-1], axis=1), strict=True):
            rows[name] = block.reshape(rows[name].shape)
    return rows


def write_pcd(path: Path, columns: dict[str, np.ndarray]) -> None:
    """Binary PCD 0.7 of named columns [P]."""
    rows = np.rec.fromarrays(list(columns.values()), names=list(columns))  # type: ignore[call-overload]
    kinds = [rows.dtype[name] for name in columns]
    header = (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\n"
        f"FIELDS {' '.join(columns)}\n"
        f"SIZE {' '.join(str(kind.itemsize) for kind in kinds)}\n"
        f"TYPE {' '.join(kind.kind.upper() for kind in kinds)}\n"
        f"COUNT {' '.join('1' for _ in columns)}\n"
        f"WIDTH {len(rows)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(rows)}\nDATA binary\n"
    )
    with replacing(path) as file:
        file.write(header.encode("ascii"))
        rows.tofile(file)
