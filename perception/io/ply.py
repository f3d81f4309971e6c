"""Reader and writer of PLY: elements of named properties, ASCII and both byte orders, uniform and ragged lists.

Format: Greg Turk's "The PLY Polygon File Format" (1994). Binary tables are read as structured arrays.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from perception.errors import InputError
from perception.io.atomic import replacing

Element = dict[str, np.ndarray]

_KINDS = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
_NAMES = {"i1": "char", "u1": "uchar", "i2": "short", "u2": "ushort", "i4": "int", "u4": "uint"}
_NAMES |= {"f4": "float", "f8": "double"}
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}
_MAX_HEADER = 1 << 20
_MOST_ROWS = 1 << 40


@dataclass(frozen=True)
class _Property:
    name: str
    kind: str  # "f4", "u1", ...
    count_kind: str | None = None  # the type of a list's length; None for a scalar


@dataclass
class _Table:
    name: str
    rows: int
    properties: list[_Property]

    @property
    def has_list(self) -> bool:
        return any(p.count_kind for p in self.properties)


def read_ply(path: str | Path) -> dict[str, Element]:
    """All elements of a PLY file: {element: {property: array}}, file order kept, native byte order.

    A scalar property is an array [rows]; a list property is [rows, k] when all its lists have the same length
    k and an object array of 1D arrays otherwise.
    """
    path = Path(path)
    try:
        with path.open("rb") as file:
            order, tables = _read_header(file, path)
            if order == "":
                return _read_ascii(file.read(), tables, path)
            return {table.name: _read_binary(file, table, order, path) for table in tables}
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}); expected a PLY file") from error


def map_ply(path: str | Path, element: str) -> np.ndarray:
    """The first element of a binary little-endian PLY as a structured array [rows], mapped into memory, read-only.

    For large tables. InputError when the first element has another name or lists, or when the file is truncated.
    """
    path = Path(path)
    with path.open("rb") as file:
        order, tables = _read_header(file, path)
        start, size = file.tell(), path.stat().st_size
        if order != "<" or not tables or tables[0].name != element or tables[0].has_list:
            raise InputError(f"{path}: expected a binary little-endian PLY that begins with plain element '{element}'")
        dtype = np.dtype([(p.name, order + p.kind) for p in tables[0].properties])
        found = (size - start) // max(dtype.itemsize, 1)
        if found < tables[0].rows:
            raise InputError(
                f"{path}: is cut short: element '{element}' has {found} whole rows, header says {tables[0].rows}"
            )
        if tables[0].rows == 0 or dtype.itemsize == 0:
            return np.empty(tables[0].rows, dtype)
        return np.memmap(file, dtype, "r", start, (tables[0].rows,))


def write_ply(path: str | Path, elements: Mapping[str, Mapping[str, np.ndarray]]) -> None:
    """Write elements of scalar properties [rows] and list properties [rows, k], in the order given.

    Binary little endian. The file appears complete or not at all.
    """
    with replacing(path) as file:
        file.write(_header(elements))
        for properties in elements.values():
            _packed(properties).tofile(file)


def ply_bytes(elements: Mapping[str, Mapping[str, np.ndarray]]) -> bytes:
    """The bytes of the file that `write_ply` writes, for example to send them over a network."""
    return _header(elements) + b"".join(_packed(p).tobytes() for p in elements.values())


def _read_header(file: BinaryIO, path: Path) -> tuple[str, list[_Table]]:
    if file.readline(16).strip() != b"ply":
        raise InputError(f"{path}: is not a PLY file: its first line is not 'ply'")
    order: str | None = None
    tables: list[_Table] = []
    while file.tell() < _MAX_HEADER:
        line = file.readline(4096)
        words = line.decode("ascii", "replace").split()
        if not line or words == ["end_header"]:
            break
        try:
            if not words or words[0] in ("comment", "obj_info"):
                continue
            if words[0] == "format":
                order = _ORDERS[words[1]]
            elif words[0] == "element":
                tables.append(_Table(words[1], int(words[2]), []))
            elif words[0] == "property" and words[1] == "list":
                tables[-1].properties.append(_Property(words[4], _KINDS[words[3]], _KINDS[words[2]]))
            elif words[0] == "property":
                tables[-1].properties.append(_Property(words[2], _KINDS[words[1]]))
        except (KeyError, IndexError, ValueError) as error:
            raise InputError(f"{path}: PLY header line {' '.join(words)!r} cannot be understood") from error
    if words != ["end_header"] or order is None:
        raise InputError(f"{path}: PLY header is cut short: no 'format' or no 'end_header' line")
    for table in tables:
        names = [p.name for p in table.properties]
        if len(set(names)) != len(names) or not names or not 0 <= table.rows <= _MOST_ROWS:
            raise InputError(
                f"{path}: element '{table.name}' of {table.rows} rows with {len(names)} properties: expected 0 to "
                f"{_MOST_ROWS} rows and properties of distinct names"
            )
    return order, tables


def _read_binary(file: BinaryIO, table: _Table, order: str, path: Path) -> Element:
    """One element of a binary file; uniform lists are read as a structured array, ragged ones row by row."""
    start = file.tell()
    lengths = _first_lengths(file, table, order)
    file.seek(start)
    if sum(lengths.values()) > path.stat().st_size:
        return _read_ragged(file, table, order, path)
    fields: list[tuple[str, str] | tuple[str, str, tuple[int]]] = []
    for p in table.properties:
        if p.count_kind:
            fields += [
                (f"{p.name}\0count", order + p.count_kind),
                (p.name, order + p.kind, (lengths[p.name],)),
            ]
        else:
            fields.append((p.name, order + p.kind))
    dtype = np.dtype(fields)
    raw = file.read(min(dtype.itemsize * table.rows, path.stat().st_size))
    if len(raw) == dtype.itemsize * table.rows:
        rows = np.frombuffer(raw, dtype)
        if all((rows[f"{name}\0count"] == n).all() for name, n in lengths.items()):
            return {p.name: rows[p.name].astype(dtype[p.name].base.newbyteorder("=")) for p in table.properties}
    if not table.has_list:
        found = len(raw) // max(dtype.itemsize, 1)
        raise InputError(
            f"{path}: is cut short: element '{table.name}' has {found} whole rows, header says {table.rows}"
        )
    file.seek(start)
    return _read_ragged(file, table, order, path)


def _first_lengths(file: BinaryIO, table: _Table, order: str) -> dict[str, int]:
    """The list lengths of an element's first row, assumed for all rows until checked."""
    lengths: dict[str, int] = {}
    for p in table.properties:
        if p.count_kind is None:
            file.seek(np.dtype(p.kind).itemsize, 1)
            continue
        raw = file.read(np.dtype(p.count_kind).itemsize)
        complete = table.rows > 0 and len(raw) == np.dtype(p.count_kind).itemsize
        lengths[p.name] = max(int(np.frombuffer(raw, order + p.count_kind)[0]), 0) if complete else 0
        file.seek(lengths[p.name] * np.dtype(p.kind).itemsize, 1)
    return lengths


