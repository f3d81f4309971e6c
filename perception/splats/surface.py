"""What of a finished Gaussian scene is surface: floaters and haze told by their neighbours, and which way is up."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from perception.errors import InputError
from perception.frame.gravity import Gravity
from perception.geometry import rotations
from perception.splats.read import PARKED, Splat

OPAQUE = 0.3
"""Opacity from which a Gaussian is evidence of a surface for its neighbours."""
NEIGHBOURS, APART, ALONE = 8, 6.0, 4.0
"""A Gaussian is hidden if its NEIGHBOURS-th opaque neighbour is farther than APART times its own largest σ and ALONE
times the median of that distance: specks in the air are smaller groups, and a wall's Gaussians are as large as their
distances."""
LARGEST = 10.0
"""Multiple of the median σ that counts as a Gaussian's own: no veil vouches for itself."""
SAMPLE = 60_000
"""Gaussians that gravity is found by."""
LEVEL = np.cos(np.radians(10))
"""Cosine of the angle up to which a flat Gaussian is parallel to a plane."""
SLAB = 0.015
"""Half the thickness of a floor, in extents of the scene."""
GUESSED, FOUND = 20.0, 2.0
"""Standard error in degrees of a direction taken from the file's convention, and of one found by a floor."""


@dataclass(frozen=True)
class Surface:
    """hidden [N] bool: rows that are floaters, haze, or parked. up [3]: unit vector. gravity: as `map` records it."""

    hidden: np.ndarray
    gravity: Gravity

    @property
    def up(self) -> np.ndarray:
        return -self.gravity.direction


def surface_of(splat: Splat, up: str | None = None) -> Surface:
    """The surface of a scene; up: as `direction` reads it, None finds it."""
    hidden = floaters(splat) | splat.parked
    gravity = gravity_of(splat, hidden) if up is None else Gravity(-direction(up), 0.0, f"--up {up}")
    return Surface(hidden, gravity)


def hide(splat: Splat, hidden: np.ndarray) -> np.ndarray:
    """Opacity logits [N] with which hidden rows are never drawn."""
    return np.where(hidden, np.float32(PARKED), splat.opacity_logits)


def direction(text: str) -> np.ndarray:
    """The unit vector [3] of x, -y, +z, …, or of three numbers with commas between them."""
    axis = text.strip().lower().lstrip("+-")
    try:
        if axis in ("x", "y", "z"):
            return np.eye(3)["xyz".index(axis)] * (-1 if text.strip().startswith("-") else 1)
        vector = np.array([float(part) for part in text.split(",")])
        if vector.shape == (3,) and np.isfinite(vector).all() and (length := float(np.linalg.norm(vector))) > 0:
            return np.asarray(vector / length)
    except ValueError:
        pass
    raise InputError(f"--up: found '{text}', expected an axis such as z or -y, or three numbers such as 0,-0.9,0.1")


def floaters(splat: Splat) -> np.ndarray:
    """[N] bool: Gaussians without enough opaque ones around them (see NEIGHBOURS)."""
    opaque = np.flatnonzero((splat.opacity_logits > np.log(OPAQUE / (1 - OPAQUE))) & ~splat.parked)
    if len(opaque) <= NEIGHBOURS:
        return np.zeros(len(splat), bool)
    tree = cKDTree(splat.means[opaque])
    distance = tree.query(splat.means, NEIGHBOURS + 1, workers=-1)[0][:, NEIGHBOURS].astype(np.float32)
    sigma = np.exp(splat.log_scales.max(axis=1))
    own = np.minimum(sigma, LARGEST * np.median(sigma[opaque]))
    return np.asarray(distance > np.maximum(APART * own, ALONE * np.median(distance[opaque])))


