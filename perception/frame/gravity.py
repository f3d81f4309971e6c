"""The direction of gravity in a scene, from how its cameras were held and from its large planes, with its error.

People hold cameras level, floors and tables are level, walls are upright. With d the down direction, x_i the x axis of
camera i, n_k the normal of plane k, and c a roll that all cameras share (mounting, habit):

    x_i · d = c ± roll     n_k × d = 0 ± tilt (level planes)     n_k · d = 0 ± tilt (walls)     c = 0 ± 1°

solved by iteratively reweighted least squares (Huber weights) in the tangent plane of d.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

LEVEL = 0.12  # largest mean square of the sine of the cameras' roll at which they count as level
POINTS, TRIPLES, PLANES = 4000, 3000, 6  # points that RANSAC counts, its samples per plane, largest number of planes
THICKNESS, LEAST_SHARE = 0.01, 0.05  # of a plane: half its thickness in extents of the scene, least share of the points
NEAR = np.radians([12, 30])  # angle between a level plane or a wall and the first estimate: least and largest bound
TILT, SHARED_ROLL, PITCH, BEND = np.radians([1.2, 1.0, 20.0, 0.8])
"""Standard deviations: of floors, tables and walls from level and upright in reconstructions of real rooms; of the
shared roll; of the cameras' mean y axis from down; of the reconstruction's bend, which all planes have in common."""
BEFORE, CLUTTER = 3.0, 1.5
"""Planes whose spread TILT is taken to be, beside those found. Standard error of a plane that has as many points on its
sides as in it, in half thicknesses over its width: a slab of clutter has any direction. Chosen on a real kitchen."""
CONFIDENT = 3.0
"""Largest standard error in degrees at which a map is turned by its gravity."""


@dataclass(frozen=True)
class Gravity:
    """direction [3]: unit vector down in the scene's frame. standard_error: of its angle, degrees. source: as text."""

    direction: np.ndarray
    standard_error: float
    source: str

    @property
    def confident(self) -> bool:
        return self.standard_error <= CONFIDENT

    def to_json(self) -> dict[str, Any]:
        return {"direction": self.direction.tolist(), "source": self.source, "standard_error_deg": self.standard_error}

    @classmethod
    def from_json(cls, entry: dict[str, Any]) -> Gravity:
        return cls(np.array(entry["direction"], np.float64), float(entry["standard_error_deg"]), str(entry["source"]))


def up_from_cameras(camera_from_world: np.ndarray) -> np.ndarray | None:
    """The up direction [3] in the world frame, from poses [C, 4, 4]; None when the cameras were not held level.
    The x axes of level cameras are horizontal, so up is the direction of their smallest mean squared component."""
    if len(camera_from_world) < 3:
        return None
    right, down = camera_from_world[:, 0, :3], camera_from_world[:, 1, :3]
    values, vectors = np.linalg.eigh(right.T @ right / len(right))
    up = vectors[:, 0]
    if values[1] < 2 * values[0] + 1e-3:  # a path without turns: all x axes are parallel
        up = -down.mean(axis=0)
        up /= max(float(np.linalg.norm(up)), 1e-9)
    if float(((right @ up) ** 2).mean()) > LEVEL or abs(float((down @ up).mean())) < 0.3:
        return None
    return up if (down @ up).mean() < 0 else -up


def gravity_of_scene(camera_from_world: np.ndarray, points: np.ndarray, seed: int = 0) -> Gravity | None:
    """Gravity from poses [C, 4, 4] and scene points [P, 3]; None when the cameras were not held level."""
    up = up_from_cameras(camera_from_world)
    if up is None:
        return None
    x, y = np.asarray(camera_from_world[:, :2, :3], np.float64).transpose(1, 0, 2)
    guess = y.mean(axis=0) / np.linalg.norm(y.mean(axis=0))
    down, error = _solved(-up, guess, x, [], [])
    level, walls = _planes(points, down, float(np.clip(2 * error, *NEAR)), seed)
    down, error = _solved(down, guess, x, level, walls)
    source = f"roll of {len(x)} cameras, {len(level)} level planes, {len(walls)} walls"
    return Gravity(down, float(np.degrees(np.hypot(error, BEND))), source)


def _solved(
    down: np.ndarray, guess: np.ndarray, x: np.ndarray, level: list[Plane], walls: list[Plane]
) -> tuple[np.ndarray, float]:
    """Down, from a first estimate, and its standard error in radians. guess: mean y axis of the cameras."""
    tilt, priors = TILT, len(x) + 3
    for _ in range(12):
        tangent = np.linalg.svd(down[None])[2][1:]  # rows a, b: down + p a + q b, shared roll c are the unknowns
        rows = [
            (np.c_[x @ tangent.T, -np.ones(len(x))], -x @ down, np.full(len(x), _standard_error_of_roll(x @ down))),
            (np.array([[0.0, 0, 1]]), np.zeros(1), np.array([SHARED_ROLL])),
            (np.eye(3)[:2], tangent @ guess, np.full(2, PITCH)),
        ]
        for normal, sigma in level:
            normal = normal * np.sign(normal @ down)
            rows.append((np.eye(3)[:2], tangent @ normal / (normal @ down), np.full(2, np.hypot(tilt, sigma))))
        for normal, sigma in walls:
            row = np.r_[tangent @ normal, 0.0][None]
            rows.append((row, np.array([-normal @ down]), np.array([np.hypot(tilt, sigma)])))
        A, b, sigmas = (np.concatenate(parts) for parts in zip(*rows, strict=True))
        A, b = A / sigmas[:, None], b / sigmas
        weights = np.ones(len(b))
        for _ in range(10):
            step = np.linalg.solve(A.T @ (weights[:, None] * A), A.T @ (weights * b))
            errors = np.abs(A @ step - b)
            weights = 2.0 / np.maximum(errors, 2.0)  # Huber
        down = down + step[:2] @ tangent
        down /= np.linalg.norm(down)
        off = (errors * sigmas)[priors:]  # of the planes; TILT counts as the spread of BEFORE others
        tilt = float(np.sqrt((BEFORE * TILT**2 + off @ off) / (BEFORE + len(off))))
    covariance = np.linalg.inv(A.T @ (weights[:, None] * A))[:2, :2]
    return down, float(np.sqrt(np.trace(covariance)))