def _read_ragged(file: BinaryIO, table: _Table, order: str, path: Path) -> Element:
    start, data, at = file.tell(), file.read(), 0
    columns: dict[str, list] = {p.name: [] for p in table.properties}
    steps = []
    for p in table.properties:
        count = struct.Struct(order + np.dtype(p.count_kind).char) if p.count_kind else None
        steps.append((columns[p.name], np.dtype(order + p.kind), count))
    try:
        for _ in range(table.rows):
            for column, dtype, count in steps:
                n = 1
                if count is not None:
                    n = count.unpack_from(data, at)[0]
                    at += count.size
                column.append(np.frombuffer(data, dtype, n, at) if n else np.empty(0, dtype))
                at += n * dtype.itemsize
    except (struct.error, ValueError) as error:
        raise InputError(f"{path}: is cut short within element '{table.name}' ({table.rows} rows expected)") from error
    file.seek(start + at)
    return {p.name: _column(columns[p.name], p) for p in table.properties}


def _column(values: list[np.ndarray], p: _Property) -> np.ndarray:
    if p.count_kind is None:
        return np.concatenate(values).astype(p.kind) if values else np.empty(0, p.kind)
    if len({len(v) for v in values}) <= 1:
        return np.array(values, p.kind).reshape(len(values), len(values[0]) if values else 0)
    ragged = np.empty(len(values), object)
    ragged[:] = [v.astype(p.kind) for v in values]
    return ragged


def _read_ascii(data: bytes, tables: list[_Table], path: Path) -> dict[str, Element]:
    try:
        numbers = np.fromstring(data, dtype=np.float64, sep=" ")
    except ValueError as error:
        raise InputError(f"{path}: holds text where numbers are expected ({error})") from error
    elements, at = {}, 0
    for table in tables:
        elements[table.name], at = _take_ascii(numbers, at, table, path)
    return elements


def _take_ascii(numbers: np.ndarray, at: int, table: _Table, path: Path) -> tuple[Element, int]:
    short = InputError(f"{path}: is cut short within element '{table.name}' ({table.rows} rows expected)")
    if not table.has_list:
        width = len(table.properties)
        block = numbers[at : at + table.rows * width]
        if len(block) < table.rows * width:
            raise short
        block = block.reshape(table.rows, width)
        with np.errstate(invalid="ignore"):
            columns = {p.name: block[:, i].astype(p.kind) for i, p in enumerate(table.properties)}
        return columns, at + block.size
    lists: dict[str, list[np.ndarray]] = {p.name: [] for p in table.properties}
    for _ in range(table.rows):
        for p in table.properties:
            if at >= len(numbers):
                raise short
            n = 1
            if p.count_kind:
                if not 0 <= numbers[at] <= len(numbers):
                    raise short
                n, at = int(numbers[at]), at + 1
            if at + n > len(numbers):
                raise short
            lists[p.name].append(numbers[at : at + n])
            at += n
    return {p.name: _column(lists[p.name], p) for p in table.properties}, at


def _kind(values: np.ndarray) -> str:
    kind = values.dtype.kind + str(values.dtype.itemsize)
    if kind not in _NAMES:
        raise TypeError(f"PLY cannot hold {values.dtype}; expected one of {', '.join(_NAMES)}")
    return kind


def _header(elements: Mapping[str, Mapping[str, np.ndarray]]) -> bytes:
    lines = ["ply", "format binary_little_endian 1.0"]
    for name, properties in elements.items():
        lines.append(f"element {name} {len(next(iter(properties.values())))}")
        for key, values in properties.items():
            prefix = "list uchar " if values.ndim == 2 else ""
            lines.append(f"property {prefix}{_NAMES[_kind(values)]} {key}")
    return "\n".join([*lines, "end_header", ""]).encode("ascii")


def _packed(properties: Mapping[str, np.ndarray]) -> np.ndarray:
    fields: list[tuple[str, str] | tuple[str, str, tuple[int]]] = []
    for key, values in properties.items():
        if values.ndim == 2:
            fields += [(f"{key}\0count", "u1"), (key, "<" + _kind(values), (values.shape[1],))]
        else:
            fields.append((key, "<" + _kind(values)))
    rows = np.empty(len(next(iter(properties.values()))), np.dtype(fields))
    for key, values in properties.items():
        rows[key] = values
        if values.ndim == 2:
            rows[f"{key}\0count"] = values.shape[1]
    return rows
