"""Reader and writer of PLY (Greg Turk 1994, with the 64-bit types of later writers): ASCII and both byte orders.

A table of which all rows have the same size is a structured array over the bytes of the file, which is held once.
"""

from __future__ import annotations

import re
import struct
import warnings
from array import array
from codecs import BOM_UTF8
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from perception.errors import InputError
from perception.io.atomic import atomic_file


@dataclass(frozen=True)
class Lists:
    """Lists of different lengths, one after another: values [sum of counts], counts [rows] uint32."""

    values: np.ndarray
    counts: np.ndarray

    def __len__(self) -> int:
        return len(self.counts)


Element = dict[str, np.ndarray | Lists]

_NAMES = {"i1": "char", "u1": "uchar", "i2": "short", "u2": "ushort", "i4": "int", "u4": "uint"}
_NAMES |= {"f4": "float", "f8": "double"}
_WIDE = {"long": "i8", "longlong": "i8", "ulong": "u8", "ulonglong": "u8", "half": "f2", "bool": "u1"}
_KINDS = {name: kind for kind, name in _NAMES.items()} | _WIDE
_KINDS |= {np.dtype(kind).name: kind for kind in (*_NAMES, "i8", "u8", "f2")}
_CODES = dict(zip(("i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8", "f2", "f4", "f8"), "bBhHiIqQefd", strict=True))
"""The types as `struct` names them."""
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}
_MAX_HEADER = 1 << 20
MOST_ROWS = 1 << 40
_PIECE = 1 << 15  # rows of different sizes that are gathered at a time
_MSVC_NAN = re.compile(rb"-?1\.#[A-Z]+[0-9]*")
"""How programs of older Visual C++ write numbers that are not finite."""


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
    A scalar property is an array [rows]; a list property is [rows, k] when all its lists have the same length k, and
    `Lists` otherwise. Arrays may be read-only views of the file's bytes. Of properties of one name the first counts."""
    path = Path(path)
    with _opened(path) as file:
        return read_body(path, file, *_read_header(file, path))


def ply_tables(path: Path) -> list[Table]:
    """The elements that the header of a PLY file lists."""
    with _opened(path) as file:
        return _read_header(file, path)[1]


@contextmanager
def _opened(path: Path) -> Iterator[BinaryIO]:
    try:
        with path.open("rb") as file:
            yield file
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}); expected a PLY file") from error


def read_body(path: Path, file: BinaryIO, order: str, tables: list[Table]) -> dict[str, Element]:
    """The tables that follow a header, as `read_ply` returns them. order: of bytes, "<" or ">"; "" for text."""
    try:
        source = _Body(file, order)
    except (ValueError, DeprecationWarning) as error:
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
        columns = {p.name: order + p.kind for p in tables[0].properties if not p.count} if tables else {}
        if order != "<" or not columns or tables[0].name != element or len(columns) < len(tables[0].properties):
            raise InputError(f"{path}: expected a binary little-endian PLY that begins with plain element '{element}'")
        dtype = np.dtype(list(columns.items()))
        found = (size - start) // dtype.itemsize
        if found < tables[0].rows:
            raise InputError(_cut_short(path, tables[0], found))
        if tables[0].rows == 0:
            return np.empty(0, dtype)
        return np.memmap(file, dtype, "r", start, (tables[0].rows,))


def write_ply(path: str | Path, elements: Mapping[str, Mapping[str, np.ndarray]]) -> None:
    """Write elements of scalar properties [rows] and list properties [rows, k], in the order given, little endian."""
    with atomic_file(path) as new, new.open("wb") as file:
        file.write(_header(elements))
        for properties in elements.values():
            packed(properties).tofile(file)


def ply_bytes(elements: Mapping[str, Mapping[str, np.ndarray]]) -> bytes:
    """The bytes of the file that `write_ply` writes, for example to send them over a network."""
    return _header(elements) + b"".join(packed(p).tobytes() for p in elements.values())