def _standard_error_of_roll(rolls: np.ndarray) -> float:
    """Of each of N rolls, such that their mean has the right error: neighbours in time are alike.
    Their spread times √(N / (n − 2)), n = N (1 − r) / (1 + r) independent rolls, from which two numbers are estimated;
    r: correlation of neighbours (first-order autoregression)."""
    off = rolls - np.median(rolls)
    r = np.clip(float(off[1:] @ off[:-1]) / max(float(off @ off), 1e-12), 0, 0.95)
    spread = np.clip(1.4826 * np.median(np.abs(off)), np.radians(0.5), np.radians(10))
    n = max(len(rolls) * (1 - r) / (1 + r), 2.5)
    return float(spread * np.sqrt(len(rolls) / (n - 2)))


Plane = tuple[np.ndarray, float]
"""Unit normal [3] and the standard error of its direction in radians."""


def _planes(points: np.ndarray, down: np.ndarray, near: float, seed: int) -> tuple[list[Plane], list[Plane]]:
    """The level planes and the walls of a scene, at most `near` (radians) from a first estimate; sequential RANSAC."""
    rng = np.random.default_rng(seed)
    rest = np.asarray(points, np.float64)
    if len(rest) < 100:
        return [], []
    rest = rest[np.sort(rng.permutation(len(rest))[:POINTS])]
    extent = float(np.median(np.linalg.norm(rest - np.median(rest, axis=0), axis=1)))
    found: tuple[list[Plane], list[Plane]] = ([], [])
    least = LEAST_SHARE * len(rest)
    for _ in range(PLANES):
        if len(rest) < max(least, 50) or extent == 0:
            break
        a, b, c = rest[rng.integers(len(rest), size=(3, TRIPLES))]
        normals = np.cross(b - a, c - a)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
        cosine = np.abs(normals @ down)
        close = (cosine > np.cos(near)) | ((cosine < np.sin(near)) & (np.linalg.norm(normals, axis=1) > 0.5))
        if not close.any():
            break
        normals, a = normals[close], a[close]
        inside = np.abs(rest @ normals.T - (normals * a).sum(axis=1)) < THICKNESS * extent
        best = int(inside.sum(axis=0).argmax())
        mine = inside[:, best]
        for _ in range(3):
            if mine.sum() < max(least, 30):
                break
            middle = rest[mine].mean(axis=0)
            singular, axes = np.linalg.svd(rest[mine] - middle, full_matrices=False)[1:]
            mine = np.abs((rest - middle) @ axes[2]) < THICKNESS * extent
        if mine.sum() < max(least, 30):
            break
        around = np.abs((rest - middle) @ axes[2]) < 2 * THICKNESS * extent
        # Over all points that are left, not its own: a plane of few of them counts as narrower. CLUTTER is for that.
        _, width, deviation = singular / np.sqrt(len(rest))
        width = max(width, 1e-12)
        # slope of a line fitted to N points of deviation s over a width e: s / (e √N); errors of neighbours correlate
        error = float(2 * deviation / width / np.sqrt(mine.sum()))
        error += CLUTTER * (around.sum() / mine.sum() - 1) * THICKNESS * extent / width
        cosine = abs(float(axes[2] @ down))
        if cosine > np.cos(near) or cosine < np.sin(near):
            found[0 if cosine > 0.5 else 1].append((axes[2], error))
        rest = rest[~mine]
    return found


def floor_height(up: np.ndarray, points: np.ndarray, eye: np.ndarray) -> float:
    """Height along `up` of the floor below a camera at `eye` [3]: the lowest level slab that holds many points.
    Without such a slab it is the height that 1 % of the points lie below, at most that of the camera; without points
    below the camera it is the camera's."""
    heights = np.sort(np.asarray(points, np.float64) @ up)
    below = heights[heights < eye @ up]
    if len(below) < 30:
        return float(eye @ up)
    low, high = np.percentile(heights, [1, 99])
    slab = 2 * THICKNESS * (high - low) + 1e-12
    counts = np.searchsorted(below, below + slab) - np.arange(len(below))
    many = np.flatnonzero(counts >= max(LEAST_SHARE * len(heights) / 2, 0.5 * counts.max()))
    if len(many) == 0:
        return float(min(low, eye @ up))
    first = many[0]
    end = first + counts[first : first + counts[first]].argmax()
    return float(np.median(below[end : end + counts[end]]))
