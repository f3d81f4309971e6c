"""Reads untrusted .npy and .npz files: allocates no more than the file holds, reports damage as one-line errors."""

from __future__ import annotations

import io
import math
import struct
import sys
import zipfile
from pathlib import Path
from threading import Lock
from typing import IO

import numpy as np

from perception.errors import InputError
from perception.io.documents import refusing
from perception.machine import require_memory

MOST_ARCHIVE = 4 << 30
"""Maximum uncompressed size of an .npz in bytes, against damaged or hostile files that would fill the memory."""
_DENSEST = 1032  # most bytes that a byte of deflate's code can stand for
_MOST_HEADER = 1 << 16
_PIECE = 1 << 20  # bytes that are unpacked at a time
_ONE_HEADER = Lock()
"""NumPy reads a header by `ast.literal_eval`, which in Python 3.11 fails now and then where two threads call it ("AST
constructor recursion depth mismatch"): a good map would be called damaged."""


def read_npz(source: Path | bytes, file: Path, advice: str) -> dict[str, np.ndarray]:
    """The arrays of an .npz (a path, or its bytes; `file` names it), CRC-32s checked; pickled objects are refused.

    Each array is unpacked into its own memory, once. InputError for more than MOST_ARCHIVE bytes, or than are free.
    """
    with refusing(f"{file}: cannot be read ({{why}}); {advice}"):
        stream = io.BytesIO(source) if isinstance(source, bytes) else source.open("rb")
        with stream, zipfile.ZipFile(stream) as archive:
            entries = archive.infolist()
            size = sum(entry.file_size for entry in entries)
            if size > MOST_ARCHIVE:
                raise InputError(f"{file}: unpacks to {size} bytes, expected at most {MOST_ARCHIVE}")
            held = stream.seek(0, io.SEEK_END)
            if any(entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED) for entry in entries):
                raise ValueError("packed otherwise than by deflate")
            if sum(entry.compress_size for entry in entries) > held or size > _DENSEST * held:
                raise ValueError(f"{held} bytes cannot hold {size}")
            require_memory(size, str(file), "use a machine with more memory")
            return {entry.filename.removesuffix(".npy"): _unpacked(archive, entry) for entry in entries}


def map_npy(file: Path) -> np.ndarray:
    """The array of an .npy, memory-mapped read-only. Of damaged bytes NumPy raises errors of many classes, as
    SyntaxError; ValueError for a header that claims more than the file holds."""
    with file.open("rb") as stream:
        shape, fortran, dtype = _header(stream, file.stat().st_size)
        if not math.prod(shape):
            return np.empty(shape, dtype)
        return np.memmap(stream, dtype, "r", stream.tell(), shape, "F" if fortran else "C")


def _unpacked(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> np.ndarray:
    with archive.open(entry) as stream:
        shape, fortran, dtype = _header(stream, entry.file_size)
        array = np.empty(shape, dtype, "F" if fortran else "C")
        flat, at = array.reshape(-1, order="A").view(np.uint8), 0
        while piece := stream.read(_PIECE):  # to the end, where the CRC-32 is compared
            flat[at : at + len(piece)] = np.frombuffer(piece, np.uint8)
            at += len(piece)
    if at != len(flat):
        raise ValueError(f"an array of shape {shape} needs {len(flat)} bytes, {at} are there")
    if dtype.kind == "U":  # numpy makes text of any code point; Python's own functions then fail on it
        codes = flat.view(np.dtype(np.uint32).newbyteorder(dtype.byteorder))
        if codes.max(initial=0) > sys.maxunicode:
            raise ValueError(f"text with the code point {codes.max():#x}, expected at most {sys.maxunicode:#x}")
    return array


def _header(stream: IO[bytes], size: int) -> tuple[tuple[int, ...], bool, np.dtype]:
    """(shape, whether in Fortran's order, dtype) of an array that fills `size` bytes with its header. ValueError for a
    length of the header or of the array that does not agree with this size, for which numpy would take memory."""
    version = np.lib.format.read_magic(stream)
    if version not in ((1, 0), (2, 0)):
        raise ValueError(f"array format {version}, expected 1.0 or 2.0")
    first = version == (1, 0)
    length = stream.read(2 if first else 4)
    (wanted,), left = struct.unpack("<H" if first else "<I", length), size - stream.tell()
    if wanted > min(left, _MOST_HEADER):
        raise ValueError(f"an array header of {wanted} bytes, {left} are there")
    header = io.BytesIO(length + stream.read(wanted))
    with _ONE_HEADER:
        read = np.lib.format.read_array_header_1_0 if first else np.lib.format.read_array_header_2_0
        shape, fortran, dtype = read(header)
    if dtype.hasobject or dtype.itemsize == 0 or dtype.fields is not None or dtype.subdtype is not None:
        raise ValueError(f"an array of {dtype}")
    needed, left = math.prod(shape) * dtype.itemsize, left - wanted
    if min(shape, default=0) < 0 or needed != left:
        raise ValueError(f"an array of shape {shape} needs {needed} bytes, {left} are there")
    return shape, fortran, dtype
