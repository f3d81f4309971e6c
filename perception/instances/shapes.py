"""What the shape of an instance says of its kind: floor, wall, table, picture on a wall, rug, ball, box.

No classifier of single objects knows walls and floors, but a map knows geometry: which way is up (photographers
hold cameras level), which planes are level or upright, what lies lowest, what hangs flat on a wall. All lengths are
shares of the scene's own size, so maps without a metric scale are served as well.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from perception.geometry import camera_centres
from perception.language.shape_words import KINDS

LEVEL = 0.12  # most mean square roll of the cameras at which "level" is believed
SAMPLES = 1000  # points of an instance that are looked at


@dataclass(frozen=True)
class Body:
    """An instance's points less outliers, measured. Heights along up; sizes in map units.

    normal [3] unit: of the best plane; thickness: spread along it over the spread within it. low, high: heights;
    area: of the best plane's bounding rectangle. center [3]. top_share: share of points in the level slab that holds
    most; top: its height; footprint: low and high corner [2, 2] of its bounding rectangle in the level plane.
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


def up_from_cameras(camera_from_world: np.ndarray) -> np.ndarray | None:
    """The upward direction [3] in the world's frame from poses [C, 4, 4]; None when the cameras are not held level.

    The right-hand axes of level cameras are level themselves, so up is the direction they have least of.
    """
    if len(camera_from_world) < 3:
        return None
    right, down = camera_from_world[:, 0, :3], camera_from_world[:, 1, :3]
    values, vectors = np.linalg.eigh(right.T @ right / len(right))
    up = vectors[:, 0]
    if values[1] < 2 * values[0] + 1e-3:  # a walk without turns: only the cameras' own upright axes are left
        up = -down.mean(axis=0)
        up /= max(float(np.linalg.norm(up)), 1e-9)
    if float(((right @ up) ** 2).mean()) > LEVEL or abs(float((down @ up).mean())) < 0.3:
        return None
    return up if (down @ up).mean() < 0 else -up


def shape_scores(
    means: np.ndarray, instance_ids: np.ndarray, wanted: list[int], camera_from_world: np.ndarray
) -> np.ndarray:
    """How much each instance of `wanted` looks like each of shape_words.KINDS: [I, K] in [0, 1].

    means [N, 3], instance_ids [N]; camera_from_world [C, 4, 4]. Without a known up only balls are told.
    """
    scores = np.zeros((len(wanted), len(KINDS)))
    up = up_from_cameras(camera_from_world)
    frame = level_frame(np.array([0.0, 0.0, 1.0]) if up is None else up)
    bodies = {
        n: body for n, i in enumerate(wanted) if (body := measure(means[instance_ids == i] @ frame.T)) is not None
    }
    for n, body in bodies.items():
        scores[n, KINDS.index("ball")] = roundness(body.points)
    if up is None or not bodies:
        return scores
    centres = camera_centres(camera_from_world) @ frame.T
    for name, values in _room(bodies, centres).items():
        scores[list(values), KINDS.index(name)] = list(values.values())
    for n, body in bodies.items():
        scores[n, KINDS.index("box")] = boxiness(body.points)
    return scores


def level_frame(up: np.ndarray) -> np.ndarray:
    """A rotation [3, 3] whose third row is up."""
    side = np.eye(3)[int(np.argmin(np.abs(up)))]
    x = np.cross(up, side)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(up, x), up])