def flat(splat: Splat, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Normals [M, 3] of the Gaussians `rows`, along their smallest σ, and weights [M]: the opaque areas of the others,
    times how flat they are."""
    scales = np.exp(splat.log_scales[rows].astype(np.float64))
    order = np.argsort(scales, axis=1, kind="stable")
    axes = rotations(splat.quats[rows])
    normals = np.take_along_axis(axes, order[:, None, :1], axis=2)[:, :, 0]
    small, middle, large = np.take_along_axis(scales, order, axis=1).T
    opacity = 1 / (1 + np.exp(-np.clip(splat.opacity_logits[rows].astype(np.float64), -80, 80)))
    return normals, opacity * middle * large * (1 - small / np.maximum(middle, 1e-300))


def sampled(rows: np.ndarray, most: int) -> np.ndarray:
    """At most about `most` of `rows`, evenly."""
    return rows[:: -(-len(rows) // most)] if len(rows) else rows


def gravity_of(splat: Splat, hidden: np.ndarray) -> Gravity:
    """Which way is down: the scene rests on its floor, so candidates are the normals of its large planes, turned such
    that least of the scene lies beyond, and the convention of the files, whose y points down.

    A candidate u has the evidence S − 2 B + A: S the share of opaque area in the best slab across u among the level
    Gaussians, B the share of all area below that slab, and A half the share by which more Gaussians lie in
    the lower half of the heights than in the upper: things stand on floors, and ceilings are bare.
    """
    rows = sampled(np.flatnonzero(~hidden), SAMPLE)
    normals, areas = flat(splat, rows)
    means = splat.means[rows].astype(np.float64)
    areas = np.minimum(areas, np.quantile(areas, 0.999))
    areas /= max(float(areas.sum()), 1e-300)
    convention = np.array([0.0, -1.0, 0.0])
    found = [(evidence(convention, means, normals, areas), convention)]
    for plane in planes(normals, areas):
        found += [(evidence(up, means, normals, areas), up) for up in (plane, -plane)]
    best, up = max(found, key=lambda each: each[0])
    if best <= 0.05:
        return Gravity(-convention, GUESSED, "the usual axes of such files: no floor was found; --up gives it")
    return Gravity(-up, FOUND, f"the floor of the scene (evidence {best:.2f})")


def planes(normals: np.ndarray, areas: np.ndarray, most: int = 6) -> list[np.ndarray]:
    """The main directions [3] of normals [M, 3], of either sign, weighted by areas [M], largest first."""
    left, found = areas.copy(), list[np.ndarray]()
    trial = normals[np.argsort(-areas, kind="stable")[:400]]
    while len(found) < most and left.sum() > 0.05 * areas.sum():
        close = np.abs(trial @ normals.T) > LEVEL
        start = trial[int((close * left).sum(axis=1).argmax())]
        for _ in range(5):
            cosine = normals @ start
            weights = left * (np.abs(cosine) > LEVEL) * np.sign(cosine)
            if not weights.any():
                return found
            start = (weights[:, None] * normals).sum(axis=0)
            start = start / np.linalg.norm(start)
        found.append(start)
        left[np.abs(normals @ start) > LEVEL] = 0
    return found


def evidence(up: np.ndarray, means: np.ndarray, normals: np.ndarray, areas: np.ndarray) -> float:
    """See `gravity_of`. areas [M] sum to 1."""
    height = means @ up
    low, high = np.quantile(height, [0.02, 0.98])
    if high <= low:
        return 0.0
    level = np.flatnonzero((np.abs(normals @ up) > LEVEL) & (height < (low + high) / 2))
    level = level[np.argsort(height[level], kind="stable")]
    if len(level) == 0:
        return -1.0
    total = np.append(0, np.cumsum(areas[level]))
    end = np.searchsorted(height[level], height[level] + 2 * SLAB * (high - low), side="right")
    slab = total[end] - total[:-1]
    below = np.append(0, np.cumsum(areas[np.argsort(height, kind="stable")]))
    under = below[np.searchsorted(np.sort(height), height[level] - SLAB * (high - low))]
    lower = float(np.mean(height < (low + high) / 2))
    return float((slab - 2 * under).max()) + lower - 0.5
