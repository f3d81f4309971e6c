"""Shape scores: how well each instance's geometry fits a floor, wall, ceiling, picture, rug, table, ball or box.

An image classifier does not recognise walls and floors, but a map has geometry: the up direction, level and upright
planes, the lowest surface, flat objects on a wall. All lengths are relative to the scene's own, so no metric scale is
needed. ramp(x; p, q) rises linearly from 0 at p to 1 at q; [·] is 1 if true, else 0. Of each instance:

    n, z, a, t: normal, height of the centre, covered area and thickness of its best plane; h: from low to high
    top, s, rests: height and share of points of its fullest horizontal slab, and the number of smaller objects on it
    gap: distance to the nearest parallel wall

Of the scene:

    span: height of all instances together; e: median height of the cameras
    a_max, a_up, a_typ: largest area, largest upright area, typical area
    ground: height of the lowest large level plane, if nothing lies much lower

Scores:

    flat = ramp(t; .35, .2)   level = flat ramp(|n_z|; .85, .95)   upright = flat ramp(|n_z|; .3, .15)
    wall = upright ramp(a / a_up; .15, .35) ramp(a / a_max; .05, .15) ramp(h; .2 span, .4 span)
    picture = upright (1 − wall) ramp(gap / span; .1, .05)
    floor = level [at the ground] a / (largest a of those): a floor may be in pieces
    rug = level [on the ground, not the largest] ramp(a; a_typ, 2 a_typ); ½ for the largest, which may be carpeted
    ceiling = level ramp(z; e, e + .1 span) ramp(a; .1 a_max, .3 a_max)
    table = [upright < ½] ramp(s; .25, .45) ramp(a; a_typ, 3 a_typ) (½ + ½ ramp(rests; 0, 2))
            · ramp(top; e + .05 span, e − .05 span) · ramp(top; ground + .05 span, ground + .12 span)
    ball: see `roundness`   box: see `boxiness`

A table top seen from close by can look like a floor. The floor therefore gets half a table score, whatever its height.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from perception.frame.gravity import Gravity, up_from_cameras
from perception.geometry import camera_centres
from perception.language.shape_words import KINDS

SAMPLES = 1000  # points used per instance
LEAST = 20  # points; instances with fewer get no scores


@dataclass(frozen=True)
class Body:
    """Points [P, 3] of an instance without outliers, in a frame with z up, and measures of them (see the module)."""

    points: np.ndarray
    center: np.ndarray
    normal: np.ndarray
    thickness: float
    area: float
    low: float
    high: float
    top: float
    top_share: float
    footprint: np.ndarray  # low and high corner [2, 2] of the slab's bounding rectangle


def shape_scores(
    means: np.ndarray,
    instance_ids: np.ndarray,
    wanted: list[int],
    camera_from_world: np.ndarray,
    gravity: Gravity | None = None,
) -> np.ndarray:
    """Shape scores of the instances `wanted` for each of shape_words.KINDS: [I, K] in [0, 1].

    means [N, 3], instance_ids [N]; camera_from_world [C, 4, 4]. gravity: of the map, if recorded. If the
    up direction is unknown, only "ball" is scored.
    """
    scores = np.zeros((len(wanted), len(KINDS)))
    up = up_from_cameras(camera_from_world) if gravity is None else -gravity.direction
    frame = level_frame(np.array([0.0, 0.0, 1.0]) if up is None else up)
    measured = [measure(means[instance_ids == i] @ frame.T) for i in wanted]
    rows = [n for n, body in enumerate(measured) if body is not None]
    bodies = [body for body in measured if body is not None]
    if not bodies:
        return scores
    found = {"ball": np.array([roundness(body.points) for body in bodies])}
    if up is not None:
        found["box"] = np.array([boxiness(body.points) for body in bodies])
        found |= room_scores(bodies, float(np.median((camera_centres(camera_from_world) @ frame.T)[:, 2])))
    for kind, values in found.items():
        scores[rows, KINDS.index(kind)] = values
    return scores


def level_frame(up: np.ndarray) -> np.ndarray:
    """A rotation [3, 3] whose third row is the up direction."""
    side = np.eye(3)[int(np.argmin(np.abs(up)))]
    x = np.cross(up, side)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(up, x), up])


def measure(points: np.ndarray) -> Body | None:
    """A Body from points [P, 3] in a frame with z up; None for fewer than LEAST points.

    thickness = Q(n) / √(Q(u) Q(v)), Q: interquartile range along the plane's normal n and its axes u, v.
    area: see `covered_area`.
    """
    if len(points) < LEAST:
        return None
    points = points[:: max(1, len(points) // SAMPLES)].astype(np.float64)
    low, high = np.percentile(points, [2, 98], axis=0)
    margin = 0.05 * (high - low) + 1e-9
    points = points[((points >= low - margin) & (points <= high + margin)).all(axis=1)]
    center = np.median(points, axis=0)
    normal = plane_normal(points)
    in_plane = level_frame(normal)
    local = (points - center) @ in_plane.T
    spread = np.percentile(local, 75, axis=0) - np.percentile(local, 25, axis=0)
    thickness = spread[2] / max(float(np.sqrt(spread[0] * spread[1])), 1e-9)
    top, share, footprint = _slab(points)
    area = covered_area(local[:, :2])
    return Body(points, center, normal, float(thickness), area, float(low[2]), float(high[2]), top, share, footprint)


def covered_area(flat: np.ndarray) -> float:
    """Area of the square cells that hold points [P, 2] of a plane, without the outer 3 %: of a strip along two walls
    its own, not that of its rectangle. Evenly spread points have 3 in a cell."""
    low, high = np.percentile(flat, [3, 97], axis=0)
    rectangle = float((high - low).prod())
    side = max(np.sqrt(3 * rectangle / len(flat)), 1e-9)
    kept = flat[((flat >= low) & (flat <= high)).all(axis=1)]
    return min(rectangle, float(len(np.unique(np.floor((kept - low) / side), axis=0)) * side**2))


def roundness(points: np.ndarray) -> float:
    """1 for points x [P, 3] on a sphere or most of one, 0 for other shapes.

    Least-squares sphere (o, r):  2 x · o + (r² − |o|²) = |x|²;  then
    ramp(smallest extent / 2r; .6, .8) · ramp(mean | |x − o| − r | / r; .10, .05)
    """
    rows = np.concatenate([2 * points, np.ones((len(points), 1))], axis=1)
    solution, *_ = np.linalg.lstsq(rows, (points**2).sum(axis=1), rcond=None)
    radii = np.linalg.norm(points - solution[:3], axis=1)
    radius = float(np.median(radii))
    size = np.percentile(points, 97, axis=0) - np.percentile(points, 3, axis=0)
    whole = ramp(float(size.min()) / max(2 * radius, 1e-9), 0.6, 0.8)  # a shallow cap of a large sphere is not a ball
    return whole * ramp(float(np.abs(radii - radius).mean()) / max(radius, 1e-9), 0.10, 0.05)


def boxiness(points: np.ndarray) -> float:
    """1 for points [P, 3] on the faces of an upright box (z up), 0 for round or irregular shapes.

    Uses the upright bounding box with the smallest ground area, with rotations in steps of 5° and sides S:
    ramp(mean distance to the nearest face / √(min S · median S); .11, .06) · ramp(share near upright edges; .02, .08)
    """
    best = None
    for angle in np.radians(np.arange(0, 90, 5)):
        c, s = np.cos(angle), np.sin(angle)
        turned = points @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
        low, high = np.percentile(turned, [2, 98], axis=0)
        size = np.maximum(high - low, 1e-9)
        if best is None or size[0] * size[1] < best[0]:
            best = (size[0] * size[1], turned, low, high, size)
    assert best is not None
    _, turned, low, high, size = best
    inside = np.minimum(turned - low, high - turned)  # distance to the nearer of the two faces along each axis
    nearest = np.abs(inside / np.sqrt(size.min() * np.median(size))).min(axis=1)
    corners = np.abs(inside[:, :2] / size[:2]).max(axis=1) < 0.12  # a box has upright edges, a cylinder has none
    return ramp(float(nearest.mean()), 0.11, 0.06) * ramp(float(corners.mean()), 0.02, 0.08)


def ramp(x: Any, zero: Any, one: Any) -> Any:
    """0 at `zero`, 1 at `one`, linear between, clamped outside; a step where they are equal. Numbers or arrays."""
    return np.clip((x - zero) / np.where(one == zero, 1e-9, one - zero), 0.0, 1.0)


def room_scores(bodies: list[Body], e: float) -> dict[str, np.ndarray]:
    """Scores [B] of the kinds that depend on the other instances. e: median height of the cameras."""
    n_z = np.abs([body.normal[2] for body in bodies])
    z = np.array([body.center[2] for body in bodies])
    t, a, low, high, top, s = (
        np.array([getattr(body, name) for body in bodies])
        for name in ("thickness", "area", "low", "high", "top", "top_share")
    )
    flat = ramp(t, 0.35, 0.2)
    level, upright = flat * ramp(n_z, 0.85, 0.95), flat * ramp(n_z, 0.3, 0.15)
    span = high.max() - low.min() + 1e-9
    a_max, a_up = a.max(), max(a[upright > 0.5].max(initial=0.0), 1e-9)
    a_typ = min(float(np.median(a)), 0.03 * a_max)
    ground = z[(level > 0.5) & (z < e) & (a > 0.1 * a_max)].min(initial=np.inf)
    if ground > float(np.percentile(np.concatenate([body.points[:, 2] for body in bodies]), 2)) + 0.1 * span:
        ground = np.inf  # something lies lower: this is a table top, and the floor is not in the map
    known = bool(np.isfinite(ground))
    at_ground = (level > 0.5) & (z < ground + 0.05 * span) & known
    floor = at_ground & (np.arange(len(a)) == np.where(at_ground, a, -1).argmax())
    on_ground = known & ~floor & (high < ground + 0.08 * span) & (a < 0.8 * a_max)
    walls = [body for body, u, area in zip(bodies, upright, a, strict=True) if u > 0.5 and area >= 0.3 * a_up]
    gap = np.array([min((_gap(body, w) for w in walls if w is not body), default=np.inf) for body in bodies])
    rests = np.array([sum(_rests_on(other, body, span) for other in bodies if other is not body) for body in bodies])
    raised = np.where(floor, 0.5, ramp(top, ground + 0.05 * span, ground + 0.12 * span) if known else 1.0)
    wall = upright * ramp(a / a_up, 0.15, 0.35) * ramp(a / a_max, 0.05, 0.15) * ramp(high - low, 0.2 * span, 0.4 * span)
    table = ramp(s, 0.25, 0.45) * ramp(a, a_typ, 3 * a_typ) * (0.5 + 0.5 * ramp(rests, 0, 2))
    return {
        "wall": wall,
        "picture": upright * (1 - wall) * ramp(gap / span, 0.1, 0.05),
        "floor": level * at_ground * a / max(a[floor].max(initial=0.0), 1e-9),
        "rug": level * np.where(floor, 0.5, on_ground * ramp(a, a_typ, 2 * a_typ)),
        "ceiling": level * ramp(z, e, e + 0.1 * span) * ramp(a, 0.1 * a_max, 0.3 * a_max),
        "table": (upright < 0.5) * table * ramp(top, e + 0.05 * span, e - 0.05 * span) * raised,
    }


def plane_normal(points: np.ndarray) -> np.ndarray:
    """Normal of the dominant plane of points: principal axes, refitted twice to the points nearest to the plane."""
    kept = points
    normal = np.array([0.0, 0.0, 1.0])
    for _ in range(3):
        middle = kept.mean(axis=0)
        _, axes = np.linalg.eigh((kept - middle).T @ (kept - middle))
        normal = axes[:, 0]
        apart = np.abs((points - middle) @ normal)
        kept = points[apart <= np.percentile(apart, 80)]
    return normal


def _slab(points: np.ndarray) -> tuple[float, float, np.ndarray]:
    """Height of the horizontal slab with the most points, its share of the points, its bounding rectangle [2, 2]."""
    heights = np.sort(points[:, 2])
    thin = 0.04 * float(np.linalg.norm(np.ptp(points, axis=0))) + 1e-9
    counts = np.searchsorted(heights, heights + thin, side="right") - np.arange(len(heights))
    start = int(counts.argmax())
    held = points[(points[:, 2] >= heights[start]) & (points[:, 2] <= heights[start] + thin)]
    rectangle = np.percentile(held[:, :2], [3, 97], axis=0)
    return float(np.median(held[:, 2])), float(counts[start] / len(points)), rectangle


def _rests_on(upper: Body, lower: Body, span: float) -> bool:
    """Whether a smaller body stands on the top slab of `lower`."""
    inside = ((upper.center[:2] > lower.footprint[0]) & (upper.center[:2] < lower.footprint[1])).all()
    return bool(inside and upper.area < lower.area and abs(upper.low - lower.top) < 0.06 * span)


def _gap(body: Body, wall: Body) -> float:
    """Distance of a body's centre from a wall's plane if both are parallel, else infinity."""
    if abs(float(body.normal @ wall.normal)) < 0.95:
        return float("inf")
    return float(abs((body.center - wall.center) @ wall.normal))
