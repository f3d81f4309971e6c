"""Shape scores: fit of each instance's geometry to a floor, wall, ceiling, picture, rug, table, ball or box.

An image classifier does not recognise walls and floors, but a map has geometry: the up direction, level and upright
planes, the lowest surface, flat objects on a wall. No metric scale is needed: lengths are relative to `span`, the
height of all instances together, and areas to the largest or the typical one. A score is a product of ramps: each
pair of constants below is where a ramp is 0 and where it is 1.

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
CERTAIN = 0.5  # score from which an instance counts as level or upright for the scores of others

# Planes. Thickness: see `measure`; the others are |z| of the unit normal.
FLAT = 0.35, 0.20  # thickness: walls with frames and rugs with folds are flat, chairs are not
LEVEL = 0.85, 0.95  # tilted by 32° and 18°
UPRIGHT = 0.30, 0.15  # leaning by 17° and 9°
PARALLEL = 0.95  # cosine of the angle between the planes of a picture and its wall: 18°

# The floor. Heights in spans above the ground, the lowest large level plane.
GROUND_AREA = 0.1  # of the largest area: what is smaller, such as a box's top, is no ground
LOWER_THINGS = 0.1  # spans that the ground may lie above the lowest points; more: it is a table top
AT_GROUND = 0.05  # centre of a floor in pieces: errors of a map bend it
ON_GROUND = 0.08  # highest point of a rug
LARGEST_RUG = 0.8  # of the largest area; more is the floor itself
CARPET = 0.5  # rug score of the floor, which may be carpeted

# Walls, pictures, ceilings
WALL_OF_UPRIGHT = 0.15, 0.35  # area / largest upright one: cupboards are smaller
WALL_OF_LARGEST = 0.05, 0.15  # area / largest: where no wall is in the map, the largest upright thing is none
WALL_HEIGHT = 0.2, 0.4  # low to high, in spans: a sofa's back is lower
NEAR_WALL = 0.1, 0.05  # distance of a picture from a wall's plane, in spans
WALL_OF_PICTURE = 0.3  # area / largest upright one, from which a plane can carry pictures
ABOVE_EYES = 0.0, 0.1  # height of a ceiling above the cameras, in spans
CEILING_AREA = 0.1, 0.3  # area / largest: shelves are smaller

# Rugs and tables. The typical area is the median, at most LARGEST_TYPICAL of the largest one.
LARGEST_TYPICAL = 0.03
RUG_AREA = 1.0, 2.0  # area / typical
TABLE_AREA = 1.0, 3.0  # area / typical
TABLE_SLAB = 0.25, 0.45  # share of points in the fullest horizontal slab: the top, seen better than the legs
TABLE_BELOW_EYES = 0.05, -0.05  # height of the top above the cameras, in spans
TABLE_HEIGHT = 0.05, 0.12  # height of the top above the ground, in spans
ON_TABLE = 0.0, 2.0  # number of smaller things on it; none halves the score
RESTING = 0.06  # spans between the bottom of a thing and the top of what it rests on

# Balls and boxes
WHOLE_BALL = 0.6, 0.8  # smallest extent / diameter: a shallow cap of a large sphere is not a ball
ROUND = 0.10, 0.05  # mean distance from the sphere / radius
BOX_FACES = 0.11, 0.06  # mean distance to the nearest face / √(smallest side · middle side)
BOX_EDGES = 0.02, 0.08  # share of points near upright edges, which a cylinder has none of
NEAR_EDGE = 0.12  # distance to both faces of an edge / side: a point is near it


@dataclass(frozen=True)
class Body:
    """Points [P, 3] of an instance without outliers, in a frame with z up, and measures of them.

    center [3]; normal [3], thickness and area: of its best plane, see `measure`; low, high: of its z; top, top_share,
    footprint: of its fullest horizontal slab the height, the share of points, and low and high corner [2, 2].
    """

    points: np.ndarray
    center: np.ndarray
    normal: np.ndarray
    thickness: float
    area: float
    low: float
    high: float
    top: float
    top_share: float
    footprint: np.ndarray


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
    order = np.argsort(instance_ids, kind="stable")
    starts, ends = (np.searchsorted(instance_ids, wanted, side, order) for side in ("left", "right"))
    measured = [measure(means[order[a:b]] @ frame.T) for a, b in zip(starts, ends, strict=True)]
    rows = [n for n, body in enumerate(measured) if body is not None]
    bodies = [body for body in measured if body is not None]
    if not bodies:
        return scores
    by_kind = {"ball": np.array([roundness(body.points) for body in bodies])}
    if up is not None:
        by_kind["box"] = np.array([boxiness(body.points) for body in bodies])
        by_kind |= room_scores(bodies, float(np.median((camera_centres(camera_from_world) @ frame.T)[:, 2])))
    for kind, values in by_kind.items():
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
    ramp(smallest extent / 2r; WHOLE_BALL) · ramp(mean | |x − o| − r | / r; ROUND)
    """
    rows = np.concatenate([2 * points, np.ones((len(points), 1))], axis=1)
    solution, *_ = np.linalg.lstsq(rows, (points**2).sum(axis=1), rcond=None)
    radii = np.linalg.norm(points - solution[:3], axis=1)
    radius = float(np.median(radii))
    size = np.percentile(points, 97, axis=0) - np.percentile(points, 3, axis=0)
    complete = ramp(float(size.min()) / max(2 * radius, 1e-9), *WHOLE_BALL)
    return complete * ramp(float(np.abs(radii - radius).mean()) / max(radius, 1e-9), *ROUND)


