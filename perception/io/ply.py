"""Reader and writer of PLY: elements of named properties, ASCII and both byte orders, uniform and ragged lists.

Format: Greg Turk's "The PLY Polygon File Format" (1994). Binary tables are read as structured arrays.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from perception.errors import InputError
from perception.io.atomic import atomic_file

Element = dict[str, np.ndarray]

_NAMES = {"i1": "char", "u1": "uchar", "i2": "short", "u2": "ushort", "i4": "int", "u4": "uint"}
_NAMES |= {"f4": "float", "f8": "double"}
_KINDS = {name: kind for kind, name in _NAMES.items()} | {np.dtype(kind).name: kind for kind in _NAMES}
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}
_MAX_HEADER = 1 << 20
MOST_ROWS = 1 << 40


@dataclass(frozen=True)
class Property:
    """kind: "f4", "u1", … count: the type of a list's length, None for a scalar."""

    name: str
    kind: str
    count: str | None = None


@dataclass(frozen=True)
class Table:
    """An element as its header describes it."""

    name: str
    rows: int
    properties: list[Property]


def read_ply(path: str | Path) -> dict[str, Element]:
    """All elements of a PLY file: {element: {property: array}}, file order kept, native byte order.
    A scalar property is an array [rows]; a list property is [rows, k] when all its lists have the same length k and an
    object array of 1D arrays otherwise."""
    path = Path(path)
    try:
        with path.open("rb") as file:
            order, tables = _read_header(file, path)
            body = file.read()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}); expected a PLY file") from error
    return read_body(path, body, order, tables)


def read_body(path: Path, body: bytes, order: str, tables: list[Table]) -> dict[str, Element]:
    """The tables that follow a header, as `read_ply` returns them. order: of bytes, "<" or ">"; "" for text."""
    try:
        source = _Body(body, order)
    except ValueError as error:
        raise InputError(f"{path}: holds text where numbers are expected ({error})") from error
    elements = {table.name: _read_element(source, table, path) for table in tables}
    if source.text and source.at < len(source.body):
        raise InputError(f"{path}: holds more numbers than its header says; it is damaged")
    return elements


def map_ply(path: str | Path, element: str) -> np.ndarray:
    """The first element of a binary little-endian PLY as a structured array [rows], mapped into memory, read-only.
    For large tables. InputError when the first element has another name or lists, or when the file is truncated."""
    path = Path(path)
    with path.open("rb") as file:
        order, tables = _read_header(file, path)
        start, size = file.tell(), path.stat().st_size
        if order != "<" or not tables or tables[0].name != element or any(p.count for p in tables[0].properties):
            raise InputError(f"{path}: expected a binary little-endian PLY that begins with plain element '{element}'")
        dtype = np.dtype([(p.name, order + p.kind) for p in tables[0].properties])
        found = (size - start) // max(dtype.itemsize, 1)
        if found < tables[0].rows:
            raise InputError(_cut_short(path, tables[0], found))
        if tables[0].rows == 0 or dtype.itemsize == 0:
            return np.empty(tables[0].rows, dtype)
        return np.memmap(file, dtype, "r", start, (tables[0].rows,))


def write_ply(path: str | Path, elements: Mapping[str, Mapping[str, np.ndarray]]) -> None:
    """Write elements of scalar properties [rows] and list properties [rows, k], in the order given.
    Binary little endian. The file appears complete or not at all."""
    with atomic_file(path) as new, new.open("wb") as file:
        file.write(_header(elements))
        for properties in elements.values():
            packed(properties).tofile(file)


def ply_bytes(elements: Mapping[str, Mapping[str, np.ndarray]]) -> bytes:
    """The bytes of the file that `write_ply` writes, for example to send them over a network."""
    return _header(elements) + b"".join(packed(p).tobytes() for p in elements.values())


