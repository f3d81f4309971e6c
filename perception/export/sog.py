"""Gaussians as `.sog` (PlayCanvas' open format, version 2): smaller than `.spz`, for viewers in the browser.

A ZIP of meta.json and lossless WebP images, in which a pixel is a Gaussian: positions in 16 bits, rotations in 26,
scales and colours by codebooks of 256 numbers, harmonics by a palette. Axes are those of a 3DGS PLY.
"""

from __future__ import annotations

import io
import json
import math
import zipfile
from pathlib import Path

import numpy as np
from PIL import Image

from perception.export.spz import check_finite
from perception.instances.segments import nearest_centres
from perception.io.atomic import replacing
from perception.map.map import Map

CODES, WIDE = 256, 64
"""Numbers of a codebook; centroids in a row of the palette's image."""
PALETTE, SHARE, FITTED, ROUNDS = 8192, 8, 100_000, 6
"""Of the harmonics: most centroids, Gaussians of each where that gives fewer, Gaussians they are fitted to, rounds."""


def write_sog(path: Path, gmap: Map) -> None:
    """Writes all Gaussians, near ones after each other, and their instance ids [N] int32 (−1 = none) in the same order
    beside it as `.npy`, same stem. InputError where a value is not finite."""
    check_finite(gmap, path)
    order = spatial_order(gmap.means)
    data = sog_bytes(gmap, order)
    with replacing(path.with_suffix(".npy")) as file:
        np.save(file, gmap.instance_ids[order].astype(np.int32))
    with replacing(path) as file:
        file.write(data)


