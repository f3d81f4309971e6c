"""Virtual cameras for a finished Gaussian scene, from its own free space and surfaces.

Places     a grid in the scene's free space. Where a scene encloses its cameras, as a room does, or a table in one,
           those are places that see surface in most directions; else they lie around and above it, as for a thing or a
           flight.
Panoramas  from each place, depth in all directions: what can be seen of the surface, as voxels.
Views      chosen greedily, of all places and directions, until every voxel that can be seen is seen by FIVE with as
           many pixels as its Gaussians need. Nothing is random.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass, replace
from itertools import compress

import numpy as np
import torch

from perception.errors import InputError
from perception.frame.gravity import Gravity
from perception.gaussians.model import Gaussians
from perception.gaussians.views import expected_depth, render, unprojected
from perception.geometry import sums_by
from perception.masks.surface import position_in, voxel_keys
from perception.progress import QUIET, Progress
from perception.rasterizer.rasterize import rasterizer_for
from perception.rasterizer.types import Settings
from perception.splats.gravity import gravity_of

FIVE = 5.0
"""Views that each voxel is to be seen by."""
MOST_VIEWS = 160
ENOUGH = 2e-4
"""Gain of the next view, as share of all there is to gain, at which no more are chosen."""
PLACES, SIDE = 240, 48
"""Places of the grid, and pixels of a face of a panorama."""
PROXY = 150_000
"""Gaussians that panoramas are rendered of; of more, every k-th is taken, enlarged."""
ASPECT, FOCAL = 0.75, 0.8
"""Of the views: height and focal length, relative to the width."""
EPS = 0.01
"""Blur of a panorama in pixels², the least that the rasterizer knows: the usual .3 makes a fog of small Gaussians."""
PIXELS, DENSE = 3.0, 4.0
"""Pixels between neighbouring Gaussians in a view that shows their detail; multiple of the median number of Gaussians
in a voxel beyond which more of them ask for no more pixels."""
SEEN = 0.25
"""Credit of a view for a voxel, 1 with all the pixels wanted, from which the voxel counts as seen by it."""
VOXEL = 0.06
"""Side of a voxel relative to the median distance of what the places see: twice what a ray of a panorama covers there.
Voxels of the surface are those that hold Gaussians: depth alone is nowhere in haze and at edges."""
INSIDE, ENCLOSED = 0.6, 0.75
"""Share of the directions in which a place of an enclosing scene sees surface; and of the best places' own share."""
HEIGHTS, OPEN = (0.45, 1.3), 0.3
"""Heights of places in an enclosing scene, as shares of its own: a robot's or a person's eyes; and how much beyond the
scene places are tried, which a ceiling or a lack of walls rules out."""
HALF = 0.5
"""Share of all directions in which a place sees surface, from which it is not outside of a wall or below the floor."""
HORIZON = np.sin(np.radians(15))
"""Sine of the elevation below which a place of an enclosing scene sees surface: it may be open above."""
NEAREST = 0.15
"""Least distance between a camera and what it shows, relative to the median distance."""
EDGE = 1.3
"""Ratio of the depths around a ray from which two surfaces are seen there."""
FILLED = 0.5
"""Least share of a view that shows surface."""
PITCHES, YAWS = (-75, -50, -28, -8, 15), 12


@dataclass(frozen=True)
class Chosen:
    """poses [C, 4, 4] camera_from_world, in the order of choice; facts: JSON-able, for map.json."""

    poses: np.ndarray
    facts: dict[str, float | int | str]


@dataclass(frozen=True)
class Panorama:
    """What a place [3] sees along rays in all directions [R]: points [R, 3] in the world, distance [R], hit [R] bool,
    and normals [R, 3] of what is hit, towards the place; 0 at edges."""

    place: np.ndarray
    points: np.ndarray
    distance: np.ndarray
    hit: np.ndarray
    normals: np.ndarray


@dataclass(frozen=True)
class Survey:
    """The places of a scene. numbers: of each, the voxel of each ray [R], −1 = none; rays [R, 3]: their
    directions in the world. inside: the scene encloses them.
    typical: median distance of what they see. keys [V]: voxels of side `size` that they see, ascending; counts [V]: the
    Gaussians in each."""

    places: list[Panorama]
    numbers: list[np.ndarray]
    rays: np.ndarray
    inside: bool
    gravity: Gravity
    typical: float
    size: float
    keys: np.ndarray
    counts: np.ndarray


