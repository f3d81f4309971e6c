"""Reader of `.spz` (Niantic's open format), versions 1 to 4.

A gzip stream of a header and one attribute after the other; in version 4 a plain header, a table of the sizes of the
attributes' streams (compressed and not, 64 bits each), and those, by zstd. Axes are right, up, back, where those of a
3DGS PLY are right, down, front: y and z change sign, and with them the harmonics that are odd in one of them.

    attribute   bytes a Gaussian   value
    positions   9 (6: version 1)   24-bit integers in steps of 2^−bits; float16 in version 1
    alphas      1                  opacity in steps of 1 / 255
    colours     3                  harmonics of degree 0, (byte / 255 − 1/2) / 0.15
    scales      3                  logarithm of σ, byte / 16 − 10
    rotations   3 (4: from 3 on)   x y z of the quaternion, byte / 127.5 − 1; from version 3 on: its smallest three
    harmonics   3 K                (byte − 128) / 128, colour by colour of each of K coefficients
"""

from __future__ import annotations

import gzip
import io
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np

from perception.errors import InputError, missing_extra

MAGIC, VERSIONS = 0x5053474E, (1, 2, 3, 4)
HEADER, HEADER_4 = "<IIIBBBB", "<IIIBBBBI12x"
COLOR_SCALE = 0.15
FLIPS = np.array([-1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1, -1, 1, -1, 1, 1, -1, 1, -1, 1], np.float32)
"""Signs of the harmonics of degrees 1 to 4 when y and z change sign."""
_DENSEST = 1032  # most bytes that a byte of gzip's code can stand for
_EXPECTED = "expected a .spz file of version 1 to 4"


def read_spz(path: Path, check: Callable[[int], None]) -> dict[str, np.ndarray]:
    """means [N, 3], quats [N, 4] wxyz, log_scales [N, 3], opacity_logits [N] and sh [N, K, 3] float32, with the axes of
    a 3DGS PLY. check: is given N before they are unpacked. InputError for another version, and for a file that is
    damaged or none."""
    try:
        data = path.read_bytes()
        plain = data[:4] == struct.pack("<I", MAGIC)
        stream = io.BytesIO(data) if plain else gzip.GzipFile(fileobj=io.BytesIO(data))
        magic, version, count, degree, bits, *_ = struct.unpack(HEADER, stream.read(struct.calcsize(HEADER)))
        if magic != MAGIC or degree > 4:
            raise InputError(f"{path}: is no .spz file; {_EXPECTED}, harmonics up to degree 4")
        if version not in VERSIONS or plain != (version == 4):
            raise InputError(f"{path}: is .spz of version {version}, versions 1 to 4 are read; save it as .ply")
        coefficients = (degree + 1) ** 2 - 1
        widths = (6 if version == 1 else 9, 1, 3, 3, 4 if version >= 3 else 3, 3 * coefficients)
        needed = count * sum(widths)
        if not plain and needed > _DENSEST * len(data):
            raise InputError(f"{path}: is cut short: it cannot hold the {count} Gaussians of its header; copy it anew")
        check(count)
        sizes = [count * width for width in widths]
        streams = _unpacked(data, sizes) if plain else stream.read(needed + 1)  # to its end, where the checksum is
    except InputError:
        raise
    except (OSError, EOFError, zlib.error, struct.error, ValueError) as error:
        raise InputError(f"{path}: cannot be read ({error}); {_EXPECTED}") from error
    if len(streams) < needed:
        whole = len(streams) // sum(widths)
        raise InputError(f"{path}: is cut short: holds {whole} of the {count} Gaussians of its header; copy it anew")
    parts, at = [], 0
    for width in widths:
        parts.append(np.frombuffer(streams, np.uint8, count * width, at).reshape(count, width))
        at += count * width
    positions, alphas, colors, scales, turns, rest = parts
    opacity = np.clip(alphas[:, 0] / 255, 1e-6, 1 - 1e-6)
    sh = np.empty((count, 1 + coefficients, 3), np.float32)
    sh[:, 0] = (colors / 255 - 0.5) / COLOR_SCALE
    sh[:, 1:] = (rest.reshape(count, coefficients, 3) - 128.0) / 128 * FLIPS[:coefficients, None]
    return {
        "means": (_positions(positions, version, bits) * [1, -1, -1]).astype(np.float32),
        "quats": (_quats(turns) * [1, 1, -1, -1]).astype(np.float32),
        "log_scales": (scales / 16 - 10).astype(np.float32),
        "opacity_logits": np.log(opacity / (1 - opacity)).astype(np.float32),
        "sh": sh,
    }


def _unpacked(data: bytes, sizes: list[int]) -> bytes:
    """The attributes of a file of version 4, of such sizes in bytes, one after the other. ValueError where the file's
    table has others, or a stream is damaged."""
    try:
        import zstandard
    except ImportError as error:
        raise missing_extra("zstandard", "spz") from error
    *_, count, at = struct.unpack_from(HEADER_4, data)
    table = np.frombuffer(data, "<u8", 2 * count, at).reshape(count, 2).tolist()
    if [size for _, size in table] != [size for size in sizes if size]:
        raise ValueError("attributes are not of the size that its header tells")
    at, parts = at + 16 * count, []
    for length, size in table:
        try:
            parts.append(zstandard.ZstdDecompressor().stream_reader(data[at : at + length]).read(size))
        except zstandard.ZstdError as error:
            raise ValueError(error) from error
        at += length
    return b"".join(parts)


def _positions(stored: np.ndarray, version: int, bits: int) -> np.ndarray:
    """[N, 3] float64."""
    if version == 1:
        return np.ascontiguousarray(stored).view("<f2").astype(np.float64)
    padded = np.zeros((len(stored), 3, 4), np.uint8)
    padded[:, :, 1:] = stored.reshape(-1, 3, 3)
    return (padded.view("<i4")[:, :, 0] >> 8) / np.float64(2**bits)


def _quats(stored: np.ndarray) -> np.ndarray:
    """[N, 4] float64 wxyz, of x y z as bytes [N, 3], or of the smallest three of x y z w as 32 bits [N, 4]: the index
    of the largest above, then nine bits and a sign of each other, the last one lowest."""
    if stored.shape[1] == 3:
        xyz = stored / 127.5 - 1
        return np.column_stack([np.sqrt(np.maximum(0, 1 - (xyz**2).sum(axis=1))), xyz])
    word = np.ascontiguousarray(stored).view("<u4")[:, 0].copy()
    largest, xyzw = word >> 30, np.zeros((len(stored), 4))
    for i in (3, 2, 1, 0):
        own = largest != i
        sign = np.where(word[own] & 512, -1, 1)
        xyzw[own, i] = sign * (word[own] & 511) / 511 * np.sqrt(0.5)
        word[own] >>= 10
    xyzw[np.arange(len(xyzw)), largest] = np.sqrt(np.maximum(0, 1 - (xyzw**2).sum(axis=1)))
    return xyzw[:, [3, 0, 1, 2]]