def sog_bytes(gmap: Map, order: np.ndarray) -> bytes:
    """The file's bytes, with the Gaussians in the given order [N]."""
    count, bands = len(order), math.isqrt(gmap.sh.shape[1]) - 1
    means = gmap.means[order].astype(np.float64)
    stretched = np.sign(means) * np.log1p(np.abs(means))
    low, high = (stretched.min(axis=0), stretched.max(axis=0)) if count else (np.zeros(3), np.zeros(3))
    places = np.rint((stretched - low) / np.maximum(high - low, 1e-12) * 65535).astype(np.uint16)
    scale_codes, scales = codebook(gmap.log_scales[order])
    color_codes, colors = codebook(gmap.sh[order, 0])
    alpha = np.rint(255 * gmap.opacities[order]).astype(np.uint8)[:, None]
    images = {
        "means_l": _image(places.astype(np.uint8)),
        "means_u": _image((places >> 8).astype(np.uint8)),
        "scales": _image(scales),
        "quats": _image(_packed(gmap.quats[order])),
        "sh0": _image(np.concatenate([colors, alpha], axis=1)),
    }
    files = {name: {"files": [f"{name}.webp"]} for name in ("scales", "quats", "sh0")}
    meta = {
        "version": 2,
        "asset": {"generator": "splat-perception"},
        "count": count,
        "means": {"mins": low.tolist(), "maxs": high.tolist(), "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": scale_codes, **files["scales"]},
        "quats": files["quats"],
        "sh0": {"codebook": color_codes, **files["sh0"]},
    }
    if bands and count:
        centroids, labels = palette(gmap.sh[order, 1:].reshape(count, -1))
        rest_codes, rest = codebook(centroids)
        full = np.pad(rest, ((0, -len(rest) % WIDE), (0, 0)))
        images["shN_centroids"] = full.reshape(-1, WIDE * rest.shape[1] // 3, 3)
        images["shN_labels"] = _image(labels.astype("<u2")[:, None].view(np.uint8))
        named = ["shN_centroids.webp", "shN_labels.webp"]
        meta["shN"] = {"count": len(centroids), "bands": bands, "codebook": rest_codes, "files": named}
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        for name, pixels in images.items():
            file = io.BytesIO()
            Image.fromarray(pixels).save(file, "WEBP", lossless=True, exact=True, quality=100, method=4)
            archive.writestr(zipfile.ZipInfo(f"{name}.webp"), file.getvalue())
        archive.writestr(zipfile.ZipInfo("meta.json"), json.dumps(meta))
    return packed.getvalue()


def spatial_order(means: np.ndarray) -> np.ndarray:
    """[N] rows of means [N, 3] by their Morton codes, of 21 bits an axis."""
    low = means.min(axis=0, initial=np.inf)
    size = max(float((means - low).max(initial=0)), 1e-12)
    cells = ((means - low) / size * ((1 << 21) - 1)).astype(np.uint64)
    codes = np.zeros(len(means), np.uint64)
    for bit in range(21):
        for axis in range(3):
            codes |= ((cells[:, axis] >> np.uint64(bit)) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return np.argsort(codes, kind="stable")


def codebook(values: np.ndarray) -> tuple[list[float], np.ndarray]:
    """CODES numbers that are near the values [N, D] in the mean square, and the nearest of each value [N, D] uint8."""
    flat = np.sort(values.astype(np.float64).ravel())
    if not len(flat):
        return [0.0] * CODES, values.astype(np.uint8)
    # The best codes of a density p are as dense as its cube root: between two sorted values that far apart, gap^(2/3).
    spent = np.concatenate([[0], np.cumsum(np.diff(flat) ** (2 / 3))])
    codes = np.interp(np.linspace(0, spent[-1], CODES), spent, flat)
    for _ in range(20):  # Lloyd's algorithm: sums between the borders of sorted values
        ends = np.searchsorted(flat, (codes[1:] + codes[:-1]) / 2)
        sums = np.diff(np.concatenate([[0], np.cumsum(flat)])[np.concatenate([[0], ends, [len(flat)]])])
        counts = np.diff(np.concatenate([[0], ends, [len(flat)]]))
        codes = np.sort(np.where(counts > 0, sums / np.maximum(counts, 1), codes))
    nearest = np.searchsorted((codes[1:] + codes[:-1]) / 2, values.astype(np.float64))
    return codes.tolist(), nearest.astype(np.uint8)


def palette(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centroids [K, D] of the rows [N, D], and the nearest of each row [N], by k-means from evenly chosen rows."""
    count = int(np.clip(len(rows) // SHARE, 1, PALETTE))
    fitted = rows[np.unique(np.linspace(0, len(rows) - 1, FITTED).astype(int))].astype(np.float32)
    centroids = fitted[np.linspace(0, len(fitted) - 1, count).astype(int)]
    for _ in range(ROUNDS):
        labels = nearest_centres(fitted, centroids)
        sizes = np.bincount(labels, minlength=count)
        sums = np.stack([np.bincount(labels, fitted[:, d], count) for d in range(fitted.shape[1])], axis=1)
        centroids = np.where(sizes[:, None] > 0, sums / np.maximum(sizes, 1)[:, None], centroids).astype(np.float32)
    return centroids, nearest_centres(rows.astype(np.float32), centroids)


def _packed(quats: np.ndarray) -> np.ndarray:
    """[N, 4] bytes: the three smaller components of w, x, y, z, and 252 + the place of the largest."""
    quats = quats / np.maximum(np.linalg.norm(quats, axis=1, keepdims=True), 1e-12)
    largest = np.abs(quats).argmax(axis=1)
    rows = np.arange(len(quats))
    quats = quats * np.where(quats[rows, largest] < 0, -1, 1)[:, None]
    others = quats[np.arange(4) != largest[:, None]].reshape(-1, 3)
    values = np.rint((others * math.sqrt(2) + 1) / 2 * 255)
    return np.concatenate([np.clip(values, 0, 255), 252 + largest[:, None]], axis=1).astype(np.uint8)


def _image(values: np.ndarray) -> np.ndarray:
    """Rows of [N, 1 to 4] bytes as the pixels of an almost square image [h, w, 3 or 4]."""
    count, channels = values.shape
    width = max(4, -(-math.isqrt(max(count - 1, 0)) // 4) * 4 + 4)
    height = max(1, -(-count // width))
    image = np.zeros((height * width, 4 if channels == 4 else 3), np.uint8)
    image[:count, :channels] = values
    return image.reshape(height, width, -1)