def measure(points: np.ndarray) -> Body | None:
    """A Body of points [P, 3] in a frame with z up; None for fewer than 20 points."""
    if len(points) < 20:
        return None
    points = points[:: max(1, len(points) // SAMPLES)].astype(np.float64)
    low, high = np.percentile(points, [2, 98], axis=0)
    margin = 0.05 * (high - low) + 1e-9
    points = points[((points >= low - margin) & (points <= high + margin)).all(axis=1)]
    center = np.median(points, axis=0)
    normal = _plane_normal(points, center)
    in_plane = level_frame(normal)
    local = (points - center) @ in_plane.T
    spread = np.percentile(local, 75, axis=0) - np.percentile(local, 25, axis=0)
    extent = np.percentile(local, 97, axis=0) - np.percentile(local, 3, axis=0)
    thickness = spread[2] / max(float(np.sqrt(spread[0] * spread[1])), 1e-9)
    top, share, footprint = _slab(points)
    area = float(extent[0] * extent[1])
    return Body(points, center, normal, float(thickness), area, float(low[2]), float(high[2]), top, share, footprint)


def roundness(points: np.ndarray) -> float:
    """1 for points [P, 3] on a sphere (or most of one), 0 for anything else: the residual of the best sphere."""
    rows = np.concatenate([2 * points, np.ones((len(points), 1))], axis=1)
    solution, *_ = np.linalg.lstsq(rows, (points**2).sum(axis=1), rcond=None)
    radii = np.linalg.norm(points - solution[:3], axis=1)
    radius = float(np.median(radii))
    size = np.percentile(points, 97, axis=0) - np.percentile(points, 3, axis=0)
    whole = ramp(float(size.min()) / max(2 * radius, 1e-9), 0.6, 0.8)  # a shallow cap of a large sphere is no ball
    return whole * ramp(float(np.abs(radii - radius).mean()) / max(radius, 1e-9), 0.10, 0.05)


def boxiness(points: np.ndarray) -> float:
    """1 for points [P, 3] on the faces of an upright box (z up), 0 for round or ragged things."""
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
    inside = np.minimum(turned - low, high - turned)  # distance to the nearer of two faces, along each axis
    nearest = np.abs(inside / np.sqrt(size.min() * np.median(size))).min(axis=1)
    corners = np.abs(inside[:, :2] / size[:2]).max(axis=1) < 0.12  # a box has upright edges, a cylinder has none
    return ramp(float(nearest.mean()), 0.11, 0.06) * ramp(float(corners.mean()), 0.02, 0.08)


def ramp(x: float, zero: float, one: float) -> float:
    """0 at `zero`, 1 at `one`, linear between and clipped beyond."""
    return float(np.clip((x - zero) / (one - zero), 0.0, 1.0))


def _room(bodies: dict[int, Body], cameras: np.ndarray) -> dict[str, dict[int, float]]:
    """Scores of the kinds that need the other instances for comparison, by name and position."""
    flat = {n: ramp(b.thickness, 0.35, 0.2) for n, b in bodies.items()}
    level = {n: flat[n] * ramp(abs(float(b.normal[2])), 0.85, 0.95) for n, b in bodies.items()}
    upright = {n: flat[n] * ramp(abs(float(b.normal[2])), 0.3, 0.15) for n, b in bodies.items()}
    span = max(b.high for b in bodies.values()) - min(b.low for b in bodies.values()) + 1e-9
    eye = float(np.median(cameras[:, 2]))
    largest = max((b.area for n, b in bodies.items() if upright[n] > 0.5), default=0.0)
    wide = max(b.area for b in bodies.values())
    below = [b.center[2] for n, b in bodies.items() if level[n] > 0.5 and b.center[2] < eye and b.area > 0.1 * wide]
    lowest = float(np.percentile(np.concatenate([b.points[:, 2] for b in bodies.values()]), 2))
    ground = min(below, default=None)
    if ground is not None and ground > lowest + 0.1 * span:
        ground = None  # something lies deeper: a table top, and the floor is not in the map
    scores: dict[str, dict[int, float]] = {kind: {} for kind in KINDS}
    walls = [b for n, b in bodies.items() if upright[n] > 0.5 and b.area >= 0.3 * largest]
    floors = [
        n for n, b in bodies.items() if ground is not None and level[n] > 0.5 and b.center[2] < ground + 0.05 * span
    ]
    floor = max(floors, key=lambda n: bodies[n].area, default=None)
    typical = min(float(np.median([b.area for b in bodies.values()])), 0.03 * wide)
    for n, b in bodies.items():
        size = b.area / max(largest, 1e-9)
        scores["wall"][n] = upright[n] * ramp(size, 0.15, 0.35) * ramp(b.high - b.low, 0.2 * span, 0.4 * span)
        near = min((_gap(b, wall) for wall in walls if wall is not b), default=np.inf) / span
        scores["picture"][n] = upright[n] * (1 - scores["wall"][n]) * ramp(near, 0.1, 0.05)
        scores["floor"][n] = level[n] * float(n == floor)
        lies = float(ground is not None and n != floor and b.high < ground + 0.08 * span and b.area < 0.8 * wide)
        scores["rug"][n] = level[n] * lies * ramp(b.area, typical, 2 * typical)
        scores["ceiling"][n] = (
            level[n] * ramp(b.center[2], eye, eye + 0.1 * span) * ramp(b.area, 0.1 * wide, 0.3 * wide)
        )
        raised = 1.0 if ground is None or n == floor else ramp(b.top, ground + 0.05 * span, ground + 0.12 * span)
        rests = sum(_rests_on(other, b, span) for m, other in bodies.items() if m != n)
        lone = 0.5 if n == floor else 1.0  # the lowest plane of a close-up may be a table top as well as a floor
        scores["table"][n] = (
            lone
            * raised
            * ramp(b.top_share, 0.25, 0.45)
            * ramp(b.area, typical, 3 * typical)
            * (0.5 + 0.5 * ramp(rests, 0, 2))
            * ramp(b.top, eye + 0.05 * span, eye - 0.05 * span)
            * float(upright[n] < 0.5)
        )
    return scores


def _plane_normal(points: np.ndarray, center: np.ndarray) -> np.ndarray:
    """Normal of the plane that most points lie on: principal axes, twice refitted to the nearer points."""
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
    """Height of the level slab that holds most points, their share, and its bounding rectangle [2, 2]."""
    heights = np.sort(points[:, 2])
    thin = 0.04 * float(np.linalg.norm(np.ptp(points, axis=0))) + 1e-9
    counts = np.searchsorted(heights, heights + thin, side="right") - np.arange(len(heights))
    start = int(counts.argmax())
    held = points[(points[:, 2] >= heights[start]) & (points[:, 2] <= heights[start] + thin)]
    rectangle = np.percentile(held[:, :2], [3, 97], axis=0)
    return float(np.median(held[:, 2])), float(counts[start] / len(points)), rectangle


def _rests_on(upper: Body, lower: Body, span: float) -> bool:
    """Whether a smaller thing stands on a body's top slab."""
    inside = ((upper.center[:2] > lower.footprint[0]) & (upper.center[:2] < lower.footprint[1])).all()
    return bool(inside and upper.area < lower.area and abs(upper.low - lower.top) < 0.06 * span)


def _gap(body: Body, wall: Body) -> float:
    """Distance of a body's middle from a wall's plane where both are parallel, else infinite."""
    if abs(float(body.normal @ wall.normal)) < 0.95:
        return float("inf")
    return float(abs((body.center - wall.center) @ wall.normal))