def _read_header(file: BinaryIO, path: Path) -> tuple[str, list[Table]]:
    if file.readline(16).strip() != b"ply":
        raise InputError(f"{path}: is not a PLY file: its first line is not 'ply'")
    order: str | None = None
    tables: list[Table] = []
    while file.tell() < _MAX_HEADER:
        line = file.readline(4096)
        fields = line.decode("ascii", "replace").split()
        if not line or fields == ["end_header"]:
            break
        try:
            match fields:
                case ["format", name, *_]:
                    order = _ORDERS[name]
                case ["element", name, rows, *_]:
                    tables.append(Table(name, int(rows), []))
                case ["property", "list", count, kind, name, *_]:
                    tables[-1].properties.append(Property(name, _KINDS[kind], _KINDS[count]))
                case ["property", kind, name, *_]:
                    tables[-1].properties.append(Property(name, _KINDS[kind]))
                case ["format" | "element" | "property", *_]:
                    raise ValueError("too few fields")
        except (KeyError, IndexError, ValueError) as error:
            raise InputError(f"{path}: PLY header line {' '.join(fields)!r} cannot be understood") from error
    if fields != ["end_header"] or order is None:
        raise InputError(f"{path}: PLY header is cut short: no 'format' or no 'end_header' line")
    for table in tables:
        names = [p.name for p in table.properties]
        if len(set(names)) != len(names) or not names or not 0 <= table.rows <= MOST_ROWS:
            raise InputError(
                f"{path}: element '{table.name}' of {table.rows} rows with {len(names)} properties: expected 0 to "
                f"{MOST_ROWS} rows and properties of distinct names"
            )
    return order, tables


class _Body:
    """Values of a body, taken one after another. The numbers of a text are float64, whatever their type."""

    def __init__(self, body: bytes, order: str):
        self.order, self.text, self.at = order, not order, 0
        self.body = body if order else np.fromstring(body, dtype=np.float64, sep=" ").tobytes()

    def take(self, kind: str, count: int) -> np.ndarray:
        """The next `count` values; ValueError if they are not there."""
        if count < 0:
            raise ValueError("a list of negative length")
        dtype = self._stored(kind)
        found = np.frombuffer(self.body, dtype, count, self.at) if count else np.empty(0, dtype)
        self.at += found.nbytes
        return found

    def block(self, table: Table, lengths: dict[str, int]) -> tuple[Element | None, int]:
        """All rows if they have lists of these lengths, else None; the number of such rows that fit into the body."""
        fields: list[tuple] = []
        for p in table.properties:
            fields += [(f"{p.name}\0count", self._stored(p.count))] if p.count else []
            fields.append((p.name, self._stored(p.kind), *([(lengths[p.name],)] if p.count else [])))
        dtype = np.dtype(fields)
        found = (len(self.body) - self.at) // dtype.itemsize
        if found < table.rows:
            return None, found
        rows = np.frombuffer(self.body, dtype, table.rows, self.at) if table.rows else np.empty(0, dtype)
        if not all((rows[f"{name}\0count"] == n).all() for name, n in lengths.items()):
            return None, found
        self.at += rows.nbytes
        return {p.name: _cast(rows[p.name], p.kind) for p in table.properties}, found

    def _stored(self, kind: str) -> str:
        return "f8" if self.text else self.order + kind


def _cast(values: np.ndarray, kind: str) -> np.ndarray:
    with np.errstate(invalid="ignore"):  # a text may hold nan of type int
        return values.astype(kind)


def _read_element(source: _Body, table: Table, path: Path) -> Element:
    """One element, as a table if all lists of a property are as long as the first, else value by value."""
    start, listed = source.at, [p.name for p in table.properties if p.count]
    try:
        first = _take_row(source, table) if listed and table.rows else {}
        source.at = start
        rows, found = source.block(table, {name: len(first.get(name, ())) for name in listed})
        if rows is not None:
            return rows
        each = [_take_row(source, table) for _ in range(table.rows if listed else 0)]
    except (ValueError, OverflowError) as error:
        raise InputError(f"{path}: is cut short within element '{table.name}' ({table.rows} rows expected)") from error
    if not listed:
        raise InputError(_cut_short(path, table, found))
    return {p.name: _column([row[p.name] for row in each], p) for p in table.properties}


def _cut_short(path: Path, table: Table, found: int) -> str:
    return f"{path}: is cut short: element '{table.name}' has {found} complete rows, its header says {table.rows}"


def _take_row(source: _Body, table: Table) -> Element:
    return {p.name: source.take(p.kind, int(source.take(p.count, 1)[0]) if p.count else 1) for p in table.properties}


def _column(values: list[np.ndarray], p: Property) -> np.ndarray:
    if p.count is None:
        return _cast(np.concatenate(values), p.kind)
    if len({len(v) for v in values}) == 1:
        return _cast(np.array(values), p.kind)
    ragged = np.empty(len(values), object)
    ragged[:] = [_cast(v, p.kind) for v in values]
    return ragged


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


def packed(properties: Mapping[str, np.ndarray]) -> np.ndarray:
    """The rows of a table as a structured array, little endian; each list after its length."""
    fields: list[tuple] = []
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
