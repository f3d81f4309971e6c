"""Reads a finished Gaussian scene: the PLY of 3DGS and its variants, SuperSplat's compressed PLY, and `.spz`.

property            usual meaning                        variants that are read
x y z               mean                                 float64
f_dc_*, f_rest_*    harmonics of degree 0 to 4           none of degree 1 and more; red green blue, 0 to 255
opacity             logit                                the opacity itself, in [0, 1], or in [-1, 1] by its size
scale_*             logarithm of the σ along each axis   σ itself; two of them (a disc, as of 2DGS)
rot_*               quaternion wxyz of any length        none: no rotation
filter_3D           none                                 Mip-Splatting's smoothing σ, with which Gaussians are drawn
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from perception.colors import sh_from_rgb
from perception.errors import InputError
from perception.io.documents import brief, refusing
from perception.io.ply import Element, map_ply, ply_tables, read_ply
from perception.splats.spz import read_spz

NAMES = ("means", "quats", "log_scales", "opacity_logits", "sh")
LEAST_ROWS = 64
"""Gaussians that a scene needs: fewer are one blob, or nothing that instances could be found in."""
LINEAR_SHARE, LINEAR_SPACING, SOME = 0.05, 10.0, 2000
"""Median of exp(scale), relative to the extent of the scene, and to the median distance of SOME to the next Gaussian,
above which positive scales are no logarithms."""
LEAST_LOG = 1.0
"""Median below which they are none either: of Gaussians that are all larger than 1, half would be smaller than e."""
ABOVE = 1e-3
"""How much larger than 1 opacities may be rounded."""
FLAT = 1e-3
"""Thickness of a disc relative to its smaller σ."""
PARKED = -80.0
"""Logit of the opacity of rows that are not numbers: never drawn, and e^80 is a float32."""
ROUNDED = 0.1
"""Largest rounding of positions that are stored as float64, relative to the median σ."""
CHUNK = 256
"""Gaussians that share the bounds of one row of `chunk` in a compressed PLY."""
_REFUSED = "expected the properties of a Gaussian splat (x y z, opacity, scale_*, rot_*, f_dc_*)"


@dataclass(frozen=True)
class Splat:
    """Gaussians as a map stores them, float32: means [N, 3], quats [N, 4] wxyz of any length, log_scales [N, 3],
    opacity_logits [N], sh [N, K, 3]. Rows that hold NaN, or an infinite mean, rotation or colour, are parked: in the
    place of the first good row, never drawn. parked [N] bool. notes: on how the file was read, one line each."""

    means: np.ndarray
    quats: np.ndarray
    log_scales: np.ndarray
    opacity_logits: np.ndarray
    sh: np.ndarray
    parked: np.ndarray = field(default_factory=lambda: np.zeros(0, bool))
    notes: list[str] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.means)

    def arrays(self) -> dict[str, np.ndarray]:
        """The five arrays by name."""
        return {name: getattr(self, name) for name in NAMES}


def read_splat(path: Path, check: Callable[[int], None] = lambda count: None) -> Splat:
    """The Gaussians of a file, row for row. check: is given their number before they are in memory. InputError for a
    mesh, a cloud of points, too few Gaussians, an unknown version, and a damaged file."""
    if path.suffix.lower() == ".spz":
        stored = read_spz(path, check)
        means, quats, log_scales, logits, sh = (np.ascontiguousarray(stored[name]) for name in NAMES)
        splat = Splat(means, quats, log_scales, logits, sh)
    else:
        rows = _ply_rows(path)
        count = len(next(iter(rows.values())))
        _check_count(path, count)
        check(count)
        with refusing(f"{path}: its elements do not fit each other ({{why}}); export it anew"):
            splat = _compressed(rows) if "packed_position" in rows else _plain(path, rows)
    _check_count(path, len(splat))
    return _parked(path, splat)


def _check_count(path: Path, count: int) -> None:
    if count < LEAST_ROWS:
        found = f"holds {count} Gaussians" if count else "holds no Gaussians"
        raise InputError(f"{path}: {found}, expected a scene of at least {LEAST_ROWS}; give the scene it was cut from")


def _ply_rows(path: Path) -> Mapping[str, np.ndarray]:
    """The scalar properties of the vertices by name; those of `chunk` and `sh` of a compressed PLY among them."""
    tables = {table.name: table for table in ply_tables(path)}
    names = {p.name for p in tables["vertex"].properties} if "vertex" in tables else set()
    if "face" in tables and tables["face"].rows:
        raise InputError(f"{path}: is a mesh; {_REFUSED}. `perception export MAP --points {path.name}` labels a mesh")
    missing = {"x", "y", "z", "opacity", "scale_0", "scale_1"} - names
    if "packed_position" not in names and missing and names & {"opacity", "scale_0", "rot_0", "f_dc_0"}:
        lacking = " ".join(sorted(missing))
        raise InputError(f"{path}: lacks the properties {lacking} of a Gaussian splat; write the file anew with them")
    if "packed_position" not in names and missing:
        found = "a cloud of points without opacity and scales" if {"x", "y", "z"} <= names else "no Gaussians"
        todo = "train a splat of its photos, or give the photos; `perception export MAP --points` labels a cloud"
        raise InputError(f"{path}: holds {found} (properties: {brief(' '.join(sorted(names)))}); {_REFUSED}. {todo}")
    if next(iter(tables)) == "vertex" and all(p.count is None for p in tables["vertex"].properties):
        try:  # without a second copy in memory
            mapped = map_ply(path, "vertex")
            return {name: mapped[name] for name in mapped.dtype.names or ()}
        except InputError:
            pass  # a text, or another byte order
    elements = read_ply(path)
    parts: list[Element] = [elements[name] for name in ("vertex", "chunk", "sh") if name in elements]
    return {name: column for part in parts for name, column in part.items() if isinstance(column, np.ndarray)}


def _plain(path: Path, rows: Mapping[str, np.ndarray]) -> Splat:
    """The Gaussians of one property a value."""

    def table(names: list[str]) -> np.ndarray:
        values = np.empty((len(rows["x"]), len(names)), np.float32)
        with np.errstate(over="ignore"):  # of float64: such a row is parked
            for i, name in enumerate(names):
                values[:, i] = rows[name]
        return values

    notes = []
    rest = sum(name.startswith("f_rest_") for name in rows)
    if rest not in (0, 9, 24, 45, 72) or any(f"f_rest_{i}" not in rows for i in range(rest)):
        raise InputError(f"{path}: has {rest} properties f_rest_*, expected 0, 9, 24, 45 or 72; write the file anew")
    if all(f"f_dc_{i}" in rows for i in range(3)):
        constant = table([f"f_dc_{i}" for i in range(3)])
    elif all(name in rows for name in ("red", "green", "blue")):
        stored = table(["red", "green", "blue"])
        shares = rows["red"].dtype.kind == "f" and stored.max(initial=0) <= 1
        constant = np.asarray(sh_from_rgb(stored if shares else stored / 255), np.float32)
        notes.append("colours are those of red, green and blue: there is no f_dc_0")
    else:
        raise InputError(f"{path}: has no colours; expected f_dc_0 to f_dc_2, or red, green and blue")
    sh = np.empty((len(constant), 1 + rest // 3, 3), np.float32)
    sh[:, 0] = constant
    for i in range(rest):  # all of red, then green, then blue
        sh[:, 1 + i % (rest // 3), i // (rest // 3)] = rows[f"f_rest_{i}"]
    means, opacity = table(["x", "y", "z"]), table(["opacity"])[:, 0]
    scales = table([f"scale_{i}" for i in range(3) if f"scale_{i}" in rows])
    quats = np.tile(np.array([1, 0, 0, 0], np.float32), (len(means), 1))
    if turned := all(f"rot_{i}" in rows for i in range(4)):
        quats = table([f"rot_{i}" for i in range(4)])
    notes += [] if turned else ["Gaussians have no rotation: there is no rot_0 to rot_3"]
    scales, opacity = _decoded(means, scales, opacity, notes)
    if "filter_3D" in rows:
        scales, opacity = _filtered(scales, opacity, rows["filter_3D"])
        notes.append("scales and opacities are those with Mip-Splatting's filter_3D, as it draws them")
    if (good := np.isfinite(means).all(axis=1) & ~np.isnan(scales).any(axis=1)).any():
        rounded = max(float(np.median(np.abs(rows[a][good] - means[good, i]))) for i, a in enumerate("xyz"))
        if rounded > ROUNDED * (sigma := float(np.exp(np.median(scales[good])))):
            found = f"lies so far from its origin that float32 rounds positions by {rounded:.2g}, and σ is {sigma:.2g}"
            raise InputError(f"{path}: {found}; move the scene to its origin")
    return Splat(means, quats, scales, opacity, sh, notes=notes)


def _decoded(
    means: np.ndarray, scales: np.ndarray, opacity: np.ndarray, notes: list[str]
) -> tuple[np.ndarray, np.ndarray]:
    """Log-scales [N, 3] and opacity logits [N], of scales [N, 2 or 3] and opacities of either coding."""
    good = np.isfinite(means).all(axis=1) & ~np.isnan(scales).any(axis=1) & ~np.isnan(opacity)
    if not good.any():
        return scales, opacity
    middle = float(np.median(scales[good]))
    if scales[good].min() > 0 and (middle < LEAST_LOG or np.exp(middle) > _largest(means[good])):
        scales = np.log(scales)
        notes.append("scales are lengths, not their logarithms, as all are positive; the map holds logarithms")
    if (sizes := np.abs(opacity[good].astype(np.float64))).max() <= 1 + ABOVE:
        signed = ", by their absolute values" if opacity[good].min() < 0 else ""
        clipped = np.full(len(opacity), np.nan)
        clipped[good] = np.clip(sizes, 1e-6, 1 - 1e-6)
        opacity = np.log(clipped / (1 - clipped)).astype(np.float32)
        notes.append(f"opacities are in [0, 1]{signed}, not logits; the map holds logits")
    if scales.shape[1] == 2:
        scales = np.column_stack([scales, scales.min(axis=1) + np.float32(np.log(FLAT))])
        notes.append("Gaussians are discs: there is no scale_2")
    return scales, opacity


def _largest(means: np.ndarray) -> float:
    """The largest σ that is likely in the median, of Gaussians with means [N, 3]."""
    low, high = np.percentile(means, [5, 95], axis=0)
    some = means[:: -(-len(means) // SOME)]
    apart = cKDTree(means).query(some, k=2)[0][:, 1]
    spacing = float(np.median(apart[apart > 0])) if (apart > 0).any() else np.inf
    return min(LINEAR_SHARE * max(float((high - low).max()), 1e-12), LINEAR_SPACING * spacing)


def _filtered(scales: np.ndarray, opacity: np.ndarray, sigma: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Log-scales [N, 3] and opacity logits [N] with Mip-Splatting's 3D smoothing filter σ_f [N] (Yu et al. 2024,
    equation 9): covariances grow by σ_f², and opacities shrink by √(|Σ| / |Σ + σ_f² I|)."""
    with np.errstate(all="ignore"):  # rows that are no numbers are parked
        variances = np.exp(2 * scales.astype(np.float64))
        wider = variances + sigma.astype(np.float64)[:, None] ** 2
        share = np.sqrt((variances / wider).prod(axis=1)) / (1 + np.exp(-opacity.astype(np.float64)))
        share = np.clip(share, 1e-6, 1 - 1e-6)
        return (np.log(wider) / 2).astype(np.float32), np.log(share / (1 - share)).astype(np.float32)


