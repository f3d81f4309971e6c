"""A reader of `.spz`, written from the format's description."""

from __future__ import annotations

import gzip
import struct

import numpy as np


def read_spz(data: bytes) -> dict[str, np.ndarray]:
    """Values as they are in the file, whose y and z point the other way."""
    raw = gzip.decompress(data)
    magic, version, count, degree, bits, flags, reserved = struct.unpack("<IIIBBBB", raw[:16])
    assert (magic, version, flags, reserved) == (0x5053474E, 2, 0, 0)
    at, found = 16, {}
    rest = (degree + 1) ** 2 - 1
    for name, width in (("xyz", 9), ("alpha", 1), ("color", 3), ("scale", 3), ("rotation", 3), ("sh", 3 * rest)):
        found[name] = np.frombuffer(raw, np.uint8, count * width, at).reshape(count, width).astype(np.int64)
        at += count * width
    assert at == len(raw)
    triples = found["xyz"].reshape(count, 3, 3) @ [1, 256, 65536]
    xyz = np.where(triples >= 1 << 23, triples - (1 << 24), triples) / 2.0**bits
    vector = found["rotation"] / 127.5 - 1
    w = np.sqrt(np.maximum(0, 1 - (vector**2).sum(axis=1)))
    return {
        "means": xyz,
        "opacities": found["alpha"][:, 0] / 255,
        "dc": (found["color"] / 255 - 0.5) / 0.15,
        "log_scales": found["scale"] / 16 - 10,
        "quats": np.column_stack([w, vector]),
        "sh": (found["sh"].reshape(count, rest, 3) - 128) / 128,
    }