def intrinsics(width: int) -> tuple[np.ndarray, int]:
    """K [3, 3] of a virtual camera and its height in pixels."""
    height = round(ASPECT * width)
    return np.array([[FOCAL * width, 0, width / 2], [0, FOCAL * width, height / 2], [0, 0, 1.0]]), height


def proxy_of(gaussians: Gaussians, hidden: np.ndarray) -> Gaussians:
    """The Gaussians that are not hidden, without harmonics; of more than PROXY every k-th, its σ times √k."""
    rows = np.flatnonzero(~hidden)
    k = max(1, -(-len(rows) // PROXY))
    index = torch.from_numpy(rows[::k])
    return Gaussians(
        gaussians.means[index],
        gaussians.quats[index],
        gaussians.log_scales[index] + 0.5 * float(np.log(k)),
        gaussians.opacity_logits[index],
        gaussians.sh[index, :1],
        torch.zeros(len(index), 1),
    )


def survey(proxy: Gaussians, means: np.ndarray, up: np.ndarray | None, progress: Progress = QUIET) -> Survey:
    """The places of a scene from which it is seen. means [N, 3]: of the Gaussians that count; proxy: what is rendered;
    up [3]: None finds it (see `gravity_of`). InputError where nothing is seen."""
    axes = upright_axes(np.array([0.0, 0.0, 1.0]) if up is None else up)
    low, high = _box(means @ axes.T)
    side = OPEN * (high - low).min()  # whichever way is up
    places = _panoramas(proxy, _grid(low - side, high + side, PLACES) @ axes, axes, progress)
    places = [p for p in places if p.hit.any()]
    if not places:
        raise InputError("the scene is one blob: nothing in it is seen from anywhere; give --cameras, or another scene")
    typical = _typical(places)
    places = [p for p in places if np.quantile(p.distance[p.hit], 0.02) > NEAREST * typical] or places
    rays = _rays() @ axes
    if up is None:
        inner = [p for p in places if p.hit.mean() >= HALF] or places
        roomy = np.array([np.median(p.distance[p.hit]) for p in inner])  # places in haze and under tables count less
        opened = 1 - np.average([p.hit for p in inner], axis=0, weights=roomy)
        gravity = gravity_of(_normals_of(inner, means, VOXEL * typical), means, opened, rays)
    else:
        gravity = Gravity(-up, 0.0, "--up")
    places, inside = _well_placed(places, means, -gravity.direction, rays)
    if not inside:
        axes = upright_axes(-gravity.direction)
        rays = _rays() @ axes
        around = _around(*_box(means @ axes.T)) @ axes
        places = [p for p in _panoramas(proxy, around, axes, progress) if p.hit.any()] or places
    typical = _typical(places)
    size = VOXEL * typical
    keys, counts = np.unique(voxel_keys(means, size), return_counts=True)
    numbers = [np.where(p.hit, position_in(keys, voxel_keys(p.points, size)), -1) for p in places]
    every = np.concatenate(numbers)
    seen = np.unique(every[every >= 0])
    if not len(seen):
        raise InputError("the scene is one blob: none of its Gaussians are seen as a surface; give another scene")
    numbers = [np.where(n >= 0, position_in(seen, n), -1) for n in numbers]
    return Survey(places, numbers, rays, inside, gravity, typical, size, keys[seen], counts[seen])


def _well_placed(
    places: list[Panorama], means: np.ndarray, up: np.ndarray, rays: np.ndarray
) -> tuple[list[Panorama], bool]:
    """The places that an enclosing scene encloses, at good height; all and False where there are none."""
    low, high = (corner[0] for corner in _box((means @ up)[:, None]))
    height = np.array([(up @ p.place - low) / max(high - low, 1e-12) for p in places])
    below = rays @ up < HORIZON * np.linalg.norm(rays, axis=1)
    enclosed = np.array([p.hit[below].mean() for p in places])
    good = (height >= HEIGHTS[0]) & (height <= HEIGHTS[1])
    best = float(np.quantile(enclosed[good], 0.9)) if good.any() else 0.0
    good &= enclosed >= ENCLOSED * best
    return (list(compress(places, good)), True) if best >= INSIDE else (places, False)


def _typical(places: list[Panorama]) -> float:
    """The median distance of what places see."""
    return float(np.median(np.concatenate([p.distance[p.hit] for p in places])))


def _normals_of(places: list[Panorama], means: np.ndarray, size: float) -> np.ndarray:
    """[V, 3] mean normal of each voxel of side `size` that holds means and is seen, shorter than 1 where not flat."""
    points, normals = (np.concatenate([getattr(p, name)[p.hit] for p in places]) for name in ("points", "normals"))
    keys = np.unique(voxel_keys(means, size))
    voxel = position_in(keys, voxel_keys(points, size))
    rows = np.flatnonzero(voxel >= 0)
    counts = np.maximum(np.bincount(voxel[rows], minlength=len(keys)), 1)
    return np.asarray(sums_by(voxel[rows], normals[rows], len(keys)) / counts[:, None])


def choose_views(found: Survey, proxy: Gaussians, width: int, given: np.ndarray, focal: float) -> Chosen:
    """Virtual views, `width` pixels wide, of the places in `found`. given [G, 4, 4]: poses that are used anyway, of
    cameras of a focal length of `focal` widths. InputError where no view shows enough."""
    axes, counts = upright_axes(-found.gravity.direction), found.counts
    per_ray = (FOCAL * width * 2 / SIDE) ** 2  # pixels of a view that a ray of a panorama covers, at its axis
    wanted = np.maximum(PIXELS**2 * np.minimum(counts, DENSE * np.median(counts)) / per_ray, 1.0)  # rays
    credits = []
    for pose in given:
        voxel = position_in(found.keys, voxel_keys(_seen_from(proxy, pose, focal), found.size))
        seen, rays = np.unique(voxel[voxel >= 0], return_counts=True)
        credits.append((seen, np.minimum(1, rays / wanted[seen])))
    poses, more = _candidates(found, axes, wanted, NEAREST * found.typical)
    if not poses and not len(given):
        raise InputError("no view was found that shows enough of the scene; give --cameras")
    order = _greedy(more, counts.astype(np.float64), credits)
    times = np.zeros(len(counts))
    for seen, credit in [*credits, *(more[i] for i in order)]:
        times[seen] += credit >= SEEN
    facts: dict[str, float | int | str] = {
        "kind": "inside" if found.inside else "around",
        "places": len(found.places),
        "views": len(order),
        "seen_by_five": round(float(counts[times >= FIVE].sum() / counts.sum()), 4),
        "seen": round(float(counts[times >= 1].sum() / counts.sum()), 4),
        "median_distance": found.typical,
    }
    return Chosen(np.array([poses[i] for i in order]).reshape(-1, 4, 4), facts)


def upright_axes(up: np.ndarray) -> np.ndarray:
    """[3, 3] rows x, y, z = up of a level frame in world axes."""
    x = np.eye(3)[int(np.abs(up).argmin())]
    x = x - (x @ up) * up
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(up, x), up])