def _compressed(rows: Mapping[str, np.ndarray]) -> Splat:
    """SuperSplat's compressed PLY: values of 8 to 11 bits between the bounds of CHUNK rows each."""
    chunk = np.arange(len(rows["packed_position"])) // CHUNK

    def bits(name: str, shift: int, width: int) -> np.ndarray:
        return (rows[f"packed_{name}"] >> np.uint32(shift) & np.uint32((1 << width) - 1)) / np.float64((1 << width) - 1)

    def between(name: str, share: np.ndarray) -> np.ndarray:
        if f"min_{name}" not in rows:  # colours of older files
            return share
        low, high = rows[f"min_{name}"][chunk].astype(np.float64), rows[f"max_{name}"][chunk]
        return np.asarray(low + share * (high - low))

    parts = ((21, 11), (11, 10), (0, 11))
    means = np.stack([between(a, bits("position", *p)) for a, p in zip("xyz", parts, strict=True)], axis=1)
    scales = np.stack([between(f"scale_{a}", bits("scale", *p)) for a, p in zip("xyz", parts, strict=True)], axis=1)
    colors = np.stack([between(c, bits("color", s, 8)) for c, s in zip("rgb", (24, 16, 8), strict=True)], axis=1)
    opacity = np.clip(bits("color", 0, 8), 1e-4, 1 - 1e-4)
    smaller = np.stack([(bits("rotation", s, 10) - 0.5) * np.sqrt(2) for s in (20, 10, 0)], axis=1)
    quats = _of_smallest(rows["packed_rotation"] >> np.uint32(30), smaller)
    width = sum(name.startswith("f_rest_") for name in rows)
    rest = np.empty((len(means), width), np.float32)
    for i in range(width):
        byte = rows[f"f_rest_{i}"]
        share = np.where(byte == 0, 0, np.where(byte == 255, 1, (byte + 0.5) / 256))
        rest[:, i] = 8 * (share - 0.5)
    sh = np.concatenate([sh_from_rgb(colors)[:, None], rest.reshape(len(means), 3, -1).transpose(0, 2, 1)], axis=1)
    arrays = (means, quats, scales, np.log(opacity / (1 - opacity)), sh)
    means, quats, scales, logits, sh = (np.ascontiguousarray(array, np.float32) for array in arrays)
    return Splat(means, quats, scales, logits, sh, notes=["compressed PLY: values are rounded"])