def _read_header(file: BinaryIO, path: Path) -> tuple[str, list[Table]]:
    """The byte order and the tables; the file is then at its first row. Lines end as the first one does."""
    data = file.read(_MAX_HEADER)
    begin = len(BOM_UTF8) if data.startswith(BOM_UTF8) else 0
    first = re.compile(rb"ply[ \t]*(\r?\n|\r)").match(data, begin)
    if first is None:
        raise InputError(f"{path}: is not a PLY file: its first line is not 'ply'")
    eol = rb"\r" if first[1] == b"\r" else rb"\r?\n"
    end = re.compile(rb"[\r\n][ \t]*end_header[ \t]*(" + eol + rb"|\Z)").search(data)
    file.seek(end.end() if end else 0)
    order: str | None = None
    tables: list[Table] = []
    for line in data[begin : end.start() if end else None].splitlines():
        fields = line.decode("ascii", "replace").split()
        try:
            match fields:
                case ["format", name, *_]:
                    order = _ORDERS[name]
                case ["element", name, rows, *_]:
                    tables.append(Table(name, int(rows), []))
                case ["property", "list", count, kind, name, *_]:
                    tables[-1].properties.append(Property(name, _kind_named(kind), _kind_named(count)))
                case ["property", kind, name, *_]:
                    tables[-1].properties.append(Property(name, _kind_named(kind)))
                case ["format" | "element" | "property", *_]:
                    raise ValueError("too few fields")
        except (KeyError, IndexError, ValueError) as error:
            raise InputError(f"{path}: PLY header line {' '.join(fields)[:80]!r} cannot be understood") from error
    if end is None or order is None:
        raise InputError(f"{path}: PLY header is cut short: no 'format' or no 'end_header' line")
    for table in tables:
        if not 0 <= table.rows <= MOST_ROWS:
            raise InputError(f"{path}: element '{table.name}' of {table.rows} rows: expected 0 to {MOST_ROWS}")
    return order, tables


def _kind_named(name: str) -> str:
    return _KINDS[name.lower().removesuffix("_t")]


class _Body:
    """The bytes of a body, taken one element after another. The numbers of a text are float64, whatever their type."""

    def __init__(self, file: BinaryIO, order: str):
        self.order, self.text, self.at = order, not order, 0
        self.body = memoryview(file.read()) if order else _numbers(file).view(np.uint8).data

    def block(self, table: Table, lengths: list[int]) -> tuple[Element | None, int]:
        """All rows if their lists have these lengths, else None; the number of such rows that fit into the body."""
        fields: list[tuple] = []
        left = iter(lengths)
        for number, p in enumerate(table.properties):
            fields += [(f"count {number}", self._stored(p.count))] if p.count else []
            fields.append((str(number), self._stored(p.kind), *([(next(left),)] if p.count else [])))
        dtype = np.dtype(fields)
        found = (len(self.body) - self.at) // dtype.itemsize if dtype.itemsize else table.rows
        if found < table.rows:
            return None, found
        empty = table.rows == 0 or dtype.itemsize == 0
        rows = np.empty(0, dtype) if empty else np.frombuffer(self.body, dtype, table.rows, self.at)
        counts = (rows[name] for name in dtype.names or () if name.startswith("count"))
        if not all((count == n).all() for count, n in zip(counts, lengths, strict=True)):
            return None, found
        self.at += rows.nbytes
        return _named(table, [_cast(rows[str(n)], p.kind) for n, p in enumerate(table.properties)]), found

    def lengths(self, table: Table, rows: int) -> list[np.ndarray]:
        """The lengths [rows] of the lists of each list property, read row by row; then `at` is behind the rows.
        ValueError, OverflowError or struct.error where the body is too short."""
        steps, skip, at, body = [], 0, self.at, self.body
        for p in table.properties:
            width = np.dtype(self._stored(p.kind)).itemsize
            if p.count:
                count = struct.Struct(f"{self.order or '='}{'d' if self.text else _CODES[p.count]}")
                steps.append((skip, count.unpack_from, count.size, width, array("I")))
                skip = 0
            else:
                skip += width
        for _ in range(rows):
            for before, unpack, size, width, found in steps:
                at += before
                n = int(unpack(body, at)[0])
                found.append(n)
                at += size + n * width
            at += skip
        if at > len(body):
            raise ValueError("cut short")
        self.at = at
        return [np.frombuffer(found, np.uint32) if found else np.empty(0, np.uint32) for *_, found in steps]

    def ragged(self, table: Table) -> Element:
        """All rows, of which lists differ in length, gathered in pieces."""
        end, body = self.at, np.frombuffer(self.body, np.uint8)
        lengths = iter(self.lengths(table, table.rows))
        counts = [next(lengths) if p.count else None for p in table.properties]
        totals = [table.rows if n is None else int(n.sum(dtype=np.int64)) for n in counts]
        columns = [np.empty(n, p.kind) for n, p in zip(totals, table.properties, strict=True)]
        filled = [0] * len(columns)
        for begin in range(0, table.rows, _PIECE):
            some = [None if n is None else n[begin : begin + _PIECE].astype(np.int64) for n in counts]
            one = np.ones(min(_PIECE, table.rows - begin), np.int64)
            layout = [
                (np.dtype(self._stored(p.count)).itemsize if p.count else 0, np.dtype(self._stored(p.kind)), n)
                for p, n in zip(table.properties, some, strict=True)
            ]
            sizes = sum((head + kind.itemsize * (one if n is None else n) for head, kind, n in layout), 0 * one)
            at = end + np.cumsum(sizes) - sizes  # where the property of each row begins
            end += int(sizes.sum())
            for i, (head, kind, n) in enumerate(layout):
                n = one if n is None else n
                first = np.repeat(at + head - kind.itemsize * (np.cumsum(n) - n), n)
                spots = first + kind.itemsize * np.arange(len(first))
                values = body[spots[:, None] + np.arange(kind.itemsize)].view(kind)[:, 0]
                columns[i][filled[i] : filled[i] + len(spots)] = _cast(values, table.properties[i].kind)
                filled[i] += len(spots)
                at += head + kind.itemsize * n
        return _named(table, [v if n is None else Lists(v, n) for v, n in zip(columns, counts, strict=True)])

    def _stored(self, kind: str) -> str:
        return "f8" if self.text else self.order + kind


