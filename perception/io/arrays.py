"""Reads untrusted .npy and .npz files: allocates no more than the file holds, reports damage as one-line errors."""

from __future__ import annotations

import io
import math
import struct
import sys
import zipfile
from pathlib import Path
from typing import IO

import numpy as np

from perception.errors import InputError
from perception.io.documents import DAMAGE, brief

MOST_ARCHIVE = 4 << 30
"""Maximum uncompressed size of an .npz in bytes, against damaged or hostile files that would fill the memory."""


def read_npz(source: Path | bytes, file: Path, advice: str) -> dict[str, np.ndarray]:
    """The arrays of an .npz (a path, or its bytes; `file` names it), CRC-32s checked; pickled objects are refused."""
    try:
        with zipfile.ZipFile(io.BytesIO(source) if isinstance(source, bytes) else source) as archive:
            entries = archive.infolist()
            size = sum(entry.file_size for entry in entries)
            if size > MOST_ARCHIVE:
                raise InputError(f"{file}: unpacks to {size} bytes, expected at most {MOST_ARCHIVE}")
            arrays = {}
            for entry in entries:
                with archive.open(entry) as stream:
                    arrays[entry.filename.removesuffix(".npy")] = _read_npy(stream, entry.file_size)
            return arrays
    except InputError:
        raise
    except DAMAGE as error:
        raise InputError(f"{file}: cannot be read ({brief(error)}); {advice}") from error


def map_npy(file: Path) -> np.ndarray:
    """The array of an .npy, memory-mapped read-only. Raises the exceptions in DAMAGE; ValueError for a header length
    beyond the file, for which numpy would allocate up to 4 GiB."""
    with file.open("rb") as stream:
        version = _version(stream)
        length = struct.unpack("<H", stream.read(2)) if version == (1, 0) else struct.unpack("<I", stream.read(4))
        left = file.stat().st_size - stream.tell()
    if length[0] > left:
        raise ValueError(f"an array header of {length[0]} bytes, {left} are there")
    return np.lib.format.open_memmap(file, mode="r")


def _version(stream: IO[bytes]) -> tuple[int, int]:
    version = np.lib.format.read_magic(stream)
    if version not in ((1, 0), (2, 0)):
        raise ValueError(f"array format {version}, expected 1.0 or 2.0")
    return version


def _read_npy(stream: IO[bytes], size: int) -> np.ndarray:
    """One array with its header from `size` bytes; a header that does not agree with this size is an error."""
    version = _version(stream)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, fortran, dtype = read(stream)
    if dtype.hasobject or dtype.itemsize == 0 or dtype.fields is not None:
        raise ValueError(f"an array of {dtype}")
    needed, left = math.prod(shape) * dtype.itemsize, size - stream.tell()
    if min(shape, default=0) < 0 or needed != left:
        raise ValueError(f"an array of shape {shape} needs {needed} bytes, {left} are there")
    data = bytearray(stream.read(needed))  # writable, unlike the bytes
    if dtype.kind == "U":  # numpy makes text of any code point; Python's own functions then fail on it
        codes = np.frombuffer(data, np.dtype(np.uint32).newbyteorder(dtype.byteorder))
        if codes.max(initial=0) > sys.maxunicode:
            raise ValueError(f"text with the code point {codes.max():#x}, expected at most {sys.maxunicode:#x}")
    return np.frombuffer(data, dtype).reshape(shape, order="F" if fortran else "C")