def boxiness(points: np.ndarray) -> float:
    """1 for points [P, 3] on the faces of an upright box (z up), 0 for round or irregular shapes.

    Uses the upright bounding box with the smallest ground area, of rotations in steps of 5°. With its sides S:
    ramp(mean distance to the nearest face / √(min S · median S); BOX_FACES) · ramp(share near upright edges; BOX_EDGES)
    """
    angles = np.radians(np.arange(0, 90, 5))
    turns = np.tile(np.eye(3), (len(angles), 1, 1))
    turns[:, 0, 0] = turns[:, 1, 1] = np.cos(angles)
    turns[:, 1, 0] = np.sin(angles)
    turns[:, 0, 1] = -turns[:, 1, 0]
    turned = points @ turns  # [A, P, 3]
    low, high = np.percentile(turned, [2, 98], axis=1)
    sides = np.maximum(high - low, 1e-9)
    best = int((sides[:, 0] * sides[:, 1]).argmin())
    size, inside = sides[best], np.minimum(turned[best] - low[best], high[best] - turned[best])
    # inside: distance to the nearer of the two faces along each axis
    nearest = np.abs(inside / np.sqrt(size.min() * np.median(size))).min(axis=1)
    at_edges = np.abs(inside[:, :2] / size[:2]).max(axis=1) < NEAR_EDGE
    return ramp(float(nearest.mean()), *BOX_FACES) * ramp(float(at_edges.mean()), *BOX_EDGES)


def ramp(x: Any, zero: Any, one: Any) -> Any:
    """0 at `zero`, 1 at `one`, linear between, clamped outside; a step where they are equal. Numbers or arrays."""
    return np.clip((x - zero) / np.where(one == zero, 1e-9, one - zero), 0.0, 1.0)


def _rise(x: Any, bounds: tuple[float, float], unit: float = 1.0, base: float = 0.0) -> Any:
    """`ramp` with bounds in a unit above a base."""
    return ramp(x, base + bounds[0] * unit, base + bounds[1] * unit)


def room_scores(bodies: list[Body], eyes: float) -> dict[str, np.ndarray]:
    """Scores [B] of the kinds that depend on the other instances. eyes: median height of the cameras."""
    tilt = np.abs([body.normal[2] for body in bodies])
    centers = np.array([body.center for body in bodies])
    height = centers[:, 2]
    thickness, area, low, high, top, top_share = (
        np.array([getattr(body, name) for body in bodies])
        for name in ("thickness", "area", "low", "high", "top", "top_share")
    )
    flat = ramp(thickness, *FLAT)
    level, upright = flat * ramp(tilt, *LEVEL), flat * ramp(tilt, *UPRIGHT)
    span = high.max() - low.min() + 1e-9
    largest, largest_upright = area.max(), max(area[upright > CERTAIN].max(initial=0.0), 1e-9)
    typical = min(float(np.median(area)), LARGEST_TYPICAL * largest)

    ground = height[(level > CERTAIN) & (height < eyes) & (area > GROUND_AREA * largest)].min(initial=np.inf)
    lowest = float(np.percentile(np.concatenate([body.points[:, 2] for body in bodies]), 2))
    if ground > lowest + LOWER_THINGS * span:
        ground = np.inf  # the floor is not in the map
    known = bool(np.isfinite(ground))
    at_ground = (level > CERTAIN) & (height < ground + AT_GROUND * span) & known
    floor = at_ground & (np.arange(len(area)) == np.where(at_ground, area, -1).argmax())  # the largest piece
    on_ground = known & ~floor & (high < ground + ON_GROUND * span) & (area < LARGEST_RUG * largest)

    carries = (upright > CERTAIN) & (area >= WALL_OF_PICTURE * largest_upright)
    walls = [body for body, wall in zip(bodies, carries, strict=True) if wall]
    gap = np.array([min((_gap(body, wall) for wall in walls if wall is not body), default=np.inf) for body in bodies])
    rests = np.array([_resting(body, centers, area, low, span).sum() for body in bodies])
    raised = np.where(floor, 0.5, _rise(top, TABLE_HEIGHT, span, ground) if known else 1.0)
    wall = upright * ramp(area / largest_upright, *WALL_OF_UPRIGHT) * ramp(area / largest, *WALL_OF_LARGEST)
    wall *= _rise(high - low, WALL_HEIGHT, span)
    table = ramp(top_share, *TABLE_SLAB) * _rise(area, TABLE_AREA, typical) * (0.5 + 0.5 * ramp(rests, *ON_TABLE))
    return {
        "wall": wall,
        "picture": upright * (1 - wall) * ramp(gap / span, *NEAR_WALL),
        "floor": level * at_ground * area / max(area[floor].max(initial=0.0), 1e-9),  # it may be in pieces
        "rug": level * np.where(floor, CARPET, on_ground * _rise(area, RUG_AREA, typical)),
        "ceiling": level * _rise(height, ABOVE_EYES, span, eyes) * _rise(area, CEILING_AREA, largest),
        "table": (upright < CERTAIN) * table * _rise(top, TABLE_BELOW_EYES, span, eyes) * raised,
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


def _resting(body: Body, centers: np.ndarray, area: np.ndarray, low: np.ndarray, span: float) -> np.ndarray:
    """[B] bool: which of the bodies with these centers [B, 3], areas and lows [B] are smaller and stand on its top."""
    inside = ((centers[:, :2] > body.footprint[0]) & (centers[:, :2] < body.footprint[1])).all(axis=1)
    return inside & (area < body.area) & (np.abs(low - body.top) < RESTING * span)


def _gap(body: Body, wall: Body) -> float:
    """Distance of a body's centre from a wall's plane if both are parallel, else infinity."""
    if abs(float(body.normal @ wall.normal)) < PARALLEL:
        return float("inf")
    return float(abs((body.center - wall.center) @ wall.normal))
