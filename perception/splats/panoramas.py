"""Where virtual cameras may stand in a finished Gaussian scene, and what can be seen from there.

Places     a grid in the scene's free space. Where a scene encloses its cameras, as a room does, or a table in one,
           those are places that see surface in most directions; else they lie around and above it, as for a thing or a
           flight.
Panoramas  from each place, depth in all directions: what can be seen of the surface, as voxels.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import compress

import numpy as np
import torch

from perception.errors import InputError
from perception.frame.gravity import Gravity
from perception.gaussians.model import Gaussians
from perception.gaussians.views import expected_depth
from perception.geometry import sums_by
from perception.masks.surface import position_in, voxel_keys
from perception.progress import QUIET, Progress
from perception.rasterizer.rasterize import rasterizer_for
from perception.rasterizer.types import Settings
from perception.splats.gravity import gravity_of

PLACES, SIDE = 240, 48
"""Places of the grid, and pixels of a face of a panorama."""
MOST_PLACES, STEP = 960, 0.7
"""Places of the grid within a building, if more than PLACES; their distance relative to the median distance."""
PROXY = 150_000
"""Gaussians that panoramas are rendered of; of more, every k-th is taken, enlarged."""
EPS = 0.01
"""Blur of a panorama in pixels², the least that the rasterizer knows: the usual .3 makes a fog of small Gaussians."""
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
HOLDS, SHOWS = 0.93, 0.5
"""Surface seen from within over that seen from around, from which a closed scene, or one open above, is a room."""
HORIZON = np.sin(np.radians(15))
"""Sine of the elevation below which a place of an enclosing scene sees surface: it may be open above."""
FLAT = 0.05
"""Least side of a box of places relative to its largest."""
NEAREST = 0.15
"""Least distance between a camera and what it shows, relative to the median distance."""
EDGE = 1.3
"""Ratio of the depths around a ray from which two surfaces are seen there."""


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
    gravity = _gravity(places, means, rays, up, enclosed=True)
    outer = _outer(proxy, means, gravity, progress)
    within, inside = _well_placed(places, means, -gravity.direction, rays)
    if inside and outer and not _is_room(within, outer, means, -gravity.direction, rays):
        inside, before = False, gravity
        gravity = _gravity(places, means, rays, up, enclosed=False)
        if (gravity.direction != before.direction).any():
            outer = _outer(proxy, means, gravity, progress)
    if inside:
        finer, level = _finer(proxy, means, gravity, _typical(within), progress)
        within, rays = (finer, level) if finer else (within, rays)
    else:
        within, rays = (outer, _rays() @ upright_axes(-gravity.direction)) if outer else (places, rays)
    places, typical = within, _typical(within)
    size = VOXEL * typical
    keys, counts = np.unique(voxel_keys(means, size), return_counts=True)
    numbers = [np.where(p.hit, position_in(keys, voxel_keys(p.points, size)), -1) for p in places]
    every = np.concatenate(numbers)
    seen = np.unique(every[every >= 0])
    if not len(seen):
        raise InputError("the scene is one blob: none of its Gaussians are seen as a surface; give another scene")
    numbers = [np.where(n >= 0, position_in(seen, n), -1) for n in numbers]
    return Survey(places, numbers, rays, inside, gravity, typical, size, keys[seen], counts[seen])


def _gravity(
    places: list[Panorama], means: np.ndarray, rays: np.ndarray, up: np.ndarray | None, enclosed: bool
) -> Gravity:
    """The way down: −up, or as the places tell (`gravity_of`) that see surface in most directions, if `enclosed`, or
    the others."""
    if up is not None:
        return Gravity(-up, 0.0, "--up")
    chosen = [p for p in places if (p.hit.mean() >= HALF) == enclosed] or places
    roomy = np.array([np.median(p.distance[p.hit]) for p in chosen])  # places in haze and under tables count less
    opened = 1 - np.average([p.hit for p in chosen], axis=0, weights=roomy)
    return gravity_of(_normals_of(chosen, means, VOXEL * _typical(places)), means, opened, rays)


def _outer(proxy: Gaussians, means: np.ndarray, gravity: Gravity, progress: Progress) -> list[Panorama]:
    """What is seen from around and above the scene."""
    axes = upright_axes(-gravity.direction)
    around = _around(*_box(means @ axes.T)) @ axes
    return [p for p in _panoramas(proxy, around, axes, progress) if p.hit.any()]


def _finer(
    proxy: Gaussians, means: np.ndarray, gravity: Gravity, typical: float, progress: Progress
) -> tuple[list[Panorama], np.ndarray]:
    """The well placed of a grid as fine as a building needs, and their rays; none in a scene of a room's size.
    typical: median distance."""
    axes = upright_axes(-gravity.direction)
    low, high = _box(means @ axes.T)
    low[2], high[2] = low[2] + np.array(HEIGHTS) * (high[2] - low[2])
    count = int(min(np.prod(high - low) / (STEP * typical) ** 3, MOST_PLACES))
    if count <= PLACES:
        return [], np.zeros((0, 3))
    places = [p for p in _panoramas(proxy, _grid(low, high, count) @ axes, axes, progress) if p.hit.any()]
    places = [p for p in places if np.quantile(p.distance[p.hit], 0.02) > NEAREST * typical]
    rays = _rays() @ axes
    places, found = _well_placed(places, means, -gravity.direction, rays)
    return places if found else [], rays


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


def _is_room(
    within: list[Panorama], outer: list[Panorama], means: np.ndarray, up: np.ndarray, rays: np.ndarray
) -> bool:
    """Whether what encloses the places `within` is a room, not a hollow thing: closed above, it holds what the places
    around do not see; open above, much of the scene is seen from within."""
    size = VOXEL * _typical(outer)
    keys = np.unique(voxel_keys(means, size))

    def seen(places: list[Panorama]) -> int:
        points = np.concatenate([p.points[p.hit] for p in places])
        return len(np.setdiff1d(position_in(keys, voxel_keys(points, size)), [-1]))

    above = rays @ up > HORIZON * np.linalg.norm(rays, axis=1)
    closed = float(np.median([p.hit[above].mean() for p in within])) > HALF
    return seen(within) > (HOLDS if closed else SHOWS) * seen(outer)


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


def _box(local: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Corners of the box of means [N, 3] without far backgrounds: of a uniform scene it holds all."""
    low, high = np.quantile(local, [0.1, 0.9], axis=0)
    margin = 0.5 * (high - low)
    return np.maximum(low - margin, local.min(axis=0)), np.minimum(high + margin, local.max(axis=0))


def _grid(low: np.ndarray, high: np.ndarray, count: int) -> np.ndarray:
    """[P, D] centres of about `count` cubes that fill a box in D dimensions; a side far below the others is of one."""
    side = np.maximum(high - low, FLAT * (high - low).max() + 1e-9)
    step = float((np.prod(side) / count) ** (1 / len(side)))
    parts = np.maximum(np.round(side / step), 1).astype(int)
    axes = [
        middle + ((np.arange(n) + 0.5) / n - 0.5) * length
        for middle, n, length in zip((low + high) / 2, parts, side, strict=True)
    ]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(side))


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
        level = _grid(low[:2], high[:2], 64)
        places.append(np.c_[level, np.full(len(level), high[2] + above * step)])
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