def _named(table: Table, columns: Sequence[np.ndarray | Lists]) -> Element:
    """The columns by name, in order; of one name the first."""
    found: Element = {}
    for p, values in zip(table.properties, columns, strict=True):
        found.setdefault(p.name, values)
    return found


def _numbers(file: BinaryIO) -> np.ndarray:
    """The numbers of a text [N] float64, from where the file is; for other words ValueError, or DeprecationWarning
    before NumPy 2.4, which would leave them and all that follows out."""
    start = file.tell()
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)
        try:
            return np.fromfile(file, np.float64, sep=" ")
        except (ValueError, DeprecationWarning):
            file.seek(start)
            text = _MSVC_NAN.sub(b"nan", file.read())
            return np.fromstring(text, np.float64, sep=" ") if text.strip() else np.empty(0)


def _cast(values: np.ndarray, kind: str) -> np.ndarray:
    with np.errstate(invalid="ignore", over="ignore"):  # a text may hold nan of type int, and 1e400
        return values.astype(kind, copy=False)


def _read_element(source: _Body, table: Table, path: Path) -> Element:
    """One element, as a table if all lists of a property are as long as the first, else row by row."""
    start, listed = source.at, any(p.count for p in table.properties)
    try:
        first = [int(n.sum()) for n in source.lengths(table, min(table.rows, 1))] if listed else []
        source.at = start
        rows, found = source.block(table, first)
        if rows is None and listed:
            rows = source.ragged(table)
    except (ValueError, OverflowError, struct.error) as error:
        raise InputError(f"{path}: is cut short within element '{table.name}' ({table.rows} rows expected)") from error
    if rows is None:
        raise InputError(_cut_short(path, table, found))
    return rows


def _cut_short(path: Path, table: Table, found: int) -> str:
    return f"{path}: is cut short: element '{table.name}' has {found} complete rows, its header says {table.rows}"


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
        fields += [(f"{key}\0count", "u1")] if values.ndim == 2 else []
        fields.append((key, "<" + _kind(values), values.shape[1:]))
    rows = np.empty(len(next(iter(properties.values()))), np.dtype(fields))
    for key, values in properties.items():
        rows[key] = values
        if values.ndim == 2:
            rows[f"{key}\0count"] = values.shape[1]
    return rows