def _of_smallest(largest: np.ndarray, smaller: np.ndarray) -> np.ndarray:
    """Unit quaternions [N, 4], of the index [N] of the largest component and the other three [N, 3] in order."""
    quats = np.empty((len(smaller), 4))
    quats[:, 1:] = smaller
    left = np.sqrt(np.maximum(0, 1 - (smaller**2).sum(axis=1)))
    for i in range(4):
        own = largest == i
        quats[own] = np.insert(smaller[own], i, left[own], axis=1)
    return quats


def _parked(path: Path, splat: Splat) -> Splat:
    """`splat` with the rows that cannot be drawn parked. InputError where few are left, or all lie in one place."""
    bad = np.isnan(splat.opacity_logits)
    for values in (splat.means, splat.quats):
        bad |= ~np.isfinite(values).all(axis=1)
    bad |= (np.isnan(splat.log_scales) | (splat.log_scales == np.inf)).any(axis=1)
    bad |= ~np.isfinite(splat.sh).all(axis=(1, 2))
    good = np.flatnonzero(~bad)
    if len(good) < LEAST_ROWS or not (np.ptp(splat.means[good], axis=0) > 0).any():
        what = f"{len(good)} of {len(splat)} rows are numbers" if len(good) < LEAST_ROWS else "all lie in one place"
        raise InputError(f"{path}: is one blob or damaged ({what}); expected a scene of Gaussians with finite values")
    if bad.any():
        for name, values in splat.arrays().items():
            values[bad] = PARKED if name == "opacity_logits" else values[good[0]]
        splat.notes.append(f"{int(bad.sum())} Gaussians that are not finite are kept in their rows and never drawn")
    return Splat(**splat.arrays(), parked=bad, notes=splat.notes)
