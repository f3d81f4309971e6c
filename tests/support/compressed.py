"""Readers of compressed Gaussians, written from the formats' descriptions."""

from __future__ import annotations

import gzip
import io
import json
import struct
import zipfile

import numpy as np
from PIL import Image


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


def read_sog(data: bytes) -> dict[str, np.ndarray]:
    archive = zipfile.ZipFile(io.BytesIO(data))
    meta = json.loads(archive.read("meta.json"))
    count = meta["count"]

    def pixels(name: str) -> np.ndarray:
        with Image.open(io.BytesIO(archive.read(name))) as image:
            assert image.format == "WEBP"
            return np.asarray(image).astype(np.int64)

    def rows(part: str, which: int = 0) -> np.ndarray:
        image = pixels(meta[part]["files"][which])
        return image.reshape(-1, image.shape[2])[:count]

    low, high = np.array(meta["means"]["mins"]), np.array(meta["means"]["maxs"])
    stretched = low + (high - low) * (rows("means")[:, :3] + 256 * rows("means", 1)[:, :3]) / 65535
    packed = rows("quats")
    others = (packed[:, :3] / 255 - 0.5) * 2 / np.sqrt(2)
    largest = np.sqrt(np.maximum(0, 1 - (others**2).sum(axis=1)))
    quats = np.array([np.insert(o, a - 252, w) for o, w, a in zip(others, largest, packed[:, 3], strict=True)])
    found = {
        "means": np.sign(stretched) * np.expm1(np.abs(stretched)),
        "quats": quats.reshape(count, 4),
        "log_scales": np.array(meta["scales"]["codebook"])[rows("scales")[:, :3]],
        "dc": np.array(meta["sh0"]["codebook"])[rows("sh0")[:, :3]],
        "opacities": rows("sh0")[:, 3] / 255,
        "sh": np.zeros((count, 0, 3)),
    }
    if "shN" in meta:
        size = (meta["shN"]["bands"] + 1) ** 2 - 1
        image = pixels(meta["shN"]["files"][0])
        assert image.shape[1] == 64 * size
        centroids = np.array(meta["shN"]["codebook"])[image.reshape(-1, size, 3)]
        labels = rows("shN", 1)[:, :2] @ [1, 256]
        assert labels.max(initial=0) < meta["shN"]["count"] <= len(centroids)
        found["sh"] = centroids[labels]
    return found