def pose_at(place: np.ndarray, yaw: float, pitch: float, axes: np.ndarray) -> np.ndarray:
    """camera_from_world [4, 4] of a level camera at `place`; yaw and pitch in radians, the latter up."""
    ahead = np.array([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)])
    right = np.array([np.sin(yaw), -np.cos(yaw), 0])
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(ahead, right), ahead]) @ axes
    pose[:3, 3] = -pose[:3, :3] @ place
    return pose


# ----------------------------------------------------------------------- places


def _box(local: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Corners of the box of means [N, 3] without far backgrounds: of a uniform scene it holds all."""
    low, high = np.quantile(local, [0.1, 0.9], axis=0)
    margin = 0.5 * (high - low)
    return np.maximum(low - margin, local.min(axis=0)), np.minimum(high + margin, local.max(axis=0))


def _grid(low: np.ndarray, high: np.ndarray, count: int) -> np.ndarray:
    """[P, 3] centres of about `count` cubes that fill a box."""
    side = np.maximum(high - low, 1e-9)
    step = float(np.cbrt(np.prod(side) / count))
    parts = np.maximum(np.round(side / step), 1).astype(int)
    axes = [low[i] + (np.arange(parts[i]) + 0.5) * side[i] / parts[i] for i in range(3)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def _around(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """[P, 3] places on two domes about a box, and on two levels above it."""
    centre, half = (low + high) / 2, np.maximum((high - low) / 2, 1e-9)
    places = []
    for factor in (1.3, 2.0):
        for pitch in np.radians([8, 30, 55]):
            yaw = np.radians(np.arange(0, 360, 30) + (15 if factor > 1.5 else 0))
            dome = [np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.full(len(yaw), np.sin(pitch))]
            places.append(centre + factor * np.linalg.norm(half) * np.stack(dome, axis=1))
    step = max(float(np.sqrt(half[0] * half[1])) / 4, 1e-9)
    for above in (1.0, 2.0):
        level = np.array([[low[0], low[1], high[2] + above * step], [high[0], high[1], high[2] + above * step]])
        places.append(_grid(level[0], level[1] + [0, 0, 1e-6 * step], 64) if half.max() > 0 else level[:1])
    return np.concatenate(places)


def _rays() -> np.ndarray:
    """[R, 3] of the pixels of a panorama in level axes, of length 1 along the axis of their face."""
    centre = (np.arange(SIDE) + 0.5) / SIDE * 2 - 1
    x, y = np.meshgrid(centre, centre)
    face = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3)
    return np.asarray((face @ _faces()).reshape(-1, 3))


def _faces() -> np.ndarray:
    """Rotations camera_from_level [6, 3, 3] of the faces."""
    level = [pose_at(np.zeros(3), yaw, 0.0, np.eye(3))[:3, :3] for yaw in np.radians([0, 90, 180, 270])]
    return np.stack([*level, *(pose_at(np.zeros(3), 0.0, pitch, np.eye(3))[:3, :3] for pitch in np.radians([90, -90]))])


def _panoramas(proxy: Gaussians, places: np.ndarray, axes: np.ndarray, progress: Progress) -> list[Panorama]:
    K = torch.tensor([[SIDE / 2, 0, SIDE / 2], [0, SIDE / 2, SIDE / 2], [0, 0, 1.0]])
    settings = Settings(SIDE, SIDE, eps2d=EPS, variance=False, depth=True)
    rays, faces, found = _rays() @ axes, _faces(), []
    fixed = replace(proxy.inputs(torch.eye(4), K), Ks=K.expand(6, 3, 3).contiguous().to(proxy.means.device))
    lengths = np.linalg.norm(rays, axis=1)
    for done, place in enumerate(places, start=1):
        poses = np.tile(np.eye(4), (6, 1, 1))
        poses[:, :3, :3] = faces @ axes
        poses[:, :3, 3] = -poses[:, :3, :3] @ place
        inputs = replace(fixed, viewmats=torch.from_numpy(poses).float().to(proxy.means.device))
        out = rasterizer_for(proxy.means.device).rasterize_forward(inputs, settings)
        depth = expected_depth(out, all_views=True).numpy().ravel().astype(np.float64)
        points = place + depth[:, None] * rays
        found.append(Panorama(place, points, depth * lengths, depth > 0, _normals(points, depth, place)))
        progress.update("places", done, len(places))
    return found


def _normals(points: np.ndarray, depth: np.ndarray, place: np.ndarray) -> np.ndarray:
    """[R, 3] float32 unit normals towards `place`, from neighbouring rays; 0 where one of them hits nothing, or
    another surface."""
    grid, depths = points.reshape(6, SIDE, SIDE, 3), depth.reshape(6, SIDE, SIDE)
    normals = np.zeros_like(grid)
    right, down = grid[:, 1:-1, 2:] - grid[:, 1:-1, :-2], grid[:, 2:, 1:-1] - grid[:, :-2, 1:-1]
    cross = np.cross(right, down)
    cross /= np.maximum(np.linalg.norm(cross, axis=-1, keepdims=True), 1e-300)
    cross *= -np.sign((cross * (grid[:, 1:-1, 1:-1] - place)).sum(axis=-1, keepdims=True))
    four = np.stack([depths[:, 1:-1, 2:], depths[:, 1:-1, :-2], depths[:, 2:, 1:-1], depths[:, :-2, 1:-1]])
    smooth = (four.min(axis=0) > 0) & (four.max(axis=0) < EDGE * four.min(axis=0))
    normals[:, 1:-1, 1:-1] = np.where(smooth[..., None], cross, 0)
    return np.asarray(normals.reshape(-1, 3).astype(np.float32))


def _seen_from(proxy: Gaussians, pose: np.ndarray, focal: float) -> np.ndarray:
    """World points [P, 3] that a given camera sees, along rays as dense as those of a panorama at its axis."""
    width = max(2, round(SIDE / 2 / focal))
    height = round(ASPECT * width)
    K = np.array([[SIDE / 2, 0, width / 2], [0, SIDE / 2, height / 2], [0, 0, 1.0]])
    tensors = torch.from_numpy(pose).float(), torch.from_numpy(K).float()
    out = render(proxy, *tensors, width, height, eps2d=EPS)
    depth = expected_depth(out).numpy().astype(np.float64)
    y, x = np.nonzero(depth > 0)
    return unprojected(K, pose, x + 0.5, y + 0.5, depth[y, x])


# ----------------------------------------------------------------------- choice


def _candidates(
    found: Survey, axes: np.ndarray, wanted: np.ndarray, nearest: float
) -> tuple[list[np.ndarray], list[tuple[np.ndarray, np.ndarray]]]:
    """Poses of all views that show enough, and of each the voxels that it sees with its credit for each, up to 1."""
    rays = found.rays @ axes.T
    # A ray near a face's corner covers less of the sphere than one at its middle, as a view's pixel does near its own.
    share = 1 / np.linalg.norm(rays, axis=1) ** 3
    turns, inside = [], []
    for pitch in np.radians(PITCHES):
        for yaw in np.radians(np.arange(YAWS) * 360 / YAWS):
            x, y, z = (rays @ pose_at(np.zeros(3), yaw, pitch, np.eye(3))[:3, :3].T).T
            rows = np.flatnonzero((z > 0) & (np.abs(x) * FOCAL < z / 2) & (np.abs(y) * FOCAL < z * ASPECT / 2))
            turns.append((yaw, pitch))
            inside.append((rows, share[rows] * (np.linalg.norm(rays[rows], axis=1) / z[rows]) ** 3))
    poses, credits = [], []
    for place, number in zip(found.places, found.numbers, strict=True):
        for (yaw, pitch), (rows, pixels) in zip(turns, inside, strict=True):
            hit = place.hit[rows]
            if hit.mean() < FILLED or np.quantile(place.distance[rows][hit], 0.02) < nearest:
                continue
            own = number[rows] >= 0
            seen, index = np.unique(number[rows][own], return_inverse=True)
            covered = sums_by(index, pixels[own][:, None], len(seen))[:, 0]
            poses.append(pose_at(place.place, yaw, pitch, axes))
            credits.append((seen, np.minimum(1, covered / wanted[seen])))
    return poses, credits


def _greedy(
    views: list[tuple[np.ndarray, np.ndarray]], weight: np.ndarray, given: list[tuple[np.ndarray, np.ndarray]]
) -> list[int]:
    """Views in the order of choice, beside those `given`; each as voxels and its credit for them. weight [V]: of
    voxels. Gains only fall, so those of most views need not be computed again."""
    have = np.zeros(len(weight))
    for seen, credit in given:
        have[seen] += credit

    def gain(view: int) -> float:
        seen, credit = views[view]
        return float((weight[seen] * np.minimum(credit, np.maximum(FIVE - have[seen], 0))).sum())

    queue = [(-gain(view), view) for view in range(len(views))]
    heapq.heapify(queue)
    order: list[int] = []
    least = ENOUGH * FIVE * float(weight.sum())
    while queue and len(order) < MOST_VIEWS and -queue[0][0] >= least:
        view = heapq.heappop(queue)[1]
        now = gain(view)
        if queue and now < -queue[0][0]:
            heapq.heappush(queue, (-now, view))
        elif now >= least:
            order.append(view)
            have[views[view][0]] += views[view][1]
    return order
