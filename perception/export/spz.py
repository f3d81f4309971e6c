"""Gaussians as `.spz` (Niantic's open format, version 2): a tenth of the size of the PLY, for viewers in the browser.

A gzip stream: header, then per attribute one byte a value: positions (24 bits fixed point each), alphas, colours,
scales, rotations, harmonics. Axes are right, up, back, where those of a 3DGS PLY are right, down, front: y and z change
sign.
"""

from __future__ import annotations

import gzip
import math
import struct
from pathlib import Path

import numpy as np

from perception.errors import InputError
from perception.io.atomic import write_file
from perception.map.map import Map
from perception.splats.spz import COLOR_SCALE, FLIPS, HEADER, MAGIC

VERSION = 2
FIRST_BITS, REST_BITS = 5, 4  # bits that are kept of harmonics of degree 1, and of higher ones; fewer compress better
FARTHEST = 1 << 22  # largest coordinate: with no bits behind the point, of 24 with sign


def write_spz(path: Path, gmap: Map) -> None:
    """Writes all Gaussians in map order, and their instance ids [N] int32 (−1 = none) beside it as `.npy`, same stem.
    Errors: positions 2⁻ᵇ / 2 with b = 12 bits or as many as the map's size leaves, log-scales 1/32, opacities and
    colours 1/510. InputError as `spz_bytes`."""
    data = spz_bytes(gmap, path)
    write_file(path.with_suffix(".npy"), lambda file: np.save(file, gmap.instance_ids.astype(np.int32)))
    write_file(path, data)


def position_bits(means: np.ndarray) -> int:
    """Bits behind the point of means [N, 3]: 12, or as many of 24 as the farthest leaves."""
    largest = max(1.0, float(np.abs(means).max(initial=0.0)))
    return min(12, 22 - math.ceil(math.log2(largest)))


def spz_bytes(gmap: Map, path: Path = Path("map.spz")) -> bytes:
    """The file's bytes. InputError naming `path` where a value is not finite, or a mean beyond what 24 bits hold."""
    for name in ("means", "quats", "log_scales", "opacity_logits", "sh"):
        values = getattr(gmap, name)
        wrong = np.isnan(values) if name in ("log_scales", "opacity_logits") else ~np.isfinite(values)
        if wrong.any():  # an infinite logit is an opacity of 0 or 1, and a logarithm of -∞ a size of 0
            raise InputError(f"{path}: {name} of some Gaussians are not finite; upgrade or rebuild the map")
    count, degree = len(gmap), math.isqrt(gmap.sh.shape[1]) - 1
    means = gmap.means.astype(np.float64) * [1, -1, -1]
    if (largest := float(np.abs(means).max(initial=0.0))) > FARTHEST:
        raise InputError(f"{path}: a Gaussian lies {largest:.3g} from the origin, at most {FARTHEST} is held; use .ply")
    bits = position_bits(means)
    fixed = np.rint(means * 2.0**bits).astype("<i4")
    positions = np.ascontiguousarray(fixed).view(np.uint8).reshape(count, 3, 4)[:, :, :3]
    quats = gmap.quats / np.maximum(np.linalg.norm(gmap.quats, axis=1, keepdims=True), 1e-12)
    quats = quats * np.where(quats[:, :1] < 0, -1, 1)
    columns = [
        positions,
        _bytes(255 * gmap.opacities),
        _bytes(255 * (COLOR_SCALE * gmap.sh[:, 0] + 0.5)),
        _bytes(16 * (gmap.log_scales + 10)),
        _bytes(127.5 * quats[:, 1:] * [1, -1, -1] + 127.5),
        _harmonics(gmap.sh[:, 1:]),
    ]
    header = struct.pack(HEADER, MAGIC, VERSION, count, degree, bits, 0, 0)
    return gzip.compress(header + b"".join(column.tobytes() for column in columns), 6, mtime=0)


def _harmonics(rest: np.ndarray) -> np.ndarray:
    """[N, K − 1, 3] coefficients in steps of 2^(8 − bits) / 128 about 128, colour by colour of each coefficient."""
    steps = np.where(np.arange(rest.shape[1]) < 3, 1 << (8 - FIRST_BITS), 1 << (8 - REST_BITS))[:, None]
    values = np.rint(rest * FLIPS[: rest.shape[1], None] * 128) + 128
    return _bytes((values + steps // 2) // steps * steps)


def _bytes(values: np.ndarray) -> np.ndarray:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)
